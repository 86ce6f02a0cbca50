"""What leaves a soup, in every kind of file."""

import base64
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from etsplat import look_at
from etsplat.cli.parse import parse
from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.regions import Sphere
from etsplat.io import writers
from etsplat.io.compact_soups import decode_compact
from etsplat.io.mesh_files import MeshFile, save_mesh
from etsplat.io.ply_tables import encode_ply, read_ply_tables
from etsplat.io.srgb import srgb_from_linear
from etsplat.model.solid_soup import SolidSoup
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.soup_import import load_soup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import bake_colors, export_soup
from helpers.exported_soups import CAMERA, difference, flat, odd_soup, run_of
from helpers.gltf import check_glb


@pytest.fixture
def soup(rng):
    return odd_soup(rng)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".glb"])
@pytest.mark.parametrize("weld", [False, True])
def test_a_mesh_viewer_shows_what_the_opaque_render_shows(tmp_path, soup, suffix, weld):
    """Every format returns the opaque triangles in their colours, so that a z-buffer draws the same picture."""
    path = tmp_path / f"soup{suffix}"
    export_soup(run_of(soup), path, ExportConfig(colors="constant", weld=weld, up="keep"))
    returned = load_soup(path)
    expected = flat(soup).render_opaque(CAMERA)
    # trimesh, which reads GLB, keeps its linear light in 8 bits.
    tolerance = 6 / 255 if suffix == ".glb" else 1.5 / 255
    assert difference(returned.render_opaque(CAMERA), expected) < tolerance
    assert float(expected.mean()) > 0.05


@pytest.mark.parametrize("kernel", ["elastic", "bilateral"])
def test_ply_with_harmonics_returns_the_same_soft_picture(tmp_path, soup, kernel):
    path = tmp_path / "soup.ply"
    export_soup(run_of(soup, kernel=kernel), path, ExportConfig(colors="keep", min_opacity=0.0, up="keep"))
    returned = load_soup(path)
    assert returned.appearance == SoupAppearance(kernel=kernel)
    expected = replace(soup, appearance=SoupAppearance(kernel=kernel)).render(CAMERA).color
    assert difference(returned.render(CAMERA).color, expected) < 1e-4
    assert np.asarray(trimesh.load_mesh(path, process=False).vertices).shape == (180, 3)


def test_ply_with_harmonics_returns_how_it_is_drawn_and_its_notes(tmp_path, soup):
    look = SoupAppearance(
        "bilateral", "sdf", sh_degree=1, cull_small=True, cull_large=0.6, near_plane=3.5, background=(1.0, 0.0, 0.5)
    )
    kept = replace(soup, appearance=look, notes={"sky": "none", "focal": "800", "iteration": "7"})
    path = tmp_path / "soup.ply"
    config = ExportConfig(colors="keep", min_opacity=0.0, scale=3.0)
    export_soup(replace(run_of(soup), soup=kept), path, config)
    returned = load_soup(path)
    assert returned.appearance == look
    assert returned.notes == {**kept.notes, "source": "soup.ply"}
    assert difference(returned.render(CAMERA).color, kept.render(CAMERA).color) < 1e-4
    path.write_bytes(re.sub(rb"comment (appearance|notes) .*\n", b"", path.read_bytes()))  # as of earlier versions
    assert load_soup(path).appearance == SoupAppearance("bilateral", "sdf")


@pytest.mark.parametrize(("name", "said"), [("appearance", '{"near_plane": 0}'), ("appearance", "3"), ("notes", "[1]")])
def test_a_ply_that_cannot_be_drawn_as_it_says_is_refused(tmp_path, soup, name, said):
    path = tmp_path / "soup.ply"
    export_soup(run_of(soup), path, ExportConfig(colors="keep"))
    path.write_bytes(re.sub(rb"(comment %s ).*\n" % name.encode(), rb"\g<1>%s\n" % said.encode(), path.read_bytes()))
    with pytest.raises(InputError, match=rf"soup\.ply: its record of the export has no usable `{name}`"):
        load_soup(path)


def test_opacity_floor_and_softness_ceiling_are_in_the_exported_numbers(tmp_path, soup):
    limits = {"opacity_floor": 0.6, "sigma_ceiling": 0.3}
    export_soup(run_of(soup, **limits), tmp_path / "soup.ply", ExportConfig(colors="keep", up="keep"))
    returned = load_soup(tmp_path / "soup.ply")
    assert len(returned) == len(soup)
    assert float(returned.opacities.min()) >= 0.6
    assert float(returned.sigma.max()) <= 0.3001


def test_glb_is_linear_and_blends_on_request_ply_has_colours_at_vertices_and_faces(tmp_path, soup):
    export_soup(run_of(soup), tmp_path / "soup.glb", ExportConfig(colors="constant", alpha=True, min_opacity=0.0))
    mesh = next(iter(trimesh.load_scene(tmp_path / "soup.glb", process=False).geometry.values()))
    alpha = np.asarray(mesh.visual.vertex_attributes["color"])[::3, 3]
    np.testing.assert_allclose(alpha, soup.opacities.numpy(), atol=1e-2 if alpha.max() <= 1 else 300)
    export_soup(run_of(soup), tmp_path / "soup.ply", ExportConfig(colors="constant", min_opacity=0.0))
    tables = read_ply_tables(tmp_path / "soup.ply", ("vertex", "face"))
    for channel, name in enumerate(("red", "green", "blue")):
        assert np.array_equal(tables["vertex"][name][::3], tables["face"][name])
        np.testing.assert_allclose(tables["face"][name] / 255, soup.display_colors()[:, channel], atol=0.51 / 255)
    assert float(srgb_from_linear(np.array([0.5]))[0]) > 0.7  # what the GLB test of meshes relies on


def test_with_alpha_only_faint_faces_of_a_glb_blend(tmp_path, soup):
    """What blends hides nothing in a viewer, so faces that are all but opaque must not."""
    soup.opacity_logits[:] = torch.where(torch.arange(60) < 20, 9.0, 1.0)
    export_soup(run_of(soup), tmp_path / "soup.glb", ExportConfig(colors="constant", alpha=True, min_opacity=0.0))
    document = check_glb(tmp_path / "soup.glb")
    modes = {}
    for part in document["meshes"][0]["primitives"]:
        count = document["accessors"][part["indices"]]["count"]
        modes[document["materials"][part["material"]]["alphaMode"]] = count
    assert modes == {"OPAQUE": 3 * 20, "BLEND": 3 * 40}
    assert all(material["doubleSided"] for material in document["materials"])
    assert len(load_soup(tmp_path / "soup.glb")) == 60


def test_baked_colours_are_what_the_cameras_see(soup):
    """One camera: its own colours, wherever it sees a triangle."""
    baked = bake_colors(soup, [CAMERA])
    seen = soup.render(CAMERA, outputs=("statistics",))
    shown = seen.statistics.max_weight[0] > 0
    direct = soup.display_colors(soup.vertices.mean(dim=1) - CAMERA.centers[0])
    torch.testing.assert_close(baked[shown], direct[shown], atol=1e-5, rtol=0)
    assert torch.equal(baked[~shown], soup.display_colors()[~shown])


def test_triangle_splatting_states_come_in_safely(tmp_path, soup):
    state = {
        "triangles_points": torch.nn.Parameter(soup.vertices),
        "sigma": soup.sigma_raw[:, None],
        "opacity": soup.opacity_logits[:, None],
        "features_dc": soup.sh_dc,
        "features_rest": soup.sh_rest,
        "active_sh_degree": 2,
    }
    torch.save(state, tmp_path / "point_cloud_state_dict.pt")
    file = load_soup(tmp_path / "point_cloud_state_dict.pt")
    assert file.appearance == SoupAppearance("single_sided", "sdf", sh_degree=2, cull_small=True, near_plane=0.2)
    for name, tensor in file.parameters().items():
        assert torch.equal(tensor, getattr(soup, name))
    torch.save({"triangles_points": soup.vertices}, tmp_path / "half.pt")
    with pytest.raises(InputError, match="lacks"):
        load_soup(tmp_path / "half.pt")
    torch.save(soup, tmp_path / "code.pt")
    with pytest.raises(InputError, match="cannot be read as a state dict") as raised:
        load_soup(tmp_path / "code.pt")
    assert "weights_only" not in str(raised.value)  # torch's advice is to run the code in the file
    (tmp_path / "letter.pt").write_text("hi\n")  # which torch's unpickler answers with a KeyError
    with pytest.raises(InputError, match="cannot be read as a state dict"):
        load_soup(tmp_path / "letter.pt")


def test_a_kind_of_file_without_opacities_is_refused_with_alpha(tmp_path, soup):
    with pytest.raises(InputError, match=r"soup\.obj: files of this kind hold no opacities"):
        export_soup(run_of(soup), tmp_path / "soup.obj", ExportConfig(alpha=True))


def test_the_kind_of_file_follows_from_its_name(tmp_path, soup, capsys):
    soup.save(tmp_path / "soup.safetensors")
    for arguments in (["--out", "a.ply", "--min-opacity", "0"], ["--format", "off", "--min-opacity", "0"]):
        named = [str(tmp_path / word) if word == "a.ply" else word for word in arguments]
        assert parse(["export", str(tmp_path / "soup.safetensors"), *named]).run([]) == 0
    assert "left out" not in capsys.readouterr().out
    assert {"a.ply", "soup.off"} <= {path.name for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match=r"does not end in \.glb; rename"):
        parse(["export", str(tmp_path / "soup.safetensors"), "--format", "glb", "--out", "b.ply"]).run([])
    with pytest.raises(
        InputError,
        match=r"does not end in \.glb or \.obj or \.off or \.ply or \.etz or \.html or \.safetensors; rename",
    ):
        parse(["export", str(tmp_path / "soup.safetensors"), "--out", "b.xyz"]).run([])


@pytest.mark.parametrize("kind", ["etz", "html"])
@pytest.mark.usefixtures("command_line")
def test_files_to_send_hold_the_soup_as_soft_as_it_is(tmp_path, soup, capsys, kind):
    """In the capture's own units and axes; what is cropped away is not in them."""
    soup.save(tmp_path / "soup.safetensors")
    command = ["export", str(tmp_path / "soup.safetensors"), "--format", kind]
    assert parse([*command, "--crop", "sphere:0,0,0,1"]).run([]) == 0
    kept = int((soup.vertices.mean(dim=1).norm(dim=1) <= 1).sum())
    assert 0 < kept < len(soup)
    assert f"soup.{kind}: {kept} triangles" in capsys.readouterr().out
    if kind == "etz":
        assert len(load_soup(tmp_path / "soup.etz")) == kept
    with pytest.raises(InputError, match=r"keeps the units and axes of the capture; leave out --up, --scale"):
        parse([*command, "--scale", "2"]).run([])


def test_the_page_of_a_cropped_run_has_the_cropped_mesh(tmp_path, soup):
    vertices, faces = icosphere(2)
    mesh = MeshFile(vertices, faces, vertex_colors=vertices * 0.5 + 0.5)
    run = replace(run_of(soup), path=tmp_path, opaque=mesh)
    sizes = {}
    for name, config in (("mesh", ExportConfig()), ("soup", ExportConfig(triangles="soup"))):
        export_soup(run, tmp_path / f"{name}.html", config, crop=Sphere((0.0, 0.0, 1.0), 0.9))
        parts = re.findall(r'id="scene-(\w+)">(.*?)</script>', (tmp_path / f"{name}.html").read_text())
        found = {part: base64.b64decode(text) for part, text in parts if part != "data"}
        sizes[name] = {part: len(decode_compact(data)) for part, data in found.items()}
    inside = vertices[faces].mean(dim=1) - torch.tensor([0.0, 0.0, 1.0])
    assert sizes["mesh"]["mesh"] == int((inside.norm(dim=1) <= 0.9).sum())
    assert sizes["soup"] == {"soup": sizes["mesh"]["soup"]}


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_an_opaque_mesh_keeps_the_colours_of_its_corners(tmp_path, soup, kind):
    """Read again from PLY it had one colour for each triangle."""
    vertices, faces = icosphere(2)
    mesh = MeshFile(vertices, faces, vertex_colors=vertices * 0.5 + 0.5)
    export_soup(replace(run_of(soup), path=tmp_path, opaque=mesh), tmp_path / f"a.{kind}", ExportConfig(up="keep"))
    again = load_soup(tmp_path / f"a.{kind}")
    assert isinstance(again, SolidSoup)
    atol = 0.03 if kind == "glb" else 0.003  # trimesh reads 8 bits of linear light
    torch.testing.assert_close(again.corner_colors, mesh.vertex_colors[faces], atol=atol, rtol=0)


@pytest.mark.parametrize(("floor", "advised"), [("0", False), ("0.97", True)])
@pytest.mark.usefixtures("command_line")
def test_an_export_that_leaves_out_most_says_what_to_do(tmp_path, soup, capsys, floor, advised):
    soup.save(tmp_path / "soup.safetensors")
    assert parse(["export", str(tmp_path / "soup.safetensors"), "--min-opacity", floor]).run([]) == 0
    assert ("train --asset" in capsys.readouterr().out) is advised


@pytest.mark.parametrize("kind", ["PLY", "OBJ", "OFF", "GLB", "SafeTensors"])
def test_the_kind_of_file_does_not_depend_on_capitals(tmp_path, soup, kind):
    """A.GLB is written like a.glb, by name and by --format, and read back."""
    flat(soup).save(tmp_path / "from.SAFETENSORS")
    for name, more in (("A", []), ("B", ["--format", kind.lower()])):
        out = tmp_path / f"{name}.{kind}"
        command = ["export", str(tmp_path / "from.SAFETENSORS"), "--out", str(out), "--min-opacity", "0", *more]
        assert parse(command).run([]) == 0
        assert torch.equal(load_soup(out).vertices, soup.vertices)


def test_a_kind_of_file_of_ones_own_is_one_module(tmp_path, soup, monkeypatch):
    """It is found by being there, told of what it has room for alone, and offered on the command line with its line."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "tri.py").write_text(
        '''"""For a test."""

HOLDS = frozenset({"face_colors"})


def write(path, surface):
    """A line for each triangle."""
    assert surface.vertex_colors is None
    rows = [*surface.vertices[surface.faces].reshape(-1, 9)], surface.face_colors
    path.write_text("".join(f"{list(map(float, corners))} {list(color)}\\n" for corners, color in zip(*rows)))
'''
    )
    monkeypatch.setattr(writers, "__path__", [*writers.__path__, str(tmp_path / "code")])
    export_soup(run_of(soup), tmp_path / "soup.tri", ExportConfig(colors="constant", min_opacity=0.0))
    lines = (tmp_path / "soup.tri").read_text().splitlines()
    assert len(lines) == len(soup)
    assert lines[7].startswith(str(soup.vertices[7].flatten().tolist()))
    assert writers.purposes()["tri"] == "For a test."
    with pytest.raises(InputError, match=r"soup\.tri: files of this kind hold no opacities"):
        export_soup(run_of(soup), tmp_path / "soup.tri", ExportConfig(alpha=True))
    with pytest.raises(ValueError, match=r"expected one of the suffixes \.glb, \.obj, \.ply, got mesh\.tri"):
        save_mesh(tmp_path / "mesh.tri", torch.eye(3), torch.tensor([[0, 1, 2]]))


def test_what_a_kind_of_file_cannot_hold_does_not_depend_on_capitals(tmp_path, soup):
    with pytest.raises(InputError, match=r"soup\.OBJ: files of this kind hold no opacities"):
        export_soup(run_of(soup), tmp_path / "soup.OBJ", ExportConfig(alpha=True))
    export_soup(run_of(soup), tmp_path / "soup.PLY", ExportConfig(colors="keep", up="keep", min_opacity=0))
    assert load_soup(tmp_path / "soup.PLY").sh_degree == 2


def test_a_gaussian_scene_comes_in_at_its_places_with_its_size_and_colours(tmp_path):
    """A round Gaussian seen from the front blurs to the same width: the second moment of alpha agrees within 15 %."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(9)), "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    table = np.zeros(1, [(name, "f4") for name in names])
    table["f_dc_0"], table["f_rest_4"], table["opacity"] = 1.0, 0.25, 4.0
    table["scale_0"], table["scale_1"], table["scale_2"] = math.log(0.2), math.log(0.2), -9.0
    table["rot_0"] = 1.0
    (tmp_path / "gaussians.ply").write_bytes(encode_ply({"vertex": table}))
    soup = load_soup(tmp_path / "gaussians.ply")
    assert (len(soup), soup.sh_degree) == (1, 1)
    assert soup.sh_rest[0].tolist() == [[0, 0, 0], [0, 0.25, 0], [0, 0, 0]]
    torch.testing.assert_close(soup.vertices.mean(dim=1), torch.zeros(1, 3), atol=1e-6, rtol=0)
    camera = Cameras(look_at(torch.tensor([[0.0, 0, 4]]), torch.zeros(3), torch.tensor([0.0, 1, 0])), CAMERA.Ks, 64, 48)
    alpha = soup.render(camera).alpha[0, ..., 0] / float(soup.opacities)
    x = (torch.arange(64) + 0.5 - 32) * 4 / float(camera.Ks[0, 0, 0])
    spread = float((alpha.sum(dim=0) * x * x).sum() / alpha.sum()) ** 0.5
    assert spread == pytest.approx(0.2, rel=0.15)


def test_contradictions_and_empty_results_are_input_errors(tmp_path, soup):
    with pytest.raises(InputError, match=r'\(colors="keep"\) need a path that ends in \.ply and up="keep"$'):
        export_soup(run_of(soup), tmp_path / "soup.obj", ExportConfig(colors="keep", up="keep"))
    with pytest.raises(InputError, match=r"lower min_opacity, or take the opaque mesh \(train with asset=True"):
        export_soup(run_of(soup), tmp_path / "soup.obj", ExportConfig(min_opacity=1.0))
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    with pytest.raises(InputError, match="PLY header"):
        load_soup(tmp_path / "broken.ply")
