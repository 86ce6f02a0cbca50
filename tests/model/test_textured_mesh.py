"""Meshes with a texture: their pictures and their files."""

import io

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import etsplat
from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.triangle_atlas import pack_triangles
from etsplat.io.mesh_files import load_mesh, save_mesh
from etsplat.io.textures import Texture
from etsplat.model.soup_import import load_soup
from etsplat.model.textured_mesh import TexturedMesh

CAMERAS = etsplat.orbit_cameras(40, 30, azimuths=2)[:2]


@pytest.fixture
def mesh(rng) -> TexturedMesh:
    """A ball whose faces have texels of their own, of which no two are alike."""
    vertices, faces = icosphere(1)
    atlas = pack_triangles(torch.full((len(faces),), 4))
    texture = torch.randint(0, 256, (atlas.height, atlas.width, 3), generator=rng) / 255
    return TexturedMesh.from_mesh(0.8 * vertices, faces, texture, atlas.face_uvs, max_level=0)


def picture(mesh: TexturedMesh) -> torch.Tensor:
    return mesh.render(CAMERAS).color.detach()


def test_safetensors_hold_it_exactly(mesh, tmp_path):
    mesh.save(tmp_path / "mesh.safetensors")
    again = TexturedMesh.load(tmp_path / "mesh.safetensors")
    assert again.appearance == mesh.appearance
    assert torch.equal(picture(again), picture(mesh))
    assert mesh.state().keys() == again.state().keys()
    assert all(torch.equal(value, again.state()[name]) for name, value in mesh.state().items())


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_what_other_programs_read_comes_back_with_the_same_picture(mesh, tmp_path, kind):
    """Texels have 8 bits; the mesh is welded again."""
    mesh.save(tmp_path / f"ball.{kind}")
    again = TexturedMesh.load(tmp_path / f"ball.{kind}")
    assert (again.count, len(again.vertices)) == (mesh.count, len(mesh.vertices))
    again.appearance = mesh.appearance  # files do not say it
    torch.testing.assert_close(picture(again), picture(mesh), atol=1e-3, rtol=0)


def test_trimesh_reads_the_glb_with_the_same_picture(mesh, tmp_path):
    """The embedded PNG is the texture, its material is unlit, and each corner of each face has its place in it."""
    mesh.save(tmp_path / "ball.glb")
    found = trimesh.load(tmp_path / "ball.glb", force="mesh", process=False)
    shown = np.asarray(found.visual.material.baseColorTexture.convert("RGB"))
    assert np.array_equal(shown, (mesh.texture.detach() * 255).round().byte().numpy())
    uvs = torch.from_numpy(np.array(found.visual.uv))[torch.from_numpy(np.array(found.faces))].float()
    uvs = torch.stack([uvs[..., 0], 1 - uvs[..., 1]], dim=-1)  # it counts from the bottom
    corners = torch.from_numpy(np.array(found.vertices))[torch.from_numpy(np.array(found.faces))].float()
    torch.testing.assert_close(corners, mesh.vertices.detach()[mesh.faces])
    torch.testing.assert_close(uvs, mesh.face_uvs, atol=1e-6, rtol=0)
    assert b"KHR_materials_unlit" in (tmp_path / "ball.glb").read_bytes()


def test_trimesh_reads_the_ply_with_the_same_picture(mesh, tmp_path):
    """As MeshLab does: places of corners in lists at faces, counted from the bottom, and a PNG beside the file. So does
    our own reader; without the PNG it says so."""
    mesh.save(tmp_path / "ball.ply")
    found = trimesh.load(tmp_path / "ball.ply", process=False)
    assert found.visual.kind == "texture"
    corners = torch.tensor(found.vertices[found.faces], dtype=torch.float32)
    assert torch.allclose(corners, mesh.vertices.detach()[mesh.faces.long()])
    uvs = torch.tensor(found.visual.uv[found.faces], dtype=torch.float32)
    assert torch.allclose(torch.stack([uvs[..., 0], 1 - uvs[..., 1]], dim=-1), mesh.face_uvs, atol=1e-6)
    picture = np.asarray(Image.open(tmp_path / "ball_ply.png").convert("RGB")) / 255
    assert abs(picture - mesh.texture.detach().clamp(0, 1).numpy()).max() <= 0.51 / 255
    read = load_mesh(tmp_path / "ball.ply")
    assert len(read.faces) == mesh.count
    assert read.notes == ()
    again = TexturedMesh.load(tmp_path / "ball.ply")
    torch.testing.assert_close(again.face_uvs, mesh.face_uvs, atol=1e-6, rtol=0)
    torch.testing.assert_close(again.texture, mesh.texture.clamp(0, 1), atol=0.51 / 255, rtol=0)
    (tmp_path / "ball_ply.png").unlink()
    alone = load_mesh(tmp_path / "ball.ply")
    assert alone.texture is None
    assert len(alone.notes) == 1
    assert "a texture is left out: " in alone.notes[0]
    assert "ball_ply.png" in alone.notes[0]


def test_an_obj_and_a_ply_of_one_name_keep_their_own_textures(mesh, tmp_path):
    """They shared NAME.png: the second file put its picture under the first, in another place of every face."""
    mesh.save(tmp_path / "ball.obj")
    other = TexturedMesh.from_mesh(mesh.vertices, mesh.faces, 1 - mesh.texture.detach(), mesh.face_uvs, max_level=0)
    other.save(tmp_path / "ball.ply")
    for kind, expected in (("obj", mesh), ("ply", other)):
        again = TexturedMesh.load(tmp_path / f"ball.{kind}")
        torch.testing.assert_close(again.texture, expected.texture.detach(), atol=0.51 / 255, rtol=0)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("comment TextureFile a.png\ncomment TextureFile b.png\n", "2 pictures, and one is read from PLY"),
        ("comment TextureFile a.png\n", "has no list texcoord at faces"),
        ("comment TextureFile ../a.png\nT", "a.png"),
    ],
)
def test_textures_of_ply_that_cannot_be_read_are_said_to_be_left_out(tmp_path, line, told):
    places = "property list uchar float texcoord\n" if line.endswith("T") else ""
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\n{line.rstrip('T')}element vertex 4\nproperty float x\nproperty float y\n"
        f"property float z\nelement face 2\nproperty list uchar int vertex_index\n{places}end_header\n"
        "0 0 0\n1 0 0\n0 1 0\n1 1 0\n" + "".join(f"3 {k} 1 2{' 6 0 0 1 0 0 1' if places else ''}\n" for k in (0, 3))
    )
    read = load_mesh(tmp_path / "a.ply")
    assert read.texture is None
    assert told in read.notes[0]


@pytest.mark.parametrize("kind", ["glb", "obj", "ply"])
def test_a_soup_of_a_textured_file_has_the_colours_of_its_texture(mesh, tmp_path, kind):
    """It was grey, and of PLY refused, without a word of the texture."""
    with torch.no_grad():
        mesh.texture[:] = torch.tensor([0.9, 0.4, 0.1])
    mesh.save(tmp_path / f"ball.{kind}")
    soup = load_soup(tmp_path / f"ball.{kind}")
    assert len(soup) == mesh.count
    colors = 0.5 + 0.28209479 * soup.sh_dc[:, 0]
    torch.testing.assert_close(colors, torch.tensor([0.9, 0.4, 0.1]).expand_as(colors), atol=0.01, rtol=0)


def test_a_mesh_read_as_a_soup_keeps_colours_of_corners_and_says_what_it_lacks_of_a_texture(tmp_path):
    """Each triangle had one colour, without a word: of a ramp over one large square two greys were left."""
    square = torch.tensor([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    ramp = (255 * torch.linspace(0, 1, 64)).byte()[None, :, None].expand(64, 64, 3)
    save_mesh(
        tmp_path / "a.glb",
        square,
        faces,
        texture=Texture.of([ramp], torch.zeros(2).long(), square[faces][..., :2] + 0.5),
    )
    save_mesh(tmp_path / "b.obj", square, faces, vertex_colors=square[:, :1].expand(4, 3) + 0.5)
    cameras = etsplat.orbit_cameras(40, 40, azimuths=1)[:1]
    truth = etsplat.render_opaque(square, cameras=cameras, faces=faces, vertex_colors=square[:, :1].expand(4, 3) + 0.5)
    for name, said in (("a.glb", ["its texture is drawn as colours of 2 triangles"]), ("b.obj", [])):
        told: list[str] = []
        soup = load_soup(tmp_path / name, told.append)
        assert [text[:46] for text in told] == said
        inside = 0.02 if said else 1e-4  # the border of a texture is half a texel within
        assert float((soup.render_opaque(cameras) - truth.rgba).abs().max()) < inside


def test_a_glb_shares_vertices_where_its_faces_share_places(tmp_path):
    """Of a square of two faces, whose four corners lie in the corners of a texture, there are four."""
    square = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    texture = Texture.of([torch.zeros(2, 2, 3).byte()], torch.zeros(2).long(), square[faces][..., :2])
    save_mesh(tmp_path / "square.glb", square, faces, texture=texture)
    loaded = load_mesh(tmp_path / "square.glb")
    assert len(loaded.vertices) == 4
    assert loaded.texture is not None
    torch.testing.assert_close(loaded.texture.corner_uvs, square[loaded.faces][..., :2])


def test_an_obj_stays_welded_and_names_its_picture(mesh, tmp_path):
    """Its name may have a space; the PNG beside it is the texture."""
    mesh.save(tmp_path / "my ball.obj")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my ball.mtl", "my ball.obj", "my ball.png"]
    assert len(load_mesh(tmp_path / "my ball.obj").vertices) == len(mesh.vertices)
    stored = np.array(Image.open(io.BytesIO((tmp_path / "my ball.png").read_bytes())))
    assert np.array_equal(stored, (mesh.texture.detach() * 255).round().byte().numpy())


def test_what_a_viewer_shows_is_the_mean_of_samples(mesh):
    """Of one sample that is the picture but for silhouettes; of 16 the means of a picture four times as large."""
    inside = mesh.render(CAMERAS).alpha[..., 0] > 0
    plain = mesh.render_opaque(CAMERAS, supersampling=1)
    same = (plain[..., :3] - picture(mesh)).abs().amax(dim=-1) < 1e-5
    assert float(same[inside].float().mean()) > 0.7
    larger = mesh.render_opaque(CAMERAS.scaled(4), supersampling=1)
    means = larger.view(2, 30, 4, 40, 4, 4).mean(dim=(2, 4))
    torch.testing.assert_close(mesh.render_opaque(CAMERAS, supersampling=4), means, atol=1e-5, rtol=0)


def test_gradients_reach_texels_and_vertices(mesh):
    mesh.render(CAMERAS).color.square().sum().backward()
    for parameter in mesh.parameters().values():
        assert parameter.grad is not None
        assert float(parameter.grad.abs().max()) > 0


def test_files_without_one_texture_are_refused(mesh, tmp_path):
    save_mesh(tmp_path / "plain.glb", *mesh.surface())
    with pytest.raises(InputError, match="needs a texture of one picture"):
        TexturedMesh.load(tmp_path / "plain.glb")
    (tmp_path / "mesh.safetensors").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"textured mesh .*mesh\.safetensors: cannot be read"):
        TexturedMesh.load(tmp_path / "mesh.safetensors")
    with pytest.raises(ValueError, match="expected one of the suffixes"):
        mesh.save(tmp_path / "mesh.off")
