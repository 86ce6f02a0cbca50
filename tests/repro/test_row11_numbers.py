"""Numbers that cannot be meant are refused by name, before memory or time is spent on them."""

import json
from pathlib import Path

import pytest
import torch

from etsplat import intrinsics
from etsplat.cli.parse import parse
from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.io.mesh_files import load_mesh
from etsplat.ops.rasterize_opaque import render_opaque
from helpers.captures import write_colmap, write_photo, write_transforms
from repro.limits import room_for
from repro.tables import Leak, cases


def option(name: str, value: str):
    def act(folder: Path) -> None:
        corners, faces = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n", "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
        (folder / "mesh.obj").write_text(corners + faces)
        arguments = ["reconstruct", str(folder / "mesh.obj"), "--preset", "tiny", "--out", str(folder / "run")]
        with room_for(2048):
            parse([*arguments, name, value]).run([])

    return act


OPTIONS: list[tuple[str, object, Leak]] = [
    ("resolution", option("--resolution", "60000"), RuntimeError),
    ("supersampling", option("--pictures.supersampling", "100000"), ValueError),
    ("seed", option("--seed", "9" * 23), ValueError),
]


@cases(11, "an option's traceback", OPTIONS)
def test_options(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


def huge_pose(folder: Path) -> object:
    write_transforms(folder, 4)
    document = json.loads((folder / "transforms.json").read_text())
    document["frames"][0]["transform_matrix"][0][3] = 1e308
    (folder / "transforms.json").write_text(json.dumps(document))
    return load_dataset(folder)


def huge_focal_length(folder: Path) -> object:
    write_transforms(folder, 4)
    document = json.loads((folder / "transforms.json").read_text())
    document["fl_x"] = 1e308
    (folder / "transforms.json").write_text(json.dumps(document))
    return load_dataset(folder)


def tiny_photo(folder: Path) -> object:
    write_colmap(folder, [(48, 85)] * 4)
    write_photo(folder / "images" / "0001.jpg", 1, 1)
    return load_dataset(folder)


def unknown_color(folder: Path) -> object:
    (folder / "mesh.obj").write_text("v 0 0 0 nan nan nan\nv 1 0 0 nan nan 1\nv 0 1 0 1e400 -1e400 0\nf 1 2 3\n")
    return load_mesh(folder / "mesh.obj")


def unknown_color_off(folder: Path) -> object:
    (folder / "mesh.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 nan inf 1e999\n")
    return load_mesh(folder / "mesh.off")


@cases(
    11,
    "numbers that cannot be meant are taken",
    [
        ("pose", huge_pose, None),
        ("focal-length", huge_focal_length, None),
        ("1x1-photo", tiny_photo, None),
        ("obj-color", unknown_color, None),
        ("off-color", unknown_color_off, None),
    ],
)
def test_files(act, tmp_path):
    with pytest.raises(InputError):
        act(tmp_path)


@pytest.mark.xfail(strict=True, raises=AssertionError, reason="row 11: width x supersampling wraps")
def test_a_picture_of_too_many_samples_is_refused_by_name():
    view = torch.eye(4)[None], intrinsics(50, 64, 1)[None]
    with pytest.raises(ValueError, match="width"), room_for(4096):
        render_opaque(
            torch.rand(2, 3, 3), cameras=Cameras(*view, 2**27 + 1, 1), face_colors=torch.rand(2, 1), supersampling=16
        )
