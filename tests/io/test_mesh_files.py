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
from etsplat.io._gltf import join_gltf, split_gltf
from etsplat.io.georeference import Georeference
from etsplat.io.mesh_files import MeshFile, load_mesh, save_mesh, save_triangles, weld_vertices
from etsplat.io.srgb import linear_from_srgb, srgb_from_linear

PLY_HEADER = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
OFF = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n"


@pytest.fixture
def ball():
    vertices, faces = icosphere(2)
    colors = torch.randint(0, 256, (len(faces), 3), generator=torch.Generator().manual_seed(1)).float() / 255
    return vertices, faces, colors


def glb_json(path):
    data = path.read_bytes()
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])


def test_ply_returns_the_same_mesh_and_8_bit_face_colours_exactly(tmp_path, ball):
    save_mesh(tmp_path / "a.ply", *ball)
    mesh = load_mesh(tmp_path / "a.ply")
    assert torch.equal(mesh.vertices, ball[0])
    assert torch.equal(mesh.faces, ball[1])
    assert mesh.face_colors is not None
    torch.testing.assert_close(mesh.face_colors, ball[2], atol=1e-7, rtol=0)
    assert mesh.notes == ()


def test_ply_with_face_colours_has_their_means_at_vertices_for_programs_that_read_no_others(tmp_path, ball):
    """trimesh, like Blender and Open3D, shows colours of vertices where a file has both."""
    vertices, faces, colors = ball
    save_mesh(tmp_path / "a.ply", vertices, faces, colors)
    shown = trimesh.load_mesh(str(tmp_path / "a.ply"), process=False).visual
    assert shown.kind == "vertex"
    touches = (faces == 7).any(dim=1)
    corners = vertices[faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
    expected = (colors * area[:, None])[touches].sum(0) / area[touches].sum()
    np.testing.assert_allclose(shown.vertex_colors[7, :3] / 255, expected, atol=0.6 / 255)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_welded_export_keeps_connectivity_and_averages_colours_by_area(tmp_path, ball, suffix):
    vertices, faces, colors = ball
    save_mesh(tmp_path / f"a{suffix}", vertices, faces, colors)
    mesh = load_mesh(tmp_path / f"a{suffix}")
    assert torch.equal(mesh.faces, faces)
    torch.testing.assert_close(mesh.vertices, vertices, atol=1e-7, rtol=0)
    corners = vertices[faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
    touches = (faces == 7).any(dim=1)
    expected = (colors * area[:, None])[touches].sum(0) / area[touches].sum()
    assert mesh.vertex_colors is not None
    torch.testing.assert_close(mesh.vertex_colors[7], expected, atol=0.02 if suffix == ".glb" else 1e-5, rtol=0)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_split_export_has_three_vertices_per_face_in_its_exact_colour(tmp_path, ball, suffix):
    vertices, faces, colors = ball
    bright = 0.3 + 0.7 * colors  # trimesh reads GLB colours in 8 bits of linear light, coarse where dark
    save_mesh(tmp_path / f"a{suffix}", vertices, faces, bright, split=True)
    mesh = load_mesh(tmp_path / f"a{suffix}")
    assert len(mesh.vertices) == 3 * len(faces)
    assert mesh.vertex_colors is not None
    torch.testing.assert_close(mesh.vertices[mesh.faces], vertices[faces], atol=1e-7, rtol=0)
    torch.testing.assert_close(
        mesh.vertex_colors[mesh.faces],
        bright[:, None].expand(-1, 3, 3),
        atol=0.005 if suffix == ".glb" else 1e-5,
        rtol=0,
    )


def test_glb_holds_linear_colours_under_an_unlit_two_sided_material(tmp_path, ball):
    """Viewers apply the sRGB curve to COLOR_0, so that 0.5 as displayed is stored as 0.214.

    Its alpha is there and 1: programs that read with Assimp take one that is missing for 0 (assimp/assimp#3473).
    """
    save_mesh(tmp_path / "a.glb", ball[0], ball[1], torch.full_like(ball[2], 0.5))
    document = glb_json(tmp_path / "a.glb")
    offset = 28 + struct.unpack("<I", (tmp_path / "a.glb").read_bytes()[12:16])[0]
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert accessor["type"] == "VEC4"
    view = document["bufferViews"][accessor["bufferView"]]
    stored = np.frombuffer((tmp_path / "a.glb").read_bytes(), "<f4", 4 * accessor["count"], offset + view["byteOffset"])
    np.testing.assert_allclose(stored.reshape(-1, 4), [[0.2140411] * 3 + [1]] * accessor["count"], atol=1e-6)
    assert document["materials"][0]["doubleSided"]
    assert "KHR_materials_unlit" in document["materials"][0]["extensions"]


def test_what_is_imported_from_a_glb_has_the_name_of_the_file(tmp_path, ball):
    save_mesh(tmp_path / "kitchen.glb", *ball)
    document = glb_json(tmp_path / "kitchen.glb")
    assert document["nodes"][0]["name"] == document["meshes"][0]["name"] == "kitchen"
    assert document["materials"][0]["name"] == "opaque"


def test_the_srgb_curves_are_inverse_to_each_other_and_meet_known_values():
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-7)
    np.testing.assert_allclose(
        linear_from_srgb(np.array([0.0, 0.04045, 0.5, 1.0])), [0, 0.0031308, 0.2140411, 1], atol=1e-7
    )


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_a_mesh_without_colours_returns_without_colours(tmp_path, ball, suffix):
    save_mesh(tmp_path / f"a{suffix}", *ball[:2])
    mesh = load_mesh(tmp_path / f"a{suffix}")
    assert mesh.face_colors is None
    assert mesh.vertex_colors is None or bool((mesh.vertex_colors == mesh.vertex_colors[0]).all())
    assert (
        "COLOR_0" not in glb_json(tmp_path / "a.glb")["meshes"][0]["primitives"][0]["attributes"]
        if suffix == ".glb"
        else 1
    )


@pytest.mark.parametrize("name", ["a.stl", "ascii.stl", "a.off", "a.ply", "ascii.ply", "a.glb", "a.obj"])
def test_files_of_other_writers_are_read(tmp_path, ball, name):
    solid = trimesh.Trimesh(ball[0].numpy(), ball[1].numpy(), process=False)
    if name == "ascii.ply":
        solid.export(tmp_path / name, encoding="ascii")
    else:
        solid.export(tmp_path / name, file_type="stl_ascii" if name == "ascii.stl" else None)
    mesh = weld_vertices(load_mesh(tmp_path / name))
    assert mesh.faces.shape == ball[1].shape
    assert mesh.vertices.shape == ball[0].shape
    torch.testing.assert_close(mesh.vertices[mesh.faces], ball[0][ball[1]], atol=1e-6, rtol=0)


def test_obj_with_texture_indices_and_negative_indices_keeps_its_connectivity(tmp_path):
    (tmp_path / "a.obj").write_text(
        "# a comment\nmtllib absent.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 1\nvn 0 0 1\n"
        "f 1/1/1 2/2/1 3/1/1\nf -4 -1 -3\nf 1//1 3//1 4//1\n"
    )
    mesh = load_mesh(tmp_path / "a.obj")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 3, 1], [0, 2, 3]]


@pytest.mark.parametrize("name", ["quad.obj", "quad.ply"])
def test_polygons_are_cut_into_triangles_and_the_note_says_so(tmp_path, name):
    points = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]
    if name == "quad.obj":
        (tmp_path / name).write_text("".join(f"v {p}\n" for p in points) + "f 1 2 3 4\n")
    else:
        (tmp_path / name).write_text(PLY_HEADER.format(4, 1) + "\n".join(points) + "\n4 0 1 2 3\n")
    mesh = load_mesh(tmp_path / name)
    assert mesh.faces.shape == (2, 3)
    assert "cut into 2 triangles" in mesh.notes[0]


def test_faces_without_area_repeated_faces_and_loose_vertices_are_dropped_with_notes(tmp_path):
    (tmp_path / "a.obj").write_text("v 9 9 9\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 2 3 4\nf 3 4 2\nf 2 3 5\nf 2 2 3\n")
    mesh = load_mesh(tmp_path / "a.obj")
    assert mesh.faces.tolist() == [[0, 1, 2]]
    assert mesh.vertices.shape == (3, 3)
    assert [note.split()[0] for note in mesh.notes] == ["2", "1", "2"]


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


def test_off_has_colours_of_faces_and_counts_behind_its_first_word(tmp_path):
    """Of a quadrilateral both triangles have its colour; whole numbers go up to 255, fractions to 1."""
    points = "0 0 0 # the first\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n"
    (tmp_path / "a.off").write_text(f"OFF 5 2 0\n{points}4 0 1 2 3 255 0 51\n3 0 1 4 0 0 0 128\n")
    mesh = load_mesh(tmp_path / "a.off")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4]]
    torch.testing.assert_close(mesh.face_colors, torch.tensor([[1, 0, 0.2], [1, 0, 0.2], [0, 0, 0]]))
    assert mesh.notes == ("2 polygons were cut into 3 triangles",)
    (tmp_path / "a.off").write_text(f"OFF\n5 2 0\n{points}4 0 1 2 3 1 0 0.2\n3 0 1 4 0 0 7\n")
    torch.testing.assert_close(
        load_mesh(tmp_path / "a.off").face_colors, torch.tensor([[1, 0, 0.2], [1, 0, 0.2], [0, 0, 1]])
    )
    (tmp_path / "a.off").write_text(f"OFF\n5 2 0\n{points}4 0 1 2 3 1 0 0\n3 0 1 4\n")
    assert load_mesh(tmp_path / "a.off").face_colors is None


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
    data = (tmp_path / "a.glb").read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    document = glb_json(tmp_path / "a.glb")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "b.bin").write_bytes(data[28 + size :])
    (tmp_path / "secret.bin").write_bytes(data[28 + size :])
    for name in ("b.bin", uri):
        document["buffers"][0]["uri"] = name
        (tmp_path / "in" / "a.gltf").write_text(json.dumps(document))
        if name != uri:
            assert len(load_mesh(tmp_path / "in" / "a.gltf").vertices) == len(ball[0])
    with pytest.raises(InputError, match=r"a\.gltf"):
        load_mesh(tmp_path / "in" / "a.gltf")


def test_a_glb_whose_surface_is_in_an_extension_that_is_not_read_says_which(tmp_path, ball):
    """Draco's arrays were read as zeros, of which all faces had no area; of copies the first one was there."""
    trimesh.Trimesh(ball[0].numpy(), ball[1].numpy(), process=False).export(tmp_path / "whole.glb")
    data = (tmp_path / "whole.glb").read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    (tmp_path / "b.bin").write_bytes(data[28 + size :])

    def load(edit):
        document = json.loads(data[20 : 20 + size])
        document["buffers"][0]["uri"] = "b.bin"
        edit(document)
        (tmp_path / "a.gltf").write_text(json.dumps(document))
        return load_mesh(tmp_path / "a.gltf")

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
    with pytest.raises(InputError, match=r"a\.gltf: is compressed by Draco .*export it without compression"):
        load(draco)
    with pytest.raises(InputError, match=r"a\.gltf: places copies of its meshes by EXT_mesh_gpu_instancing"):
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
    data = (tmp_path / "a.glb").read_bytes()
    document, _ = split_gltf(data)
    edit(document)
    (tmp_path / "b.glb").write_bytes(join_gltf(data, document))
    assert load_mesh(tmp_path / "a.glb").notes == ()
    said = "b.glb: skins and morph targets are ignored; it is as it is without them, not posed"
    assert load_mesh(tmp_path / "b.glb").notes == (said,)


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
    data = (tmp_path / "a.glb").read_bytes()
    document, _ = split_gltf(data)
    edit(document)
    (tmp_path / "a.glb").write_bytes(join_gltf(data, document))
    with pytest.raises(InputError, match=rf"a\.glb: {said}"):
        load_mesh(tmp_path / "a.glb")


def test_a_folder_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="is a folder"):
        load_mesh(tmp_path)


def test_save_mesh_names_the_wrong_argument(tmp_path, ball):
    vertices, faces, colors = ball
    with pytest.raises(ValueError, match="vertices: expected finite"):
        save_mesh(tmp_path / "a.ply", vertices * torch.nan, faces)
    with pytest.raises(ValueError, match="faces: expected indices"):
        save_mesh(tmp_path / "a.ply", vertices[:5], faces)
    with pytest.raises(ValueError, match="face_colors: expected shape"):
        save_mesh(tmp_path / "a.ply", vertices, faces, colors[:-1])
    with pytest.raises(ValueError, match="faces: expected whole numbers"):
        save_mesh(tmp_path / "a.ply", vertices, faces.float())
    for bright in ((255 * colors).byte(), 255 * colors):
        with pytest.raises(ValueError, match=r"face_colors: expected floating-point display values in \[0, 1\]"):
            save_mesh(tmp_path / "a.ply", vertices, faces, bright)
    with pytest.raises(ValueError, match="path: expected one of the suffixes"):
        save_mesh(tmp_path / "a.xyz", vertices, faces)
    assert list(tmp_path.iterdir()) == []


def test_the_shared_meshes_load_without_repairs(shared_data):
    for path in sorted((shared_data / "famous").glob("*.obj"))[:3]:
        assert load_mesh(path).notes == ()


def test_a_sky_needs_a_kind_of_file_with_room_for_two_objects(tmp_path):
    """And is some of the triangles."""
    vertices, colors = torch.rand(4, 3, 3), torch.rand(4, 3)
    some = torch.tensor([True, False, True, False])
    with pytest.raises(ValueError, match=r"expected one of the suffixes \.glb, \.obj, got a\.ply"):
        save_triangles(tmp_path / "a.ply", vertices, colors, sky=some)
    for wrong in (some | True, some & False):
        with pytest.raises(ValueError, match="sky: expected some of 4 triangles, got"):
            save_triangles(tmp_path / "a.glb", vertices, colors, sky=wrong)


def test_a_sky_does_not_blend_where_the_scene_does(tmp_path):
    """With alpha there are three materials: nothing is behind a sky."""
    alpha = torch.tensor([[1.0], [0.5], [0.5], [1.0]])
    colors, sky = torch.cat([torch.rand(4, 3), alpha], dim=1), torch.tensor([False, False, True, True])
    save_triangles(tmp_path / "a.glb", torch.rand(4, 3, 3), colors, sky=sky)
    document = glb_json(tmp_path / "a.glb")
    found = [(m["name"], m["alphaMode"], m["doubleSided"]) for m in document["materials"]]
    assert found == [("opaque", "OPAQUE", True), ("blend", "BLEND", True), ("sky", "OPAQUE", False)]
    assert [len(mesh["primitives"]) for mesh in document["meshes"]] == [2, 1]
    assert len(load_mesh(tmp_path / "a.glb").faces) == 4


@pytest.mark.parametrize("kind", ["glb", "obj", "ply", "off"])
def test_a_record_does_not_disturb_readers(tmp_path, kind):
    """Names in it may be of any script; OFF has no room for it."""
    vertices, colors = torch.rand(4, 3, 3), torch.rand(4, 3)
    save_triangles(tmp_path / f"a.{kind}", vertices, colors, record={"made": {"by": "Zoë\n", "times": 3}})
    assert torch.equal(load_mesh(tmp_path / f"a.{kind}").vertices, vertices.reshape(-1, 3))
    assert (b'{"by": "Zo\\u00eb\\n"' in (tmp_path / f"a.{kind}").read_bytes()) is (kind in ("obj", "ply"))
    assert len(trimesh.load_mesh(tmp_path / f"a.{kind}", process=False).faces) == 4


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
