"""A capture with coordinates of maps is trained as at home, and its exports are where it belongs, to a millimetre."""

import json
import struct

import numpy as np
import pytest
import torch
import trimesh

from etsplat import TrainConfig, train
from etsplat.core.errors import InputError
from etsplat.io.georeference import Georeference
from etsplat.io.ply_tables import read_ply_tables
from etsplat.model.soup_import import load_soup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import open_run
from helpers import foreign_captures as foreign
from helpers.captures import small_demo_scene

FAR = (500_000.0, 5_400_000.0, 300.0)
OFFSET = (500_000.0, 5_400_002.0, 300.0)
"""The mean of the cameras in whole units: they are 2 m above the origin."""

MILLIMETRE, FAINT = 1e-3, 0.05


def exported(**settings):
    """After so short a training nothing is opaque."""
    return ExportConfig(min_opacity=FAINT, **settings)


def write_demo(folder, center):
    """The demo's scene as OpenMVG writes it, with its origin at `center`."""
    folder.mkdir()
    scene = small_demo_scene()
    viewmats, move = scene.viewmats.clone(), torch.tensor(center, dtype=torch.float64)
    u, _, vh = torch.linalg.svd(viewmats[:, :3, :3])  # made in float32, they are rotations to 1e-7 alone
    viewmats[:, :3, :3] = u @ vh
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ move
    assert scene.exact_points is not None
    points = scene.exact_points + move
    photos = [picture.numpy() for picture in scene.images]
    foreign.write_openmvg(
        folder,
        foreign.Truth(scene.names, scene.images.sizes, viewmats, scene.Ks, photos, points, np.zeros((len(points), 3))),
    )


CONFIG = TrainConfig.tiny().changed({"iterations": 20, "seed": 4})
"""Of one seed in six (0 is one) a last bit decides at an edit whether a triangle goes, and all rows move up."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """At home, and far away with a record of its own."""
    folder = tmp_path_factory.mktemp("georeference")
    write_demo(folder / "home", (0.0, 0.0, 0.0))
    write_demo(folder / "far", FAR)
    Georeference(up="y", crs="EPSG:25832").write(folder / "far")
    results = {name: train(folder / name, folder / f"{name}_run", CONFIG) for name in ("home", "far")}
    return folder, results


def test_it_trains_as_well_as_at_home(runs):
    """Cameras differ by what 5,400 km leave of 64 bits, a nanometre: so do nearly all triangles, and the quality."""
    _, results = runs
    assert results["far"].metrics["psnr"] == pytest.approx(results["home"].metrics["psnr"], abs=0.05)
    far = results["far"].soup.vertices.double() + torch.tensor(OFFSET, dtype=torch.float64)
    apart = (far - torch.tensor(FAR) - results["home"].soup.vertices).abs().amax(dim=(1, 2))
    assert float(apart.median()) < 1e-4


def test_the_run_says_where_it_lies(runs):
    folder, _ = runs
    found = Georeference.read(folder / "far_run" / "georeference.json")
    assert found == Georeference(OFFSET, 1.0, "y", "EPSG:25832")
    assert not (folder / "home_run" / "georeference.json").exists()


def corners_of(path):
    """Coordinates in a file, float64, as a program that knows the format reads them."""
    if path.suffix == ".ply":
        table = read_ply_tables(path)["vertex"]
        assert table.dtype["x"] == np.float64
        return np.stack([table[axis] for axis in "xyz"], axis=1)
    if path.suffix == ".obj":
        return np.array([line.split()[1:4] for line in path.read_text().splitlines() if line[:2] == "v "], dtype=float)
    if path.suffix == ".off":
        count = int(path.read_text().splitlines()[1].split()[0])
        return np.array([line.split() for line in path.read_text().splitlines()[2 : 2 + count]], dtype=float)
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])
    node, start = document["nodes"][0], 20 + length + 8
    accessor = document["accessors"][document["meshes"][node["mesh"]]["primitives"][0]["attributes"]["POSITION"]]
    view = document["bufferViews"][accessor["bufferView"]]
    points = np.frombuffer(data, "<f4", 3 * accessor["count"], start + view.get("byteOffset", 0)).reshape(-1, 3)
    if "rotation" in node:
        x, y, z, w = node["rotation"]
        points = points.astype(float) @ trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3].T
    return points + np.array(node["translation"])


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".glb"])
def test_exports_into_the_world_are_where_they_belong_to_a_millimetre(runs, tmp_path, suffix):
    """Corners are those of the same file of the capture's own frame, and 500, 5,400 and 0.3 kilometres."""
    folder, _ = runs
    run = open_run(folder / "far_run")
    local = export_soup(run, tmp_path / "local.ply", exported(up="keep", sky="none"))
    placed = export_soup(run, tmp_path / f"placed{suffix}", exported(place="world", sky="none"))
    table = read_ply_tables(local.path)["vertex"]
    expected = np.stack([table[axis].astype(float) for axis in "xyz"], axis=1) + OFFSET
    assert np.abs(corners_of(placed.path) - expected).max() < MILLIMETRE
    assert placed.transform.translation.tolist() == list(OFFSET)


def test_a_world_with_z_up_stands_upright_in_glb(runs, tmp_path):
    """(x, y, z) becomes (x, z, -y), by the node alone."""
    folder, _ = runs
    run = open_run(folder / "far_run")
    said = Georeference(OFFSET, 2.0, "z", "EPSG:25832")
    notes = {**run.soup.notes, "georeference": said.to_json()}
    object.__setattr__(run.soup, "notes", notes)
    flat = export_soup(run, tmp_path / "flat.ply", exported(place="world", sky="none"))
    upright = export_soup(run, tmp_path / "upright.glb", exported(place="world", sky="none"))
    world = corners_of(flat.path)
    assert np.abs(corners_of(upright.path) - world[:, [0, 2, 1]] * [1, 1, -1]).max() < MILLIMETRE
    turned = export_soup(run, tmp_path / "turned.ply", exported(sky="none"))  # +y up, by the record, not the cameras
    table = read_ply_tables(turned.path)["vertex"]
    local = (world - OFFSET) / 2
    assert np.abs(np.stack([table[a] for a in "xyz"], axis=1) - local[:, [0, 2, 1]] * [1, 1, -1]).max() < MILLIMETRE


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_what_was_placed_in_the_world_comes_back_to_its_capture(runs, tmp_path, suffix, up):
    """To less than a millimetre, which float32 coordinates of the world could not hold; and still knows the world."""
    folder, _ = runs
    run = open_run(folder / "far_run")
    said = Georeference(OFFSET, 2.0, up, "EPSG:25832")
    object.__setattr__(run.soup, "notes", {**run.soup.notes, "georeference": said.to_json()})
    local = export_soup(run, tmp_path / "local.ply", exported(up="keep", sky="none"))
    placed = export_soup(run, tmp_path / f"placed{suffix}", exported(place="world", sky="none"))
    opened = open_run(placed.path)
    assert torch.allclose(opened.soup.vertices, load_soup(local.path).vertices, rtol=0, atol=MILLIMETRE)
    again = export_soup(opened, tmp_path / "again.ply", exported(place="world"))
    assert np.abs(again.transform.translation.numpy() - OFFSET).max() < MILLIMETRE


def test_a_soup_on_its_own_still_knows(runs, tmp_path):
    """The file alone, without its run and its capture, goes to the world; and says in a file how."""
    folder, _ = runs
    (tmp_path / "soup.safetensors").write_bytes((folder / "far_run" / "soup.safetensors").read_bytes())
    run = open_run(tmp_path / "soup.safetensors")
    placed = export_soup(run, tmp_path / "placed.ply", exported(place="world", colors="constant"))
    assert np.abs(corners_of(placed.path) - FAR).max() < 100
    head = placed.path.read_bytes()[:4000].decode("ascii", errors="ignore")
    assert '"crs": "EPSG:25832"' in head


def test_what_has_no_place_in_the_world_says_so(runs, tmp_path):
    folder, _ = runs
    with pytest.raises(InputError, match=r"does not say where it lies in the world; write georeference\.json"):
        export_soup(open_run(folder / "home_run"), tmp_path / "a.ply", exported(place="world"))
    with pytest.raises(InputError, match="keeps the units and axes of the capture"):
        export_soup(open_run(folder / "far_run"), tmp_path / "a.etz", exported(place="world"))
