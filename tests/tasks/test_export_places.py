"""Where exported soups lie: sky, crop, up, place and the record of all that."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from etsplat import look_at
from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.data.where_up import held_up, up_of
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.regions import Box, Sphere
from etsplat.geometry.similarity import Similarity, rotation_between
from etsplat.io.export_records import LED_BACK
from etsplat.io.mesh_files import load_mesh
from etsplat.model.soup_import import load_soup
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup, transform_of
from etsplat.tasks.opened_runs import SoupRun, open_run
from helpers.captures import write_colmap
from helpers.exported_soups import CAMERA, UP_AXIS, difference, odd_soup, run_of
from helpers.gltf import check_glb


@pytest.fixture
def soup(rng):
    return odd_soup(rng)


def test_up_is_the_cameras_mean_up_and_becomes_y():
    directions = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64), dim=1)
    eyes = torch.tensor([[3.0, 0, 0], [0, 0, 3.0], [-3.0, 0, 0], [0, 0, -3.0]], dtype=torch.float64)
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    up = held_up(viewmats)
    torch.testing.assert_close(up, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    for direction in [up, *directions]:
        turned = rotation_between(direction, UP_AXIS) @ direction
        torch.testing.assert_close(turned, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


def test_a_capture_that_looks_up_does_not_lean_back_in_exports(tmp_path, soup):
    """As one at a front does whose photos show its roof: the mean of the cameras' own ups is 25 degrees off."""
    write_colmap(tmp_path / "scene", [(33, 24)] * 9)
    turn = torch.linspace(-0.8, 0.8, 9, dtype=torch.float64)
    eyes = torch.stack([4 * turn.sin(), 0 * turn, 4 * turn.cos()], dim=1)
    level = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    viewmats = look_at(eyes, torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64), level)
    run = SoupRun(tmp_path, soup, replace(load_dataset(tmp_path / "scene"), viewmats=viewmats))
    torch.testing.assert_close(
        transform_of(run, ExportConfig(), soup.vertices).rotation @ level, UP_AXIS.double(), atol=1e-6, rtol=0
    )


def scene_with_sky(tmp_path):
    """A soup, and a sphere around it that its notes tell of, its triangles seen from either side."""
    sphere = Surroundings(torch.tensor([1.0, 2.0, 3.0]), 40.0)
    vertices, faces = icosphere(2)
    corners = sphere.middle + 40 * vertices.float()[faces]
    corners[::2] = corners[::2].flip(1)
    near = sphere.middle + torch.randn(50, 1, 3, generator=torch.Generator().manual_seed(2)) + 0.3 * torch.eye(3)
    both = torch.cat([near, corners])
    colors = torch.linspace(0, 1, 3 * len(both)).reshape(-1, 3)
    soup = TriangleSoup.from_triangles(both, colors, opacity=0.9, sigma=0.5, sh_degree=0)
    soup = replace(soup, notes={"sky": sphere.note})
    soup.save(tmp_path / "scene.safetensors")
    return open_run(tmp_path / "scene.safetensors"), sphere


@pytest.mark.parametrize("weld", [False, True])
def test_the_sky_of_a_glb_is_a_node_and_a_material_of_its_own_seen_from_inside(tmp_path, weld):
    """So that one looks through it from outside; everything else is seen from both sides."""
    run, sphere = scene_with_sky(tmp_path)
    written = export_soup(run, tmp_path / "a.glb", ExportConfig(up="keep", weld=weld))
    assert (written.triangles, written.sky, written.removed) == (370, 320, {})
    scene = trimesh.load_scene(tmp_path / "a.glb", process=False)
    assert {name: len(mesh.faces) for name, mesh in scene.geometry.items()} == {"a": 50, "sky": 320}
    inwards = np.cross(*(scene.geometry["sky"].triangles[:, k] - scene.geometry["sky"].triangles[:, 0] for k in (1, 2)))
    towards = sphere.middle.numpy() - scene.geometry["sky"].triangles.mean(axis=1)
    assert ((inwards * towards).sum(axis=1) > 0).all()
    document = check_glb(tmp_path / "a.glb")
    assert [node["name"] for node in document["nodes"]] == ["a", "sky"]
    assert [(m["name"], m["doubleSided"]) for m in document["materials"]] == [("opaque", True), ("sky", False)]
    bounds = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert max(bounds["max"]) < 10  # what a viewer frames is not the sky's
    returned = load_soup(tmp_path / "a.glb")
    drawn = [soup.render_opaque(CAMERA) for soup in (returned, run.soup)]
    assert difference(*drawn) < 6 / 255  # trimesh keeps linear light in 8 bits
    assert float(drawn[0][..., 3].min()) == 1


def test_the_sky_of_an_obj_is_an_object_and_other_kinds_of_files_are_without_it(tmp_path):
    """But for those that etsplat reads again, and unless it is asked for."""
    run, _ = scene_with_sky(tmp_path)
    assert export_soup(run, tmp_path / "a.obj", ExportConfig()).sky == 320
    lines = (tmp_path / "a.obj").read_text().splitlines()
    assert [line for line in lines if line.startswith("o ")] == ["o a", "o sky"]
    assert [line[0] for line in lines[lines.index("o sky") :]].count("f") == 320
    assert torch.equal(load_soup(tmp_path / "a.obj").vertices[:50], run.soup.vertices[:50])
    counts = {}
    for name, config in {
        "a.ply": ExportConfig(),
        "b.ply": ExportConfig(sky="joined"),
        "c.ply": ExportConfig(colors="keep", up="keep"),
        "a.off": ExportConfig(),
        "b.obj": ExportConfig(sky="none"),
        "b.glb": ExportConfig(sky="none"),
        "c.glb": ExportConfig(sky="joined"),
        "b.safetensors": ExportConfig(),
        "c.safetensors": ExportConfig(sky="none"),
    }.items():
        written = export_soup(run, tmp_path / name, config)
        assert written.sky == 0
        assert len(load_soup(tmp_path / name)) == written.triangles == 370 - written.removed.get("sky", 0)
        counts[name] = written.triangles
    with_sky = {name for name, count in counts.items() if count == 370}
    assert with_sky == {"b.ply", "c.ply", "c.glb", "b.safetensors"}
    assert set(counts.values()) == {50, 370}


@pytest.mark.parametrize("kind", ["glb", "obj", "ply"])
def test_the_sky_of_a_file_is_known_where_it_is_read_again(tmp_path, kind):
    """--no-sky left it where it was, without a word, and a second file had it joined with the scene."""
    run, _ = scene_with_sky(tmp_path)
    export_soup(run, tmp_path / f"a.{kind}", ExportConfig(sky="joined", scale=2.0, up="keep"))
    opened = open_run(tmp_path / f"a.{kind}")
    assert export_soup(opened, tmp_path / "b.glb", ExportConfig(up="keep")).sky == 320
    without = export_soup(opened, tmp_path / "c.obj", ExportConfig(sky="none", up="keep"))
    assert (without.triangles, without.removed, without.notes) == (50, {"sky": 320}, (LED_BACK,))


def test_a_sky_that_nobody_knows_is_not_said_to_be_left_out(tmp_path, soup):
    soup.save(tmp_path / "soup.safetensors")
    config = ExportConfig(sky="none", up="keep", min_opacity=0.0)
    unknown = export_soup(open_run(tmp_path / "soup.safetensors"), tmp_path / "a.ply", config).notes
    assert len(unknown) == 1
    assert unknown[0].startswith("no triangle is left out as sky, since nobody knows where that is (scene= names")
    known = replace(soup, notes={"sky": "none"})
    assert export_soup(SoupRun(tmp_path, known, None), tmp_path / "b.ply", config).notes == ()


def test_the_record_leads_from_the_file_back_to_the_capture(tmp_path, soup):
    """Turned, scaled, placed: what GLB has in its asset's extras, PLY and OBJ in comments."""
    write_colmap(tmp_path / "scene", [(33, 24)] * 9)
    run = SoupRun(tmp_path, replace(soup, notes={"sky": "none"}), load_dataset(tmp_path / "scene"))
    config = ExportConfig(colors="constant", min_opacity=0.0, scale=2.5, place="center")
    crop = Sphere((0.0, 0.0, 0.0), 1.5)
    written = export_soup(run, tmp_path / "a.glb", config, crop)
    record = check_glb(tmp_path / "a.glb")["asset"]["extras"]["etsplat"]
    matrix = torch.tensor(record["transform"], dtype=torch.float64)
    assert torch.equal(matrix, written.transform.matrix)
    inside = soup.vertices.mean(dim=1).norm(dim=1) <= 1.5
    mesh = load_mesh(tmp_path / "a.glb")
    back = Similarity.of_matrix(matrix).invert(mesh.vertices[mesh.faces])
    torch.testing.assert_close(back.float(), soup.vertices[inside], rtol=0, atol=1e-5)
    assert record["removed"] == {"crop": int((~inside).sum())}
    assert (record["up"], record["scale"], record["place"], record["clean"]) == ("y", 2.5, "center", False)
    assert (record["sky"], record["crop"]) == ("apart", "sphere:0,0,0,1.5")
    for name in ("a.ply", "a.obj"):
        export_soup(run, tmp_path / name, config, crop)
        comments = [line for line in (tmp_path / name).read_bytes().splitlines()[:20] if b"transform" in line]
        found = json.loads(comments[0].split(b" transform ")[1])
        assert found == record["transform"]
    document = check_glb(tmp_path / "a.glb")
    assert document["nodes"] == [{"mesh": 0, "name": "a"}]


@pytest.mark.parametrize("kind", ["ply", "glb", "obj"])
@pytest.mark.parametrize("compress", ["none", "quantize"])
def test_a_file_that_is_opened_lies_in_the_frame_of_its_capture(tmp_path, soup, kind, compress):
    """Turned, scaled and placed as it is: so that it is compared with the photos, and is not turned twice."""
    if compress != "none" and kind != "glb":
        return
    write_colmap(tmp_path / "scene", [(33, 24)] * 9)
    run = SoupRun(tmp_path, soup, load_dataset(tmp_path / "scene"))
    config = ExportConfig(colors="constant", min_opacity=0.0, scale=2.5, place="center", compress=compress)
    first = export_soup(run, tmp_path / f"a.{kind}", config)
    assert not torch.equal(first.transform.rotation, torch.eye(3, dtype=torch.float64))
    near = {"rtol": 0, "atol": 1e-5 if compress == "none" else 2e-3}
    torch.testing.assert_close(load_soup(first.path).vertices, soup.vertices, **near)
    for scene in (None, tmp_path / "scene"):  # where up is the file says too
        again = export_soup(open_run(first.path, scene), tmp_path / f"b.{kind}", config)
        torch.testing.assert_close(again.transform.rotation, first.transform.rotation)
        torch.testing.assert_close(load_mesh(again.path).vertices, load_mesh(first.path).vertices, rtol=0, atol=5e-3)


@pytest.mark.parametrize("kind", ["ply", "obj"])
def test_where_nobody_knows_up_nothing_is_turned_nor_called_upright(tmp_path, soup, kind):
    """A note says so; the file claimed that +z was up, by which a second export turned it."""
    soup.save(tmp_path / "soup.safetensors")
    told = ExportConfig(up="z", min_opacity=0.0)
    first = export_soup(open_run(tmp_path / "soup.safetensors"), tmp_path / f"a.{kind}", told)
    unknown = "nothing is turned, since nobody knows where up is (scene= names the capture): +z is up if it was before"
    assert first.notes == (unknown,)
    assert not first.transform.moves
    assert load_soup(first.path).notes.get("up") is None
    again = export_soup(open_run(first.path), tmp_path / f"b.{kind}", ExportConfig(up="y"))
    assert not again.transform.moves
    assert again.notes == (unknown.replace("+z", "+y"),)
    assert export_soup(open_run(first.path), tmp_path / f"c.{kind}", ExportConfig(up="keep")).notes == ()
    write_colmap(tmp_path / "scene", [(33, 24)] * 4)
    capture = load_dataset(tmp_path / "scene")
    around = capture.viewmats.clone()
    around[::2, :2] *= -1  # every other camera upside down
    torn = SoupRun(tmp_path, soup, replace(capture, viewmats=around))
    assert up_of(torn.capture) is None
    said = export_soup(torn, tmp_path / f"d.{kind}", told).notes
    assert said == (
        "nothing is turned, since the cameras contradict each other about where up is: +z is up if it was before",
    )


@pytest.mark.parametrize(
    "transform",
    [
        "[[1, 0]]",
        '"abc"',
        "[",
        "NaN",
        "[[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,1]]",
        "[[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]",
    ],
)
def test_a_file_whose_transform_is_damaged_is_refused(tmp_path, soup, transform):
    path = tmp_path / "a.ply"
    export_soup(replace(run_of(soup), path=tmp_path), path, ExportConfig(min_opacity=0.0))
    data = path.read_bytes()
    start = data.index(b"comment transform ") + len(b"comment transform ")
    path.write_bytes(data[:start] + transform.encode() + data[data.index(b"\n", start) :])
    with pytest.raises(InputError, match=r"a\.ply: its record of the export has no usable `transform`; export"):
        load_soup(path)


def test_up_may_be_z_but_in_glb(tmp_path, soup):
    """The cameras' up is +y here: it comes to be +z, and nothing is mirrored."""
    write_colmap(tmp_path / "scene", [(33, 24)] * 9)
    run = SoupRun(tmp_path, soup, load_dataset(tmp_path / "scene"))
    up = up_of(run.capture)
    written = export_soup(run, tmp_path / "a.ply", ExportConfig(up="z", min_opacity=0.0, sky="joined"))
    torch.testing.assert_close(written.transform.rotation @ up, torch.tensor([0.0, 0, 1], dtype=torch.float64))
    turned = (soup.vertices.double() @ written.transform.rotation.T).float()
    mesh = load_mesh(tmp_path / "a.ply")
    assert torch.equal(mesh.vertices[mesh.faces], turned)
    with pytest.raises(
        InputError,
        match=r"a\.glb: files of this kind have \+y up.* out up=\"z\", or choose a path that ends in \.obj or \.off",
    ):
        export_soup(run, tmp_path / "a.glb", ExportConfig(up="z"))


def test_places_are_the_middle_and_the_ground_of_nearly_everything(tmp_path):
    """A stray triangle does not move them; the ground is below the middle, at the lowest parts."""
    grid = torch.cartesian_prod(torch.linspace(10, 14, 20), torch.linspace(3, 4, 20), torch.linspace(-2, 0, 20))
    corners = grid[:, None] + 0.01 * (torch.eye(3) - 1 / 3)
    corners = torch.cat([corners, corners[:1] + 500])
    soup = TriangleSoup.from_triangles(corners, torch.rand(len(corners), 3), opacity=0.9, sigma=0.5, sh_degree=0)
    run = SoupRun(tmp_path, soup, None)
    placed = {
        (place, up): export_soup(run, tmp_path / "a.ply", ExportConfig(place=place, up=up, scale=2.0)).transform
        for place in ("center", "ground")
        for up in ("y", "z")
    }
    for place, up, point in (
        ("center", "y", [12, 3.5, -1]),
        ("center", "z", [12, 3.5, -1]),
        ("ground", "y", [12, 3, -1]),
        ("ground", "z", [12, 3.5, -2]),
    ):
        moved = placed[place, up].apply(torch.tensor([point]))
        torch.testing.assert_close(moved, torch.zeros(1, 3, dtype=torch.float64), rtol=0, atol=0.05)
    with pytest.raises(InputError, match=r'place="ground" needs to know which way is up; take up="y" or "z"$'):
        export_soup(run, tmp_path / "a.ply", ExportConfig(place="ground", up="keep"))


def test_a_soup_for_etsplat_is_cropped_in_the_frame_of_its_capture(tmp_path, soup):
    """Its triangles, appearance and notes are those of the soup; turning or scaling it is refused."""
    run = SoupRun(tmp_path / "x", replace(soup, notes={"iteration": "7"}), None)
    crop = Sphere((0.0, 0.0, 0.0), 1.0)
    written = export_soup(run, tmp_path / "a.safetensors", ExportConfig(), crop)
    returned = load_soup(tmp_path / "a.safetensors")
    assert torch.equal(returned.vertices, soup.vertices[crop.holds(soup.vertices.mean(dim=1))])
    assert (written.triangles, written.removed) == (len(returned), {"crop": 60 - len(returned)})
    assert returned.notes == {"iteration": "7"}
    for changed in ({"scale": 2.0}, {"place": "center"}, {"up": "z"}):
        with pytest.raises(InputError, match="keeps the units and axes of the capture; leave out up, scale and"):
            export_soup(run, tmp_path / "a.safetensors", ExportConfig(**changed))


def test_a_soup_with_nothing_but_a_sky_left_is_an_input_error(tmp_path):
    run, _ = scene_with_sky(tmp_path)
    with pytest.raises(InputError, match="nothing but its sky is left"):
        export_soup(run, tmp_path / "a.glb", ExportConfig(), Box((-99.0, 20.0, -99.0), (99.0, 99.0, 99.0)))


@pytest.mark.usefixtures("command_line")
def test_the_command_says_what_was_left_out_and_why(tmp_path, capsys):
    scene_with_sky(tmp_path)
    words = ["export", str(tmp_path / "scene.safetensors"), "--out", str(tmp_path / "a.glb")]
    assert parse(words).run([]) == 0
    assert "a.glb: 370 triangles, 320 of them in the object sky\n" in capsys.readouterr().out
    assert parse([*words, "--no-sky", "--crop", "box:-99,2,-99,99,99,99"]).run([]) == 0
    text = capsys.readouterr().out
    assert "Left out: 320 of the sky, " in text
    assert " outside of the crop.\n  nothing is turned, since nobody knows where up is " in text
    assert text.count("\n") == 3
    assert parse([*words, "--no-sky", "--up", "keep"]).run([]) == 0
    assert capsys.readouterr().out.endswith("Left out: 320 of the sky.\n")
    with pytest.raises(InputError, match=r"^--crop: is 'box:1,2'; write auto, sphere:X,Y,Z,R or box"):
        parse([*words, "--crop", "box:1,2"]).run([])
    with pytest.raises(InputError, match="name the scene's folder with --scene"):
        parse([*words, "--clean"]).run([])
