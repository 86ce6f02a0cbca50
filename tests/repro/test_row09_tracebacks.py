"""Files that cannot be used are an ``InputError`` in one line, whatever is in them."""

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.io.images import load_image
from etsplat.io.mesh_files import load_mesh
from etsplat.model.soup_import import open_soup
from etsplat.model.triangle_soup import TriangleSoup
from helpers.captures import write_colmap, write_transforms
from repro.tables import NOTHING, Leak, cases

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
INPUTS = Path(__file__).resolve().parents[3] / "shared" / "repro" / "inputs"


def mesh(suffix: str, text: str) -> Callable[[Path], object]:
    def act(folder: Path) -> object:
        path = folder / f"mesh{suffix}"
        path.write_text(text)
        return load_mesh(path)

    return act


@cases(
    9,
    "a mesh file's traceback",
    [
        ("obj-index", mesh(".obj", TRIANGLE + "f 99999999999999999999 2 3\n"), None),
        ("obj-index-negative", mesh(".obj", TRIANGLE + "f -99999999999999999999 2 3\n"), None),
        ("off-color-word", mesh(".off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 red green blue\n"), None),
    ],
)
def test_meshes(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


def transforms(edit: Callable[[dict], object] | bytes) -> Callable[[Path], object]:
    def act(folder: Path) -> object:
        write_transforms(folder, 4)
        path = folder / "transforms.json"
        if isinstance(edit, bytes):
            path.write_bytes(edit)
        else:
            document = json.loads(path.read_text())
            edit(document)
            path.write_text(json.dumps(document))
        return load_dataset(folder)

    return act


def entry(key: str, value: object) -> Callable[[dict], object]:
    return lambda document: document.update({key: value})


def pose(value: object) -> Callable[[dict], object]:
    return lambda document: document["frames"][0].update(transform_matrix=value)


def angle(value: object) -> Callable[[dict], object]:
    def edit(document: dict) -> None:
        del document["fl_x"]
        document["camera_angle_x"] = value

    return edit


@cases(
    9,
    "a traceback of transforms.json",
    [
        ("deep", transforms(b"[" * 100_000), None),
        ("400-digits", transforms(entry("k1", 10**400)), None),
        ("400-digits-focal", transforms(entry("fl_x", 10**400)), None),
        (
            "400-digits-pose",
            transforms(pose([[10**400] * 4] * 4)),
            None,
        ),
        ("nan-width", transforms(entry("w", float("nan"))), None),
        ("infinite-height", transforms(entry("h", float("inf"))), None),
        ("angle-0", transforms(angle(0)), None),
    ],
)
def test_transforms(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


def colmap_points(text: str) -> Callable[[Path], object]:
    def act(folder: Path) -> object:
        write_colmap(folder, [(32, 24)] * 4)
        (folder / "sparse" / "0" / "points3D.txt").write_text(text)
        dataset = load_dataset(folder)
        assert dataset.points is not None
        assert dataset.points.isfinite().all(), "not finite"
        return dataset

    return act


@cases(9, "points of 1e308 are infinite", [("huge", colmap_points("1 1e308 1e308 1e308 0 0 0\n"), None)])
def test_colmap(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


GAUSSIAN = [*"xyz", *(f"f_dc_{k}" for k in range(3)), "opacity"]
GAUSSIAN += [*(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]


def gaussians(properties: list[str]) -> Callable[[Path], object]:
    def act(folder: Path) -> object:
        header = "".join(f"property float {name}\n" for name in properties)
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex 5\n{header}end_header\n"
        path = folder / "gaussians.ply"
        path.write_bytes(head.encode() + np.full((5, len(properties)), 0.1, "<f4").tobytes())
        return open_soup(path)

    return act


def more(count: int) -> list[str]:
    return [*GAUSSIAN, *(f"f_rest_{k}" for k in range(count))]


@cases(
    9,
    "a traceback of a PLY file",
    [
        ("property-twice", gaussians([*GAUSSIAN, "x"]), None),
        ("1-f_rest", gaussians(more(1)), RuntimeError),
        ("4-f_rest", gaussians(more(4)), RuntimeError),
        ("48-f_rest", gaussians(more(48)), ValueError),
    ],
)
def test_gaussian_files(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


def points(fields: str) -> Callable[[Path], object]:
    def act(folder: Path) -> object:
        write_transforms(folder, 4, ply_file_path="points.ply")
        names = fields.split()
        kinds = ["uchar" if name in ("red", "green", "blue") else "float" for name in names]
        header = "".join(f"property {kind} {name}\n" for kind, name in zip(kinds, names, strict=True))
        row = b"".join(b"\1" if kind == "uchar" else struct.pack("<f", 0.5) for kind in kinds)
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex 3\n{header}end_header\n"
        (folder / "points.ply").write_bytes(head.encode() + 3 * row)
        return load_dataset(folder)

    return act


@cases(
    9,
    "a traceback of the points' PLY file",
    [
        ("property-twice", points("x y z x red green blue"), None),
    ],
)
def test_point_files(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


def exported(
    corners: str = "xyz", colors: tuple[str, ...] = ("f_dc_0", "f_dc_1", "f_dc_2")
) -> Callable[[Path], object]:
    """A triangle as `etsplat export` writes soups, without some of its properties."""

    def act(folder: Path) -> object:
        of_face = [*(f"property float {name}" for name in ("opacity", "sigma", *colors))]
        lines = ["ply", "format binary_little_endian 1.0", "comment etsplat elastic sdf", "element vertex 3"]
        lines += [*(f"property float {name}" for name in corners), "element face 1"]
        lines += ["property list uchar int vertex_indices", *of_face, "end_header", ""]
        table = np.eye(3, dtype="<f4")[:, : len(corners)].tobytes()
        face = b"\3" + np.array([0, 1, 2], "<i4").tobytes() + np.full(len(of_face), 0.5, "<f4").tobytes()
        (folder / "soup.ply").write_bytes("\n".join(lines).encode() + table + face)
        return open_soup(folder / "soup.ply")

    return act


@cases(
    9,
    "a traceback of an exported soup",
    [
        ("without-z", exported(corners="xy"), ValueError),
        ("without-f_dc_2", exported(colors=("f_dc_0", "f_dc_1")), ValueError),
    ],
)
def test_exported_files(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


def safetensors(change: Callable[[dict, dict], object]) -> Callable[[Path], object]:
    """A soup with another appearance or background, opened and drawn."""

    def act(folder: Path) -> object:
        path = folder / "soup.safetensors"
        generator = torch.Generator().manual_seed(0)
        corners = torch.randn(5, 3, 3, generator=generator)
        colors = torch.rand(5, 3, generator=generator)
        TriangleSoup.from_triangles(corners, colors, opacity=0.5, sigma=0.3, sh_degree=0).save(path)
        with safe_open(path, "pt") as opened:
            metadata = dict(opened.metadata())
        written, appearance = metadata["appearance"], json.loads(metadata["appearance"])
        change(metadata, appearance)
        if metadata["appearance"] == written:
            metadata["appearance"] = json.dumps(appearance)
        save_file(load_file(path), path, metadata=metadata)
        return open_soup(path)

    return act


def appearing(**entries: object) -> Callable[[dict, dict], object]:
    return lambda metadata, appearance: appearance.update(entries)


@cases(
    9,
    "a soup with a wrong appearance or background is taken, or its traceback shown",
    [
        ("appearance-list", safetensors(lambda metadata, _: metadata.update(appearance="[1, 2]")), AttributeError),
        ("near-plane", safetensors(appearing(near_plane=-1)), NOTHING),
        ("near-plane-word", safetensors(appearing(near_plane="x")), NOTHING),
        ("background", safetensors(appearing(background=[math.nan, 0, 0])), NOTHING),
        ("background-deep", safetensors(lambda metadata, _: metadata.update(appearance="[" * 100_000)), RecursionError),
    ],
)
def test_soups(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


def checkpoint(**entries: object) -> Callable[[Path], object]:
    def act(folder: Path) -> object:
        path, n = folder / "point_cloud_state_dict.pt", 10
        state = {
            "triangles_points": torch.randn(n, 3, 3),
            "sigma": torch.zeros(n, 1),
            "opacity": torch.zeros(n, 1),
            "features_dc": torch.zeros(n, 1, 3),
            "features_rest": torch.zeros(n, 15, 3),
            "active_sh_degree": 3,
        }
        torch.save({**state, **entries}, path)
        return open_soup(path)

    return act


@cases(
    9,
    "odd entries of Triangle Splatting's file: tracebacks",
    [
        ("degree-infinite", checkpoint(active_sh_degree=float("inf")), OverflowError),
        ("points-scalar", checkpoint(triangles_points=torch.tensor(1.0)), TypeError),
    ],
)
def test_triangle_splatting_files(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


FOUND: list[tuple[str, Leak | None]] = [
    ("colmap_txt_OSError_frames.py_143_sparse_0_images.txt", None),
    ("eply_ValueError_ply_tables.py_71", None),
    ("eply_ValueError_soup_import.py_108", ValueError),
    ("eply_ValueError_soup_import.py_168", ValueError),
    ("eply_ValueError_soup_import.py_98", ValueError),
    ("gply_ValueError_ply_tables.py_71", None),
    ("image_NotImplementedError_images.py_167", None),
    ("image_RuntimeError_images.py_167", None),
    ("image_RuntimeError_images.py_182", None),
    ("image_ValueError_images.py_167", None),
    ("json_OverflowError_transforms.py_263_transforms.json", None),
    ("json_OverflowError_transforms.py_280_transforms.json", None),
    ("mesh_OverflowError__mesh_readers.py_57.obj", None),
    ("points_ValueError_ply_tables.py_71_points.ply", None),
]


def damaged(name: str) -> Callable[[Path], object]:
    """A file that mutations found, in the place of a good one."""

    def act(folder: Path) -> object:
        content = (INPUTS / name).read_bytes()
        kind = name.split("_")[0]
        if kind == "colmap":
            write_colmap(folder, [(32, 24)] * 4)
            (folder / "sparse" / "0" / "images.txt").write_bytes(content)
            return load_dataset(folder)
        if kind == "json":
            write_transforms(folder, 4)
            (folder / "transforms.json").write_bytes(content)
            return load_dataset(folder)
        if kind == "points":
            write_transforms(folder, 4, ply_file_path="points.ply")
            (folder / "points.ply").write_bytes(content)
            return load_dataset(folder)
        suffix, reader = {
            "eply": (".ply", open_soup),
            "gply": (".ply", open_soup),
            "image": (".png", load_image),
            "mesh": (".obj", load_mesh),
        }[kind]
        (folder / f"x{suffix}").write_bytes(content)
        return reader(folder / f"x{suffix}")

    return act


@pytest.mark.skipif(not INPUTS.is_dir(), reason="the damaged files of ../shared/repro/inputs are not there")
@cases(9, "a damaged file's traceback", [(name, damaged(name), leak) for name, leak in FOUND])
def test_damaged_files(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)
