"""GLB files are what the specification says, whatever is in them: `etsplat.io.writers.glb`."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.tangents import corner_tangents
from etsplat.io.mesh_files import save_mesh, save_triangles
from etsplat.io.textures import NormalMap, Texture
from etsplat.io.writers import Compression
from helpers.gltf import check_glb, needs_meshopt

VERTICES, FACES = icosphere(1)
CORNERS = VERTICES[FACES]
TONES = torch.linspace(0, 1, 4 * len(FACES)).reshape(-1, 4)
OUTSIDE = torch.arange(2 * len(FACES)) >= len(FACES)
UVS = torch.rand(len(FACES), 3, 2, generator=torch.Generator().manual_seed(0))
COLLAPSED = torch.cat([CORNERS[1:], CORNERS[:1, :1].expand(1, 3, 3)])  # with a triangle of no area


def texture(height: int, width: int) -> Texture:
    picture = torch.arange(3 * height * width).reshape(height, width, 3).to(torch.uint8)
    return Texture.of([picture], torch.zeros(len(FACES), dtype=torch.int64), UVS)


def relief() -> NormalMap:
    normals = VERTICES / VERTICES.norm(dim=1, keepdim=True)
    pixels = torch.tensor([128, 128, 255], dtype=torch.uint8).expand(16, 16, 3).contiguous()
    return NormalMap(pixels, normals[FACES], corner_tangents(VERTICES, FACES, normals, UVS))


Write = Callable[..., None]

WRITES: dict[str, Write] = {
    "plain": lambda path, **more: save_mesh(path, VERTICES, FACES, **more),
    "colours of faces": lambda path, **more: save_mesh(path, VERTICES, FACES, TONES[:, :3], **more),
    "split": lambda path, **more: save_mesh(path, VERTICES, FACES, TONES[:, :3], split=True, **more),
    "white": lambda path, **more: save_mesh(path, VERTICES, FACES, vertex_colors=torch.ones_like(VERTICES), **more),
    "far": lambda path, **more: save_mesh(path, 1e6 * VERTICES + 1e9, FACES, **more),
    "tiny": lambda path, **more: save_mesh(path, 1e-30 * VERTICES, FACES, **more),
    "texture": lambda path, **more: save_mesh(path, VERTICES, FACES, texture=texture(16, 16), **more),
    "odd texture": lambda path, **more: save_mesh(path, VERTICES, FACES, texture=texture(5, 3), mipmaps=False, **more),
    "lit": lambda path, **more: save_mesh(path, VERTICES, FACES, texture=texture(16, 16), normal_map=relief(), **more),
    "soup": lambda path, **more: save_triangles(path, CORNERS, TONES[:, :3], **more),
    "alpha": lambda path, **more: save_triangles(path, CORNERS, TONES, **more),
    "welded": lambda path, **more: save_triangles(path, COLLAPSED, TONES[:, :3], weld=True, **more),
    "sky": lambda path, **more: save_triangles(
        path,
        torch.cat([CORNERS, 9 * CORNERS]),
        torch.cat([TONES, TONES]),
        sky=OUTSIDE,
        record={"crop": None, "a": [1]},
        **more,
    ),
}

COMPRESS = ["none", "quantize", pytest.param("meshopt", marks=needs_meshopt)]


@pytest.mark.parametrize("compress", COMPRESS)
@pytest.mark.parametrize("name", WRITES)
def test_everything_in_a_file_fits_together(tmp_path: Path, name: str, compress: Compression) -> None:
    """Chunks, views, accessors with their bounds, indices, pictures, extensions: by the specification's rules."""
    WRITES[name](tmp_path / "a.glb", compress=compress)
    document = check_glb(tmp_path / "a.glb")
    assert [mesh["name"] for mesh in document["meshes"]] == ["a", *(["sky"] if name == "sky" else [])]


def test_what_has_a_normal_map_is_lit(tmp_path: Path) -> None:
    """No unlit extension; both pictures in one sampler, normals and tangents beside the coordinates."""
    WRITES["lit"](tmp_path / "a.glb")
    document = check_glb(tmp_path / "a.glb")
    (material,) = document["materials"]
    assert "extensions" not in material
    assert (material["pbrMetallicRoughness"]["baseColorTexture"], material["normalTexture"]) == (
        {"index": 0},
        {"index": 1},
    )
    assert len(document["samplers"]) == 1
    (primitive,) = document["meshes"][0]["primitives"]
    assert set(primitive["attributes"]) == {"POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"}
    with pytest.raises(ValueError, match=r"expected one of the suffixes \.glb, got a\.obj"):
        save_mesh(tmp_path / "a.obj", VERTICES, FACES, texture=texture(16, 16), normal_map=relief())


@pytest.mark.parametrize("name", [b'quoted"', "\N{GRINNING FACE} ü".encode(), b"no text \xff"])
def test_names_of_any_file_are_in_json_that_can_be_read(tmp_path: Path, name: bytes) -> None:
    path = tmp_path / os.fsdecode(name + b".glb")
    save_mesh(path, VERTICES, FACES)
    assert check_glb(path)["meshes"][0]["name"] == path.stem


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (b'"max":[0.', b'"max":[3.'),
        (b'"target":34962', b'"target":34963'),
        (b'"KHR_materials_unlit"]', b'"KHR_materials_other"]'),
        (b'"componentType":5123', b'"componentType":5126'),
        (b'"byteOffset":0', b'"byteOffset":4'),
    ],
)
def test_the_check_sees_what_is_wrong(tmp_path: Path, before: bytes, after: bytes) -> None:
    """One change of the document each."""
    save_mesh(tmp_path / "a.glb", 0.9 * VERTICES, FACES, TONES[:, :3])
    data = (tmp_path / "a.glb").read_bytes()
    assert before in data
    (tmp_path / "a.glb").write_bytes(data.replace(before, after, 1))
    with pytest.raises((AssertionError, ValueError)):
        check_glb(tmp_path / "a.glb")
