"""Soups from files of other programs, which may say anything."""

import json
import math
import struct
import zipfile

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from etsplat.core.errors import InputError
from etsplat.model.soup_import import load_soup
from etsplat.model.triangle_soup import TriangleSoup

GAUSSIAN = [*"xyz", *(f"f_dc_{k}" for k in range(3)), "opacity"]
GAUSSIAN += [*(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
DC = ("f_dc_0", "f_dc_1", "f_dc_2")


def rest(count):
    return [f"f_rest_{k}" for k in range(count)]


def write_gaussians(path, properties):
    header = "".join(f"property float {name}\n" for name in properties)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 5\n{header}end_header\n"
    path.write_bytes(head.encode() + np.full((5, len(properties)), 0.1, "<f4").tobytes())


def test_of_a_file_that_holds_no_soup_all_kinds_are_told_that_do(tmp_path):
    """Not those of meshes alone."""
    (tmp_path / "notes.txt").touch()
    with pytest.raises(InputError, match=r"soup .*notes\.txt: .* \.safetensors, \.etz, \.pt, .*\.glb.* a run's folder"):
        load_soup(tmp_path / "notes.txt")


@pytest.mark.parametrize("count", [0, 9, 24, 45])
def test_a_gaussian_scene_may_have_harmonics_of_any_degree(tmp_path, count):
    write_gaussians(tmp_path / "gaussians.ply", [*GAUSSIAN, *rest(count)])
    assert load_soup(tmp_path / "gaussians.ply").sh_rest.shape == (5, count // 3, 3)


def test_flat_gaussians_have_two_axes(tmp_path):
    """As 2DGS writes them: they were refused. Those with a thin third axis are the same triangles."""
    flat = [name for name in GAUSSIAN if name != "scale_2"]
    values = np.random.default_rng(2).normal(size=(5, len(flat))).astype("<f4")
    for name, names in (("flat", flat), ("thin", [*flat, "scale_2"])):
        header = "".join(f"property float {each}\n" for each in names)
        rows = values if name == "flat" else np.hstack([values, np.full((5, 1), -20.0, "<f4")])
        text = f"ply\nformat binary_little_endian 1.0\nelement vertex 5\n{header}end_header\n"
        (tmp_path / f"{name}.ply").write_bytes(text.encode() + rows.tobytes())
    flat_soup, thin_soup = (load_soup(tmp_path / f"{name}.ply") for name in ("flat", "thin"))
    torch.testing.assert_close(flat_soup.vertices, thin_soup.vertices, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ([*GAUSSIAN, "x"], "'x' occurs more than once"),
        ([*GAUSSIAN, *rest(1)], "has 1 properties f_rest"),
        ([*GAUSSIAN, *rest(4)], "has 4 properties f_rest"),
        ([*GAUSSIAN, *rest(48)], "has 48 properties f_rest"),
        ([*GAUSSIAN, *rest(10)[1:]], "lacks the property f_rest_0"),
        ([name for name in GAUSSIAN if name != "z"], "lacks the property z"),
        (["packed_position", "packed_color"], "holds compressed Gaussians, .*save it as plain PLY"),
        ([name for name in GAUSSIAN if name != "rot_3"], "lacks the property rot_3"),
        ([name for name in GAUSSIAN if name != "f_dc_1"], "lacks the property f_dc_1"),
    ],
)
def test_a_gaussian_scene_with_other_properties_is_refused_by_name(tmp_path, properties, message):
    write_gaussians(tmp_path / "gaussians.ply", properties)
    with pytest.raises(InputError, match=rf"gaussians\.ply.*{message}"):
        load_soup(tmp_path / "gaussians.ply")


@pytest.mark.parametrize(
    ("corners", "colors", "message"),
    [
        ("xyz", DC, None),
        ("xyz", ("red", "green", "blue"), None),
        ("xy", DC, "lacks the property z"),
        ("xyz", DC[:2], "lacks the property f_dc_2"),
        ("xyz", ("green", "blue"), "lacks the property red"),
        ("xyz", (), "lacks the property red"),
        ("xyz", (*DC, "opacity"), "'opacity' occurs more than once"),
    ],
)
def test_an_exported_soup_without_a_property_is_refused_by_name(tmp_path, corners, colors, message):
    of_face = [*(f"property float {name}" for name in ("opacity", "sigma", *colors))]
    lines = ["ply", "format binary_little_endian 1.0", "comment etsplat elastic sdf", "element vertex 3"]
    lines += [*(f"property float {name}" for name in corners), "element face 1"]
    lines += ["property list uchar int vertex_indices", *of_face, "end_header", ""]
    table = np.eye(3, dtype="<f4")[:, : len(corners)].tobytes()
    face = b"\3" + np.array([0, 1, 2], "<i4").tobytes() + np.full(len(of_face), 0.5, "<f4").tobytes()
    (tmp_path / "soup.ply").write_bytes("\n".join(lines).encode() + table + face)
    if message is None:
        assert len(load_soup(tmp_path / "soup.ply")) == 1
    else:
        with pytest.raises(InputError, match=rf"soup\.ply: .*{message}"):
            load_soup(tmp_path / "soup.ply")


APPEARANCES = [
    {"kernel": None},
    {"kernel": [1]},
    {"distance": "nope"},
    {"distance": None},
    {"sh_degree": 4},
    {"sh_degree": 1.5},
    {"cull_small": "x"},
    {"cull_large": 0},
    {"cull_large": math.nan},
    {"near_plane": -1},
    {"near_plane": "x"},
    {"near_plane": 1e308},
    {"near_plane": 10**400},
    {"background": [math.nan, 0, 0]},
    {"background": [1, 2]},
    {"background": "abc"},
    {"background": {"a": 1, "b": 2, "c": 3}},
    {"opacity_floor": 2},
    {"sigma_ceiling": 0},
]


def rewrite(path, appearance):
    """A soup whose metadata say this of how it is drawn."""
    corners, colors = torch.eye(3).expand(5, 3, 3), torch.full((5, 3), 0.5)
    TriangleSoup.from_triangles(corners, colors, opacity=0.5, sigma=0.3, sh_degree=0).save(path)
    with safe_open(path, "pt") as opened:
        metadata = dict(opened.metadata())
    if isinstance(appearance, dict):
        appearance = json.dumps(json.loads(metadata["appearance"]) | appearance)
    save_file(load_file(path), path, metadata={**metadata, "appearance": appearance})


@pytest.mark.parametrize(
    "appearance", [*APPEARANCES, "[1, 2]", "null", "{", "[" * 100_000], ids=lambda told: str(told)[:40]
)
def test_a_soup_that_cannot_be_drawn_as_it_says_is_refused(tmp_path, appearance):
    path = tmp_path / "soup.safetensors"
    rewrite(path, {"near_plane": 0.5, "background": [0, 0.5, 1], "added_later": "x"})
    assert load_soup(path).appearance.near_plane == 0.5
    rewrite(path, appearance)
    with pytest.raises(InputError, match=r"soup\.safetensors: cannot be read") as raised:
        load_soup(path)
    assert "\n" not in str(raised.value)


def state(**entries):
    n = 10
    return {
        "triangles_points": torch.randn(n, 3, 3),
        "sigma": torch.zeros(n, 1),
        "opacity": torch.zeros(n, 1),
        "features_dc": torch.zeros(n, 1, 3),
        "features_rest": torch.zeros(n, 15, 3),
        "active_sh_degree": 3,
        **entries,
    }


@pytest.mark.parametrize(
    "entries",
    [
        {"active_sh_degree": math.inf},
        {"active_sh_degree": math.nan},
        {"active_sh_degree": -1},
        {"active_sh_degree": 10**30},
        {"active_sh_degree": "x"},
        {"active_sh_degree": None},
        {"triangles_points": torch.tensor(1.0)},
        {"triangles_points": torch.zeros(7, 3, 3)},
        {"triangles_points": torch.empty(10, 3, 3, device="meta")},
        {"triangles_points": torch.randn(10, 9).to_sparse()},
        {"triangles_points": torch.zeros(1).expand(10**8, 3, 3)},
        {"features_rest": torch.zeros(10, 7, 3)},
    ],
    ids=lambda entries: f"{next(iter(entries))}-{str(next(iter(entries.values())))[:20]}",
)
def test_odd_entries_of_triangle_splatting_are_refused(tmp_path, entries):
    """One of them claims 3.6 GB, with a stride of 0."""
    path = tmp_path / "point_cloud_state_dict.pt"
    torch.save(state(), path)
    assert len(load_soup(path)) == 10
    torch.save(state(**entries), path)
    with pytest.raises(InputError, match=r"soup .*\.pt") as raised:
        load_soup(path)
    assert "\n" not in str(raised.value)


def test_a_state_that_unpacks_to_more_than_its_file_is_refused_unread(tmp_path, monkeypatch):
    path, packed = tmp_path / "state.pt", tmp_path / "packed.pt"
    torch.save(state(features_rest=torch.zeros(10**4, 15, 3)), path)
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as smaller:
        for name in archive.namelist():
            smaller.writestr(name, archive.read(name))
    assert packed.stat().st_size < path.stat().st_size / 100
    monkeypatch.setattr(torch, "load", None)
    with pytest.raises(InputError, match=r"packed\.pt: cannot be read"):
        load_soup(packed)


@pytest.mark.parametrize("size", [2**31, 2**63, 2**64 - 1])
def test_a_header_of_safetensors_longer_than_the_file_is_refused(tmp_path, size):
    rewrite(tmp_path / "soup.safetensors", {})
    data = (tmp_path / "soup.safetensors").read_bytes()
    (tmp_path / "soup.safetensors").write_bytes(struct.pack("<Q", size) + data[8:])
    with pytest.raises(InputError, match="cannot be read"):
        load_soup(tmp_path / "soup.safetensors")
