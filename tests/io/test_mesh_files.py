"""Meshes in files of each kind come back as they were, and files of other writers are read."""

import struct

import numpy as np
import pytest
import torch
import trimesh

from etsplat.io.mesh_files import load_mesh, save_mesh, save_triangles, weld_vertices
from etsplat.io.srgb import linear_from_srgb, srgb_from_linear
from helpers.gltf import read_glb
from helpers.meshes import PLY_HEADER, colored_ball


@pytest.fixture
def ball():
    return colored_ball()


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
    torch.testing.assert_close(mesh.vertex_colors[7], expected, atol=1e-3 if suffix == ".glb" else 1e-5, rtol=0)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_split_export_has_three_vertices_per_face_in_its_exact_colour(tmp_path, ball, suffix):
    vertices, faces, colors = ball
    dark = 0.1 * colors  # where 8 bits of linear light would be coarse
    save_mesh(tmp_path / f"a{suffix}", vertices, faces, dark, split=True)
    mesh = load_mesh(tmp_path / f"a{suffix}")
    assert len(mesh.vertices) == 3 * len(faces)
    assert mesh.vertex_colors is not None
    torch.testing.assert_close(mesh.vertices[mesh.faces], vertices[faces], atol=1e-7, rtol=0)
    torch.testing.assert_close(
        mesh.vertex_colors[mesh.faces],
        dark[:, None].expand(-1, 3, 3),
        atol=2e-4 if suffix == ".glb" else 1e-5,
        rtol=0,
    )


def test_glb_holds_linear_colours_under_an_unlit_two_sided_material(tmp_path, ball):
    """Viewers apply the sRGB curve to COLOR_0, so that 0.5 as displayed is stored as 0.214.

    Its alpha is there and 1: programs that read with Assimp take one that is missing for 0 (assimp/assimp#3473).
    """
    save_mesh(tmp_path / "a.glb", ball[0], ball[1], torch.full_like(ball[2], 0.5))
    document = read_glb(tmp_path / "a.glb")[0]
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
    document = read_glb(tmp_path / "kitchen.glb")[0]
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
        "COLOR_0" not in read_glb(tmp_path / "a.glb")[0]["meshes"][0]["primitives"][0]["attributes"]
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
    document = read_glb(tmp_path / "a.glb")[0]
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


@pytest.mark.parametrize("corners", ["3 0 1 2", "4 0 1 2 3"])
@pytest.mark.parametrize("names", [("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")])
def test_colours_of_ply_by_other_names(tmp_path, names, corners):
    """They were left out without a word; of triangles and of polygons."""
    properties = "".join(f"property uchar {name}\n" for name in names)
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment property uchar r\nelement vertex 4\nproperty float x\nproperty float y\n"
        f"property float z\n{properties}element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        f"0 0 0 255 51 0\n1 0 0 255 51 0\n1 1 0 255 51 0\n0 1 0 255 51 0\n{corners}\n"
    )
    mesh = load_mesh(tmp_path / "a.ply")
    assert mesh.vertex_colors is not None
    assert torch.allclose(mesh.vertex_colors, torch.tensor([1.0, 0.2, 0.0]))


def test_what_a_node_of_gltf_mirrors_keeps_its_outside(tmp_path):
    import trimesh

    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.icosphere(subdivisions=1), transform=np.diag([-1.0, 1.0, 2.0, 1.0]))
    scene.export(tmp_path / "mirrored.glb")
    mesh = load_mesh(tmp_path / "mirrored.glb")
    volume = torch.linalg.det(mesh.vertices[mesh.faces].double()).sum() / 6
    assert 0.8 < float(volume) / (2 * 4 / 3 * torch.pi) < 1
