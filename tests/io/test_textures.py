"""Textures of OBJ and glTF: which colour each point has, what is left out, and what is refused."""

import base64
import io
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.io.textures import Texture
from helpers.gltf import change_gltf

PICTURE = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], dtype=np.uint8)
"""Red and green above blue and yellow."""
QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "usemtl wood\nf 1/1 2/2 3/3 4/4\n"
MTL = "newmtl wood\nKd 0.2 0.4 0.6\nmap_Kd wood.png\n"


def picture(path: Path, pixels: np.ndarray = PICTURE) -> None:
    Image.fromarray(pixels).save(path)


def png(pixels: np.ndarray = PICTURE) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def obj(folder: Path, mtl: str = MTL, faces: str = FACE, points: str = QUAD) -> MeshFile:
    (folder / "quad.obj").write_text(f"mtllib quad.mtl\n{points}{faces}")
    (folder / "quad.mtl").write_text(mtl)
    return load_mesh(folder / "quad.obj")


def color_at(mesh: MeshFile, x: float, y: float) -> list[int]:
    """The texture's colour at a point of the plane, in 255ths."""
    assert mesh.texture is not None
    corners = mesh.vertices[mesh.faces][..., :2].double()
    for face, (a, b, c) in enumerate(corners):
        edges, point = torch.stack([b - a, c - a], dim=1), torch.tensor([x, y]).double() - a
        s, t = torch.linalg.solve(edges, point).tolist()
        if min(s, t, 1 - s - t) >= -1e-9:
            weights = torch.tensor([[1 - s - t, s, t]])
            return (255 * mesh.texture.colors(torch.tensor([face]), weights)[0]).round().int().tolist()
    raise AssertionError("outside")


def assert_quad(mesh: MeshFile) -> None:
    assert color_at(mesh, 0.25, 0.75) == [255, 0, 0]
    assert color_at(mesh, 0.75, 0.75) == [0, 255, 0]
    assert color_at(mesh, 0.25, 0.25) == [0, 0, 255]
    assert color_at(mesh, 0.75, 0.25) == [255, 255, 0]


def test_an_obj_has_the_colours_of_its_picture_not_times_kd(tmp_path):
    picture(tmp_path / "wood.png")
    mesh = obj(tmp_path)
    assert_quad(mesh)
    assert mesh.notes == ("1 polygons were cut into 2 triangles",)


@pytest.mark.parametrize(
    ("text", "mtl"),
    [
        (f"{QUAD}mtllib quad.mtl\n{FACE}", MTL),
        (f"\ufeffmtllib quad.mtl\n{QUAD}{FACE}", f"\ufeff{MTL}"),
        (f"mtllib quad.mtl\n{QUAD}{FACE}", MTL.replace(" ", "\t")),
        (f"mtllib quad.mtl\n# in C:\\\n{QUAD}usemtl wood\nf 1/1 2/2 \\\n3/3 4/4\n", MTL),
        (f"mtllib quad.mtl\n{QUAD}{FACE}", MTL.replace("wood.png", "C:\\Users\\me\\my wood.png")),
        (f"mtllib quad.mtl\n{QUAD}{FACE}", MTL.replace("wood.png", "/mnt/me/my wood.png")),
    ],
    ids=["materials named late", "byte order mark", "tabs", "a line goes on", "another computer", "another folder"],
)
def test_an_obj_as_programs_write_it_has_its_picture(tmp_path, text, mtl):
    """It was refused as cut short, or white."""
    for name in ("wood.png", "my wood.png"):
        picture(tmp_path / name)
    (tmp_path / "quad.obj").write_text(text, encoding="utf-8")
    (tmp_path / "quad.mtl").write_text(mtl, encoding="utf-8")
    mesh = load_mesh(tmp_path / "quad.obj")
    assert_quad(mesh)
    assert mesh.notes == ("1 polygons were cut into 2 triangles",)


def test_a_material_that_no_library_has_is_said(tmp_path):
    """Its faces were white without a word."""
    picture(tmp_path / "wood.png")
    assert obj(tmp_path, faces=FACE.replace("wood", "Wood")).notes[0] == (
        "faces of materials that no MTL file has are white: 'Wood'"
    )


def test_between_pixels_colours_are_bilinear_and_the_picture_repeats():
    """A point between the centres of red and green, one at the border of last and first column, and one far outside."""
    corners = torch.tensor([[[0.5, 0.75], [0.0, 0.75], [7.25, -3.25]]])
    texture = Texture.of([torch.from_numpy(PICTURE)], torch.tensor([0]), corners)
    found = 255 * texture.colors(torch.zeros(3, dtype=torch.long), torch.eye(3))
    expected = [[127.5, 127.5, 0], [127.5, 127.5, 0], [255, 0, 0]]
    torch.testing.assert_close(found, torch.tensor(expected))


def test_faces_of_other_materials_have_their_colour(tmp_path):
    picture(tmp_path / "wood.png")
    faces = "usemtl wood\nf 1/1 2/2 3/3\nusemtl paint\nf 1 3 4\n"
    mesh = obj(tmp_path, MTL + "newmtl paint\nKd 1 0.5 0\n", faces)
    assert color_at(mesh, 0.75, 0.25) == [255, 255, 0]
    assert color_at(mesh, 0.25, 0.75) == [255, 128, 0]


def test_faces_without_coordinates_have_the_colour_of_their_material(tmp_path):
    picture(tmp_path / "wood.png")
    mesh = obj(tmp_path, faces="usemtl wood\nf 1/1 2/2 3/3\nf 1 3 4\n")
    assert color_at(mesh, 0.25, 0.75) == [51, 102, 153]
    assert mesh.notes == ("1 faces have no coordinates for their texture, but its material's plain colour",)


def test_dropped_faces_leave_the_others_their_texture(tmp_path):
    picture(tmp_path / "wood.png")
    mesh = obj(tmp_path, faces="usemtl wood\nf 1/1 1/1 2/2\n" + FACE)
    assert len(mesh.faces) == 2
    assert_quad(mesh)


@pytest.mark.parametrize(
    ("mtl", "words"),
    [
        (MTL.replace("wood.png", "oak.png"), "oak.png: no such file"),
        (MTL.replace("wood.png", "../secret.png"), "leads out of"),
        (MTL.replace("wood.png", "/etc/secret.png"), "leads out of"),
        (MTL.replace("wood.png", "C:\\pictures\\wood.png"), "leads out of"),
        (MTL.replace("wood.png", "http://example.org/wood.png"), "is in the network"),
        (MTL.replace("wood.png", "quad.obj"), "not an image that can be read; convert it to PNG or JPEG"),
    ],
)
def test_a_picture_that_cannot_be_used_is_left_out_with_a_note(tmp_path, mtl, words):
    folder = tmp_path / "in"
    folder.mkdir()
    picture(tmp_path / "secret.png")
    mesh = obj(folder, mtl)
    assert mesh.texture is None
    assert any(note.startswith("a texture is left out: ") and words in note for note in mesh.notes), mesh.notes


def test_a_link_does_not_lead_out_of_the_folder(tmp_path):
    (tmp_path / "in").mkdir()
    picture(tmp_path / "secret.png")
    (tmp_path / "in" / "wood.png").symlink_to(tmp_path / "secret.png")
    mesh = obj(tmp_path / "in")
    assert mesh.texture is None
    assert any("leads out of" in note for note in mesh.notes)


def test_materials_that_are_not_there_are_said(tmp_path):
    (tmp_path / "quad.obj").write_text(f"mtllib gone.mtl\n{QUAD}{FACE}")
    mesh = load_mesh(tmp_path / "quad.obj")
    assert mesh.texture is None
    assert any("gone.mtl: no such file" in note for note in mesh.notes)


def test_what_is_ignored_is_said(tmp_path):
    picture(tmp_path / "my wood.png", np.dstack([PICTURE, np.full((2, 2), 128, np.uint8)]))
    mesh = obj(tmp_path, MTL.replace("wood.png", "-s 2 2 1 my wood.png") + "map_Bump bump.png\n")
    assert_quad(mesh)
    said = " ".join(mesh.notes)
    for words in ("quad.mtl: map_Bump ignored", "options -s of map_Kd are ignored", "transparency is ignored"):
        assert words in said


@pytest.mark.parametrize(
    "faces",
    [
        *(FACE.replace("4/4", word) for word in ("4/5", "4/-5", "4/x")),
        *(f"vt {numbers}\nf 1/5 2/2 3/3\n" for numbers in ("nan 0", "1e39 0", "")),
    ],
)
def test_texture_coordinates_that_are_wrong_are_an_input_error(tmp_path, faces):
    picture(tmp_path / "wood.png")
    with pytest.raises(InputError, match=r"quad\.obj: .*texture coord|quad\.obj: line"):
        obj(tmp_path, faces=faces)


def test_pictures_that_are_too_large_together_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr("etsplat.io._materials.MAX_PIXELS", 6)
    picture(tmp_path / "wood.png")
    picture(tmp_path / "other.png", PICTURE[::-1])
    faces = "usemtl wood\nf 1/1 2/2 3/3\nusemtl other\nf 1/1 3/3 4/4\n"
    mesh = obj(tmp_path, MTL + "newmtl other\nmap_Kd other.png\n", faces)
    assert color_at(mesh, 0.75, 0.25) == [255, 255, 0]
    assert color_at(mesh, 0.25, 0.75) == [255, 255, 255]
    assert any("more than" in note for note in mesh.notes)


def gltf(folder: Path, suffix: str, factor: list[float] | None = None) -> Path:
    """A textured quad as trimesh writes it."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(PICTURE), baseColorFactor=factor)
    visual = trimesh.visual.TextureVisuals(uv=points[:, :2], material=material)
    mesh = trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    exported = trimesh.Scene(mesh).export(file_type=suffix)
    files = exported if isinstance(exported, dict) else {f"model.{suffix}": exported}
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder / f"model.{suffix}"


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_a_gltf_has_the_colours_of_its_picture(tmp_path, suffix):
    mesh = load_mesh(gltf(tmp_path, suffix))
    assert_quad(mesh)
    assert mesh.notes == ()


def test_the_base_colour_multiplies_linear_light(tmp_path):
    """Half of full red is 188 as displayed."""
    mesh = load_mesh(gltf(tmp_path, "glb", [0.5, 1.0, 1.0, 1.0]))
    assert color_at(mesh, 0.25, 0.75) == [188, 0, 0]
    assert color_at(mesh, 0.25, 0.25) == [0, 0, 255]


@pytest.mark.parametrize("uri", ["../secret.png", "%2e%2e/secret.png", "https://example.org/a.png", "gone.png"])
def test_a_gltf_reads_no_picture_from_elsewhere(tmp_path, uri):
    (tmp_path / "in").mkdir()
    picture(tmp_path / "secret.png")
    path = change_gltf(gltf(tmp_path / "in", "gltf"), lambda document: document.update(images=[{"uri": uri}]))
    mesh = load_mesh(path)
    assert mesh.texture is None
    assert len(mesh.faces) == 2
    assert any(note.startswith("a texture is left out: ") for note in mesh.notes)


def test_pictures_and_maps_within_a_gltf(tmp_path):
    def edit(document):
        document["images"] = [{"uri": "data:image/png;base64," + base64.b64encode(png()).decode()}]
        document["materials"][0]["normalTexture"] = {"index": 0}

    mesh = load_mesh(change_gltf(gltf(tmp_path, "gltf"), edit))
    assert_quad(mesh)
    assert mesh.notes == ("model.gltf: normalTexture ignored; only baseColorTexture is seen",)


@pytest.mark.parametrize(
    ("transform", "where"),
    [
        ({"offset": [0.5, 0.0]}, lambda u, v: (u + 0.5, v)),
        ({"scale": [0.5, 0.25], "offset": [0.0, 0.5]}, lambda u, v: (u / 2, v / 4 + 0.5)),
        ({"rotation": np.pi / 2}, lambda u, v: (v, -u)),  # counterclockwise as the picture is seen, its rows downwards
        ({"rotation": np.pi / 2, "scale": [2.0, 0.5], "offset": [0.1, 0.2]}, lambda u, v: (v / 2 + 0.1, 0.2 - 2 * u)),
    ],
)
def test_a_gltf_whose_coordinates_are_transformed_has_the_colours_there(tmp_path, transform, where):
    """As gltfpack writes them; they were taken as they are stored."""

    def edit(document):
        info = document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        info["extensions"] = {"KHR_texture_transform": transform}

    plain = load_mesh(gltf(tmp_path, "gltf")).texture
    moved = load_mesh(change_gltf(tmp_path / "model.gltf", edit))
    assert plain is not None
    assert moved.texture is not None
    assert moved.notes == ()
    u, v = where(plain.corner_uvs[..., 0], 1 - plain.corner_uvs[..., 1])  # glTF counts from the top
    torch.testing.assert_close(moved.texture.corner_uvs, torch.stack([u, 1 - v], dim=-1).float(), rtol=0, atol=1e-6)


def test_a_transform_names_the_set_of_coordinates(tmp_path):
    """That of the picture is for programs without the extension."""

    def edit(document):
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        attributes["TEXCOORD_1"] = attributes.pop("TEXCOORD_0")
        info = document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        info["extensions"] = {"KHR_texture_transform": {"texCoord": 1}}

    assert_quad(load_mesh(change_gltf(gltf(tmp_path, "gltf"), edit)))


@pytest.mark.parametrize("transform", [{"scale": 2}, {"offset": [1]}, {"rotation": "a"}, [], {"offset": [np.nan, 0]}])
def test_a_damaged_transform_is_an_input_error(tmp_path, transform):
    def edit(document):
        info = document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        info["extensions"] = {"KHR_texture_transform": transform}

    with pytest.raises(InputError, match=r"model\.gltf: cannot be read as GLTF"):
        load_mesh(change_gltf(gltf(tmp_path, "gltf"), edit))


@pytest.mark.parametrize(("scale", "notes"), [(1.0, 0), (1.01, 1)])
def test_a_border_that_is_clamped_is_said_where_coordinates_go_beyond_it(tmp_path, scale, notes):
    """It was said of every such file, those of our own exports among them."""

    def edit(document):
        document["samplers"] = [{"wrapS": 33071, "wrapT": 33071}]
        document["textures"][0]["sampler"] = 0
        info = document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        info["extensions"] = {"KHR_texture_transform": {"scale": [scale, 1.0]}}

    said = load_mesh(change_gltf(gltf(tmp_path, "gltf"), edit)).notes
    assert said == ("model.gltf: a texture repeats here that is clamped or mirrored at its border",) * notes


def test_diffuse_colours_of_a_gltf_are_its_base_colours(tmp_path):
    """The older model of materials, specular and glossiness, was white without a word."""

    def edit(document):
        base = document["materials"][0].pop("pbrMetallicRoughness")
        said = {"diffuseTexture": base["baseColorTexture"], "diffuseFactor": [0.5, 1, 1, 1]}
        said["specularGlossinessTexture"] = base["baseColorTexture"]
        document["materials"][0]["extensions"] = {"KHR_materials_pbrSpecularGlossiness": said}

    mesh = load_mesh(change_gltf(gltf(tmp_path, "gltf"), edit))
    assert color_at(mesh, 0.25, 0.75) == [188, 0, 0]
    assert color_at(mesh, 0.25, 0.25) == [0, 0, 255]
    assert mesh.notes == ("model.gltf: specularGlossinessTexture ignored; only baseColorTexture is seen",)


def test_a_gltf_whose_light_is_in_another_map_says_that_it_is_ignored(tmp_path):
    """Such a mesh was white without a word."""

    def edit(document):
        base = document["materials"][0].pop("pbrMetallicRoughness")
        document["materials"][0] |= {"emissiveTexture": base["baseColorTexture"], "emissiveFactor": [1, 1, 1]}

    mesh = load_mesh(change_gltf(gltf(tmp_path, "gltf"), edit))
    assert mesh.texture is None
    assert mesh.notes == ("model.gltf: emissiveTexture ignored; only baseColorTexture is seen",)


def test_indices_of_textures_out_of_range_are_an_input_error(tmp_path):
    def edit(document):
        document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"] = 7

    with pytest.raises(InputError, match=r"model\.gltf: cannot be read as GLTF"):
        load_mesh(change_gltf(gltf(tmp_path, "gltf"), edit))


PAINTS = "newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n"
TWO = "usemtl red\nf 1 2 3\nusemtl blue\nf 1 3 4\n"


def test_without_pictures_faces_have_the_plain_colours_of_their_materials(tmp_path):
    """They were white, without a word."""
    mesh = obj(tmp_path, PAINTS, TWO)
    assert mesh.texture is None
    assert mesh.face_colors is not None
    assert mesh.face_colors.tolist() == [[1, 0, 0], [0, 0, 1]]
    assert mesh.notes == ()


@pytest.mark.parametrize(
    ("mtl", "points"),
    [
        (PAINTS.replace("1 0 0", "0.8 0.8 0.8").replace("0 0 1", "0.8 0.8 0.8"), QUAD),
        (PAINTS, "v 0 0 0 0 1 0\nv 1 0 0 0 1 0\nv 1 1 0 0 1 0\nv 0 1 0 0 1 0\n"),
    ],
)
def test_one_grey_for_all_is_no_colour_and_colours_of_vertices_come_first(tmp_path, mtl, points):
    """Programs write a grey where nobody chose a colour."""
    mesh = obj(tmp_path, mtl, TWO, points)
    assert mesh.face_colors is None
    assert (mesh.vertex_colors is None) == (points == QUAD)


def test_a_gltf_without_pictures_has_the_plain_colours_of_its_materials(tmp_path):
    """Half of linear light is 188 as displayed. Colours of vertices are multiplied by them, which was left out."""

    def edit(document, colored=False):
        document["materials"] = [
            {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0, 0, 1]}},
            {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 1, 1]}},
        ]
        first = document["meshes"][0]["primitives"][0]
        if colored:
            first["attributes"]["COLOR_0"] = first["attributes"]["POSITION"]
        document["meshes"][0]["primitives"] = [first | {"material": 0}, first | {"material": 1}]

    mesh = load_mesh(change_gltf(gltf(tmp_path, "gltf"), edit))
    assert mesh.texture is None
    assert mesh.face_colors is not None
    assert (255 * mesh.face_colors).round().tolist() == [[188, 0, 0]] * 2 + [[0, 0, 255]] * 2
    mesh = load_mesh(change_gltf(gltf(tmp_path, "gltf"), lambda document: edit(document, colored=True)))
    assert mesh.face_colors is None
    assert mesh.vertex_colors is not None
    corner = (mesh.vertices == torch.tensor([1.0, 1.0, 0.0])).all(dim=1)
    assert (255 * mesh.vertex_colors[corner]).round().tolist() == [[188, 0, 0], [0, 0, 0]]
