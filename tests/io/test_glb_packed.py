"""Quantised and compressed GLB files, and pictures in WebP: how far what is read is from what was written."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.tangents import corner_tangents
from etsplat.io._mesh_readers import READERS
from etsplat.io.georeference import Georeference
from etsplat.io.mesh_files import load_mesh, save_mesh, save_triangles
from etsplat.io.meshopt import checked_size
from etsplat.io.srgb import srgb_from_linear
from etsplat.io.textures import NormalMap, Texture
from helpers.gltf import check_glb, needs_meshopt, read_glb, values_of

VERTICES, FACES = icosphere(2)
PLACED = VERTICES * torch.tensor([3.0, 1.0, 0.2]) + torch.tensor([100.0, -7.0, 0.5])
STEP = float((PLACED.amax(0) - PLACED.amin(0)).max()) / 65535
COLORS = torch.rand(len(VERTICES), 3, generator=torch.Generator().manual_seed(0)) ** 3
UVS = torch.rand(len(FACES), 3, 2, generator=torch.Generator().manual_seed(1))
PACKED = ["quantize", pytest.param("meshopt", marks=needs_meshopt)]


def textured(pixels: Tensor, uvs: Tensor = UVS) -> Texture:
    return Texture.of([pixels], torch.zeros(len(FACES), dtype=torch.int64), uvs)


def smooth_picture(size: int = 64) -> Tensor:
    x = torch.linspace(0, 6, size)
    waves = torch.stack([torch.sin(x)[:, None] + torch.cos(k * x) for k in (1, 2, 3)], dim=-1)
    return (127.5 + 60 * waves).to(torch.uint8)


@pytest.mark.parametrize("compress", PACKED)
def test_positions_and_colours_are_within_half_a_step(tmp_path: Path, compress: str) -> None:
    """Of positions 1/65535 of the longest side; of colours what 16 bits of linear light are as display values."""
    save_mesh(tmp_path / "a.glb", PLACED, FACES, vertex_colors=COLORS, compress=compress)  # pyright: ignore
    read = load_mesh(tmp_path / "a.glb")
    assert read.notes == ()
    assert len(read.vertices) == len(VERTICES)
    assert len(read.faces) == len(FACES)
    distance, nearest = torch.cdist(PLACED.double(), read.vertices.double()).min(dim=1)
    assert nearest.unique().numel() == len(VERTICES)
    moved = (PLACED.double() - read.vertices.double()[nearest]).abs()
    assert moved.max() <= 0.5 * STEP + 100 * 2**-24
    assert distance.max() > 0
    document, buffer = read_glb(tmp_path / "a.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    stored = srgb_from_linear(values_of(document, buffer, attributes["COLOR_0"])[:, :3])
    assert torch.cdist(torch.from_numpy(stored), COLORS.double()).min(dim=1).values.max() < 2e-4
    assert read.vertex_colors is not None
    assert (read.vertex_colors[nearest] - COLORS).abs().max() < 2e-4
    mine = {tuple(sorted(face)) for face in nearest[FACES].tolist()}
    assert mine == {tuple(sorted(face)) for face in read.faces.tolist()}


@pytest.mark.parametrize("compress", PACKED)
def test_a_lit_texture_keeps_its_places_and_normals(tmp_path: Path, compress: str) -> None:
    normals = normalize(VERTICES, dim=1)
    relief = NormalMap(
        torch.full((64, 64, 3), 128, dtype=torch.uint8), normals[FACES], corner_tangents(VERTICES, FACES, normals, UVS)
    )
    path = tmp_path / "a.glb"
    skin = textured(smooth_picture())
    save_mesh(path, PLACED, FACES, texture=skin, normal_map=relief, compress=compress)  # pyright: ignore
    check_glb(path)
    read = load_mesh(path)
    assert read.texture is not None
    known = torch.cat([PLACED[FACES], UVS], dim=-1).reshape(-1, 5)
    found = torch.cat([read.vertices[read.faces], read.texture.corner_uvs], dim=-1).reshape(-1, 5)
    assert torch.cdist(known.double(), found.double()).min(dim=1).values.max() < 2 * STEP
    document, buffer = read_glb(path)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    stored, places = (values_of(document, buffer, attributes[name]) for name in ("NORMAL", "TEXCOORD_0"))
    expected_uvs = np.stack([UVS[..., 0], 1 - UVS[..., 1]], axis=-1).reshape(-1, 2)
    distances, nearest = torch.cdist(torch.from_numpy(expected_uvs).double(), torch.from_numpy(places).double()).min(
        dim=1
    )
    assert distances.max() <= 2**0.5 * 0.5 / 65535 + 1e-7
    found = normalize(torch.from_numpy(stored)[nearest].double(), dim=1)
    cosines = (found * normals[FACES].reshape(-1, 3)).sum(dim=1)
    assert torch.rad2deg(cosines.clamp(-1, 1).acos()).max() < 0.4


@needs_meshopt
def test_compressed_is_the_same_surface_as_quantised(tmp_path: Path) -> None:
    """Bit by bit, in another order; and smaller."""
    for compress in ("none", "quantize", "meshopt"):
        save_mesh(tmp_path / f"{compress}.glb", *icosphere(4), vertex_colors=torch.rand(2562, 3), compress=compress)
    sizes = [(tmp_path / f"{name}.glb").stat().st_size for name in ("none", "quantize", "meshopt")]
    assert sizes[2] < 0.8 * sizes[1]
    assert sizes[1] < 0.75 * sizes[0]
    one, other = (load_mesh(tmp_path / f"{name}.glb") for name in ("quantize", "meshopt"))
    corners = [
        {tuple(sorted(map(tuple, face))) for face in mesh.vertices[mesh.faces].tolist()} for mesh in (one, other)
    ]
    assert corners[0] == corners[1]


def test_coordinates_beyond_a_texture_stay_in_32_bits(tmp_path: Path) -> None:
    save_mesh(tmp_path / "a.glb", VERTICES, FACES, texture=textured(smooth_picture(), 3 * UVS - 1), compress="quantize")
    document = check_glb(tmp_path / "a.glb")
    number = document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    assert document["accessors"][number]["componentType"] == 5126


@pytest.mark.parametrize("compress", PACKED)
def test_places_in_the_world_hold_with_a_grid(tmp_path: Path, compress: str) -> None:
    """The node's translation has the sum in float64; z goes to +y."""
    world = Georeference(offset=(512_000.25, 4_200_000.5, 87.125), up="z")
    save_mesh(tmp_path / "a.glb", PLACED, FACES, world=world, compress=compress)  # pyright: ignore
    (node,) = check_glb(tmp_path / "a.glb")["nodes"]
    x, y, z = (PLACED.amin(0).double() + torch.tensor(world.offset).double()).tolist()
    assert node["translation"] == pytest.approx([x, z, -y], abs=1e-9)
    read = torch.from_numpy(READERS[".glb"](tmp_path / "a.glb").vertices)  # float64; in 32 bits `load_mesh` refuses it
    assert (read.amax(0) - read.amin(0) - (PLACED.amax(0) - PLACED.amin(0))[[0, 2, 1]]).abs().max() < 1e-3


def test_transparency_and_sky_have_grids_of_their_own(tmp_path: Path) -> None:
    corners, tones = VERTICES[FACES], torch.rand(len(FACES), 4)
    outside = torch.arange(2 * len(FACES)) >= len(FACES)
    both = torch.cat([corners, 900 * corners]), torch.cat([tones, tones])
    save_triangles(tmp_path / "a.glb", *both, sky=outside, compress="quantize")
    scene, sky = check_glb(tmp_path / "a.glb")["nodes"]
    assert scene["scale"][0] < 1e-4 < sky["scale"][0]
    assert len(load_mesh(tmp_path / "a.glb").faces) == 2 * len(FACES)


def test_without_the_package_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To write; and, of a file that names the extension, to read."""
    save_mesh(tmp_path / "a.glb", VERTICES, FACES, compress="quantize")
    monkeypatch.setitem(sys.modules, "meshoptimizer", None)
    assert len(load_mesh(tmp_path / "a.glb").faces) == len(FACES)
    with pytest.raises(InputError, match=r"pip install 'etsplat\[compress\]'"):
        save_mesh(tmp_path / "b.glb", VERTICES, FACES, compress="meshopt")
    assert not (tmp_path / "b.glb").exists()
    data = (tmp_path / "a.glb").read_bytes()
    view = b'{"buffer":0,"byteOffset":0,'
    assert view in data
    said = b'{"EXT_meshopt_compression":{"mode":"ATTRIBUTES","byteStride":8,"count":1,"byteLength":8}}'
    packed = b'{"extensions":' + said + b',"buffer":0,"byteOffset":0,'
    longer = data.replace(view, packed, 1)
    length = int.from_bytes(data[12:16], "little") + len(packed) - len(view)
    longer = longer[:12] + length.to_bytes(4, "little") + longer[16:]
    (tmp_path / "a.glb").write_bytes(longer[:8] + len(longer).to_bytes(4, "little") + longer[12:])
    with pytest.raises(InputError, match=r"a\.glb: compressed glTF needs meshoptimizer: pip install"):
        load_mesh(tmp_path / "a.glb")


@pytest.mark.parametrize(
    "said",
    [
        {"mode": "TRIANGLES", "byteStride": 4, "count": 4},
        {"mode": "TRIANGLES", "byteStride": 8, "count": 3},
        {"mode": "INDICES", "byteStride": 1, "count": 3},
        {"mode": "ATTRIBUTES", "byteStride": 6, "count": 3},
        {"mode": "ATTRIBUTES", "byteStride": 260, "count": 3},
        {"mode": "ATTRIBUTES", "byteStride": True, "count": 3},
        {"mode": "ATTRIBUTES", "byteStride": 4, "count": 3, "filter": "QUATERNION"},
        {"mode": "ATTRIBUTES", "byteStride": 12, "count": 3, "filter": "OCTAHEDRAL"},
        {"mode": "ATTRIBUTES", "byteStride": 4, "count": 3, "filter": "OTHER"},
        {"mode": "OTHER", "byteStride": 4, "count": 3},
        {"mode": "ATTRIBUTES", "byteStride": 4, "count": 10**9},
    ],
)
def test_what_the_package_would_write_beyond_its_memory_is_refused(said):
    assert (
        checked_size({"mode": "ATTRIBUTES", "byteStride": 8, "count": 3, "byteLength": 9, "filter": "QUATERNION"}) == 24
    )
    with pytest.raises(ValueError, match="EXT_meshopt_compression: "):
        checked_size({**said, "byteLength": 9})


def test_other_kinds_of_files_hold_none_of_it(tmp_path: Path) -> None:
    for more in ({"compress": "quantize"}, {"pictures": "webp"}):
        with pytest.raises(ValueError, match=r"expected one of the suffixes \.glb, got a\.obj"):
            save_mesh(tmp_path / "a.obj", VERTICES, FACES, **more)
    with pytest.raises(ValueError, match=r"expected one of the suffixes \.glb, got a\.ply"):
        save_triangles(tmp_path / "a.ply", VERTICES[FACES], torch.rand(len(FACES), 3), compress="quantize")


def test_pictures_in_webp_come_back_nearly_as_they_were(tmp_path: Path) -> None:
    """The normal map exactly; the file without them is refused by programs that do not know them."""
    picture, normals = smooth_picture(), normalize(VERTICES, dim=1)
    shades = torch.arange(64 * 64).reshape(64, 64).to(torch.uint8)
    relief = NormalMap(smooth_picture().flip(0), normals[FACES], corner_tangents(VERTICES, FACES, normals, UVS), shades)
    for kind in ("png", "webp"):
        path = tmp_path / f"{kind}.glb"
        save_mesh(path, VERTICES, FACES, texture=textured(picture), normal_map=relief, pictures=kind)
        material = check_glb(path)["materials"][0]
        assert material["occlusionTexture"] == {"index": 2}
        read = load_mesh(path).texture
        assert read is not None
        found = read.picture()
        assert found is not None
        error = (found.float() - picture.float()).square().mean()
        assert error == 0 if kind == "png" else 0 < error < 6
    document = check_glb(tmp_path / "webp.glb")
    assert document["extensionsRequired"] == ["EXT_texture_webp"]
    assert {image["mimeType"] for image in document["images"]} == {"image/webp"}
