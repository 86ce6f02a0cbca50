"""Mesh files that cannot be used, or not as they are: one line says why, before anything large is made of them."""

import json
import struct
import tracemalloc
from contextlib import suppress

import numpy as np
import pytest
import torch
import trimesh

from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.io import _mesh_readers
from etsplat.io.georeference import Georeference
from etsplat.io.mesh_files import MeshFile, load_mesh, save_mesh
from helpers.gltf import change_gltf, read_glb
from helpers.meshes import PLY_HEADER, colored_ball

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
OFF = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n"


@pytest.fixture
def ball():
    return colored_ball()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.ply", None, "no such file"),
        ("a.ply", "", "empty"),
        ("a.obj", "", "empty"),
        ("a.xyz", "0 0 0", "unknown kind"),
        ("a.obj", "# nothing\n", "no vertices"),
        ("a.obj", "v 0 0 0\nv 1 0 0\n", "point cloud"),
        ("a.ply", PLY_HEADER.format(2, 0) + "0 0 0\n1 0 0\n", "point cloud"),
        ("a.obj", "v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", "1 of 3 vertices are not finite"),
        ("a.obj", "v 0 0 0\nv 1 0 1e300\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "there are 3 vertices"),
        ("a.ply", PLY_HEADER.format(3, 1) + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "there are 3 vertices"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", "count from 1"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2", "line 5"),
        ("a.obj", "v 0 0 0\nv 1 0", "line 2"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "zero area"),
        ("a.obj", TRIANGLE + "f 99999999999999999999 2 3\n", "line 4 .*vertex 99999999999999999998"),
        ("a.obj", TRIANGLE + "f -99999999999999999999 2 3\n", "line 4"),
        ("a.obj", TRIANGLE + "f " + "9" * 5000 + " 2 3\n", "line 4"),
        ("a.obj", "v 0 0 0 nan nan nan\nv 1 0 0 1 1 1\nv 0 1 0 0 0 0\nf 1 2 3\n", "1 of 3 vertex colours are not"),
        ("a.obj", "v 0 0 0 1e400 0 0\nv 1 0 0 1 1 1\nv 0 1 0 0 0 0\nf 1 2 3\n", "1 of 3 vertex colours are not"),
        ("a.off", OFF + "3 0 1 2 red green blue\n", "cannot be read as OFF"),
        ("a.off", OFF + "3 0 1 2 nan inf 1e999\n", "1 of 1 face colours are not finite"),
        ("a.off", OFF + "3 0 1\n", "a face of 3 corners with 2"),
        ("a.off", OFF + "2 0 1\n", "a face with 2 corners"),
        ("a.off", OFF + "3 0 1 99999999999999999999\n", "cannot be read as OFF"),
        ("a.off", "OFF\n-3 -1 0\n0 0 0\n", "cannot be read as OFF"),
        ("a.off", f"OFF\n{2**62} {2**62} 0\n0 0 0\n", "cannot be read as OFF"),
        ("a.off", "no mesh\n", "its first word is not OFF"),
        ("a.ply", "ply\nformat ascii 1.0\nelement ver", "cannot be read as PLY"),
        ("a.ply", PLY_HEADER.format(3, "\u0661") + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "cannot be read as PLY"),
        ("a.glb", "no glb at all, just some text", "cannot be read as GLB"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0", "cannot be read as OFF"),
    ],
)
def test_bad_files_are_one_line_input_errors(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message) as raised:
        load_mesh(tmp_path / name)
    assert "\n" not in str(raised.value)
    assert name in str(raised.value)


@pytest.mark.parametrize("name", ["a.ply", "ascii.ply", "a.stl", "a.off", "a.glb"])
@pytest.mark.parametrize("part", [0.02, 0.3, 0.6, 0.99])
def test_a_file_cut_anywhere_is_an_input_error(tmp_path, ball, name, part):
    solid = trimesh.Trimesh(ball[0].numpy(), ball[1].numpy(), process=False)
    solid.export(tmp_path / name, **({"encoding": "ascii"} if name == "ascii.ply" else {}))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(len(data) * part)])
    with pytest.raises(InputError) as raised:
        load_mesh(tmp_path / name)
    assert "\n" not in str(raised.value)


def glb(count, **accessor):
    """Triangles whose accessor has no buffer view, which means zeros: a file of a few hundred bytes."""
    accessor = {"componentType": 5126, "count": count, "type": "VEC3", "min": [0] * 3, "max": [0] * 3, **accessor}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [accessor],
        "bufferViews": [{"buffer": 0, "byteLength": 4}],
        "buffers": [{"byteLength": 4}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s4x", 4, b"BIN\0")
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def ply(vertices, faces):
    header = PLY_HEADER.format(vertices, faces).replace("ascii", "binary_little_endian").encode()
    return header + np.eye(3, dtype="<f4").tobytes() + b"\3" + np.array([0, 1, 2], "<i4").tobytes()


def stl(faces):
    return bytes(80) + struct.pack("<I", faces) + np.zeros(12, "<f4").tobytes() + b"\0\0"


@pytest.mark.parametrize(
    ("suffix", "small", "large"),
    [
        (".glb", glb(3), glb(3 * 10**8)),
        (".glb", glb(3), glb(3 * 10**5)),
        (".glb", glb(3), glb(10**4, bufferView=0)),
        (".glb", glb(3), glb(-(10**9))),
        (".glb", glb(3), glb(3)[:12] + struct.pack("<I", 2**32 - 1) + glb(3)[16:]),
        (
            ".glb",
            glb(3),
            glb(3)[:8] + struct.pack("<I", 2**32 - 1) + glb(3)[12:-8] + struct.pack("<I4s4x", 2**32 - 1, b"BIN\0"),
        ),
        (".ply", ply(3, 1), ply(2**31 - 1, 1)),
        (".ply", ply(3, 1), ply(3, 2**40)),
        (".stl", stl(1), stl(2**32 - 1)),
    ],
)
def test_counts_fit_the_file_before_anything_is_allocated(tmp_path, suffix, small, large):
    """A GLB of 1,220 bytes took 8 GB."""
    (tmp_path / f"small{suffix}").write_bytes(small)
    (tmp_path / f"large{suffix}").write_bytes(large)
    with suppress(InputError):  # imports what reading needs
        load_mesh(tmp_path / f"small{suffix}")
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="large"):
            load_mesh(tmp_path / f"large{suffix}")
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_a_glb_with_vertices_of_four_numbers_is_an_input_error(tmp_path, ball):
    save_mesh(tmp_path / "a.glb", *ball)
    data = (tmp_path / "a.glb").read_bytes()
    swapped = data.replace(b'"POSITION":0,"COLOR_0":1', b'"POSITION":1,"COLOR_0":1')
    assert swapped != data
    (tmp_path / "a.glb").write_bytes(swapped)
    with pytest.raises(InputError, match="vertices of 4 numbers, not 3"):
        load_mesh(tmp_path / "a.glb")


def test_a_scene_of_many_copies_is_refused_before_they_are_made(tmp_path, ball, monkeypatch):
    save_mesh(tmp_path / "a.glb", *ball[:2])
    assert len(load_mesh(tmp_path / "a.glb").vertices) == len(ball[0])
    monkeypatch.setattr(_mesh_readers, "_MOST_VERTICES", len(ball[0]) - 1)
    with pytest.raises(InputError, match="1 nodes have more than"):
        load_mesh(tmp_path / "a.glb")


@pytest.mark.parametrize("uri", ["../secret.bin", "/etc/passwd", "x/../../secret.bin", "absent.bin"])
def test_gltf_reads_no_file_outside_of_its_folder(tmp_path, ball, uri):
    trimesh.Trimesh(ball[0].numpy(), ball[1].numpy(), process=False).export(tmp_path / "a.glb")
    document, buffer = read_glb(tmp_path / "a.glb")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "b.bin").write_bytes(buffer)
    (tmp_path / "secret.bin").write_bytes(buffer)
    for name in ("b.bin", uri):
        document["buffers"][0]["uri"] = name
        (tmp_path / "in" / "a.gltf").write_text(json.dumps(document))
        if name != uri:
            assert len(load_mesh(tmp_path / "in" / "a.gltf").vertices) == len(ball[0])
    with pytest.raises(InputError, match=r"a\.gltf"):
        load_mesh(tmp_path / "in" / "a.gltf")


def test_a_glb_whose_surface_is_in_an_extension_that_is_not_read_says_which(tmp_path, ball):
    """Draco's arrays were read as zeros, of which all faces had no area; of copies the first one was there."""

    def load(edit):
        trimesh.Trimesh(ball[0].numpy(), ball[1].numpy(), process=False).export(tmp_path / "a.glb")
        return load_mesh(change_gltf(tmp_path / "a.glb", edit))

    def draco(document):
        for accessor in document["accessors"]:
            del accessor["bufferView"]
        packed = {"bufferView": 0, "attributes": {"POSITION": 0}}
        document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": packed}
        document["extensionsRequired"] = ["KHR_draco_mesh_compression"]

    def copies(document):
        node = next(node for node in document["nodes"] if "mesh" in node)
        node["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}

    assert len(load(lambda document: None).faces) == len(ball[1])
    with pytest.raises(InputError, match=r"a\.glb: is compressed by Draco .*export it without compression"):
        load(draco)
    with pytest.raises(InputError, match=r"a\.glb: places copies of its meshes by EXT_mesh_gpu_instancing"):
        load(copies)


def test_a_gltf_that_is_posed_says_that_it_is_read_without(tmp_path, ball):
    """Figures stood as they were modelled, without a word."""

    def edit(document):
        first = document["meshes"][0]["primitives"][0]
        first["targets"] = [{"POSITION": first["attributes"]["POSITION"]}]
        document["meshes"][0]["weights"] = [1.0]
        document["skins"] = [{"joints": [0]}]
        document["nodes"][0]["skin"] = 0

    save_mesh(tmp_path / "a.glb", *ball)
    assert load_mesh(tmp_path / "a.glb").notes == ()
    said = "a.glb: skins and morph targets are ignored; it is as it is without them, not posed"
    assert load_mesh(change_gltf(tmp_path / "a.glb", edit)).notes == (said,)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda document: document.update(scenes=[]), "has no scene, .*export it again with one"),
        (lambda document: document.pop("scenes"), "has no scene"),
        (lambda document: document["meshes"][0]["primitives"][0].update(mode=6), "has fans .*export it as triangles"),
    ],
)
def test_a_gltf_of_which_nothing_would_be_there_says_why(tmp_path, ball, edit, said):
    """It was called cut short; fans beside other primitives were left out without a word."""
    save_mesh(tmp_path / "a.glb", *ball)
    change_gltf(tmp_path / "a.glb", edit)
    with pytest.raises(InputError, match=rf"a\.glb: {said}"):
        load_mesh(tmp_path / "a.glb")


def test_a_folder_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="is a folder"):
        load_mesh(tmp_path)


def test_a_mesh_that_32_bits_cannot_hold_is_refused_with_the_reason(tmp_path, ball):
    """A ball in coordinates of maps: most of its faces would have zero area."""
    vertices, faces, _ = ball
    world = Georeference(offset=(500_000.0, 5_400_000.0, 300.0))
    save_mesh(tmp_path / "small.ply", 0.1 * vertices, faces, world=world)
    with pytest.raises(InputError, match=r"too far from the origin for its size: it is 0\.2 across about \(5"):
        load_mesh(tmp_path / "small.ply")
    save_mesh(tmp_path / "large.ply", 1e4 * vertices, faces, world=world)
    assert len(load_mesh(tmp_path / "large.ply").faces) == len(faces)
    (tmp_path / "stray.obj").write_text(f"{TRIANGLE}v 1e9 0.1 0\nf 1 2 3\n")
    assert len(load_mesh(tmp_path / "stray.obj").faces) == 1


@pytest.mark.parametrize("name", ["vertices", "faces", "face_colors", "vertex_colors"])
def test_a_mesh_of_arrays_says_how_to_make_tensors(name):
    """It was noticed somewhere later, in words of torch."""
    vertices, faces = icosphere(0)
    arrays = {"vertices": vertices, "faces": faces, "face_colors": torch.ones(20, 3), "vertex_colors": None}
    arrays[name] = np.ones((12, 3))
    with pytest.raises(ValueError, match=rf"{name} must be a tensor, got ndarray: pass torch\.from_numpy\({name}\)"):
        MeshFile(**arrays)
