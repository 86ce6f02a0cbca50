"""The mesh of a reconstruction as a file, through the command line."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import etsplat
from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from etsplat.core.spelling import spelled_as_options
from etsplat.geometry.icosphere import icosphere
from etsplat.io.georeference import Georeference
from etsplat.io.mesh_files import load_mesh, save_mesh
from etsplat.io.ply_tables import read_ply_tables
from etsplat.io.run_directory import RunDirectory
from etsplat.model.textured_mesh import TexturedMesh
from etsplat.tasks import sources, texturing
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from helpers.captures import circle_poses, small_demo_scene, write_colmap
from helpers.gltf import check_glb

pytest.importorskip("xatlas")
pytest.importorskip("fast_simplification")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a few steps, of a sphere far from the origin."""
    folder = tmp_path_factory.mktemp("runs")
    vertices, faces = icosphere(2)
    save_mesh(folder / "ball.ply", 3 * vertices + 10, faces, face_colors=0.5 + 0.4 * vertices[faces].mean(dim=1))
    tiny = ReconstructConfig.tiny().changed({"iterations": 20, "resolution": 32, "start.level": 3})
    return reconstruct(folder / "ball.ply", folder / "run", tiny).path


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texturing, "EPOCHS", (1, 1, 1))


def export(*words: str | Path) -> None:
    arguments = ["export", *map(str, words)]
    with spelled_as_options():
        assert parse(arguments).run(arguments) == 0


def test_a_light_textured_file_lies_where_the_mesh_of_the_run_does(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(run, "--texture", "64", "--faces", "200")
    found, full = trimesh.load_mesh(run / "textured.glb"), load_mesh(run / "mesh.ply")
    assert 0 < len(found.faces) <= 200
    assert found.visual.material.baseColorTexture.size == (64, 64)
    bounds = torch.stack([full.vertices.amin(0), full.vertices.amax(0)])
    assert (torch.tensor(found.bounds) - bounds).abs().max() < 0.4  # of a ball of radius 3
    assert f"{run / 'textured.glb'}: {len(found.faces)} faces" in capsys.readouterr().out


def test_other_kinds_of_files(run: Path, tmp_path: Path) -> None:
    export(run, "--texture", "64", "--faces", "200", "--out", tmp_path / "ball.obj")
    assert (tmp_path / "ball.png").is_file()
    assert TexturedMesh.load(tmp_path / "ball.obj").count <= 200
    with pytest.raises(InputError, match="hold no texture"):
        export(run, "--texture", "64", "--format", "off")


def test_coarser_levels_are_files_of_their_own(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each with a quarter of the faces and half the texels; the first is the file that there is without them."""
    export(run, "--texture", "256", "--faces", "400", "--lods", "2", "--out", tmp_path / "ball.glb")
    export(run, "--texture", "256", "--faces", "400", "--out", tmp_path / "alone.glb")
    levels = [check_glb(tmp_path / f"ball{end}.glb") for end in ("", "_lod1", "_lod2")]
    assert [document["meshes"][0]["name"] for document in levels] == ["ball", "ball_lod1", "ball_lod2"]
    found = [trimesh.load_mesh(tmp_path / f"ball{end}.glb") for end in ("", "_lod1", "_lod2")]
    assert [mesh.visual.material.baseColorTexture.size[0] for mesh in found] == [256, 128, 64]
    assert [len(mesh.faces) <= most for mesh, most in zip(found, (400, 100, 25), strict=True)] == [True] * 3
    alone = trimesh.load_mesh(tmp_path / "alone.glb")
    assert (alone.vertices == found[0].vertices).all()
    for mesh in found[1:]:
        assert abs(mesh.bounds - found[0].bounds).max() < 1  # of a ball of radius 3
    assert "ball_lod2.glb: " in capsys.readouterr().out


def test_a_lit_file_has_the_relief_of_the_full_mesh(run: Path, tmp_path: Path) -> None:
    export(run, "--texture", "128", "--faces", "100", "--normals", "--lods", "1", "--out", tmp_path / "ball.glb")
    for end, size in (("", 128), ("_lod1", 64)):
        material = trimesh.load_mesh(tmp_path / f"ball{end}.glb").visual.material
        assert material.normalTexture.size == material.baseColorTexture.size == (size, size)
        assert check_glb(tmp_path / f"ball{end}.glb")["materials"][0].get("extensions") is None


def test_fewer_faces_in_the_colours_they_have(run: Path) -> None:
    export(run, "--faces", "100", "--format", "ply")
    light = load_mesh(run / "light.ply")
    assert 0 < len(light.faces) <= 100
    assert light.face_colors is not None
    full = load_mesh(run / "mesh.ply")
    assert full.face_colors is not None
    assert (light.face_colors.mean(dim=0) - full.face_colors.mean(dim=0)).abs().max() < 0.05


def test_the_mesh_as_it_is(run: Path, tmp_path: Path) -> None:
    export(run, "--out", tmp_path / "same.ply")
    same, full = load_mesh(tmp_path / "same.ply"), load_mesh(run / "mesh.ply")
    assert torch.equal(same.vertices, full.vertices)
    assert same.face_colors is not None
    assert full.face_colors is not None
    assert torch.equal(same.face_colors, full.face_colors)


def test_the_python_function_writes_the_same(run: Path, tmp_path: Path) -> None:
    etsplat.texture_mesh(run, size=64, faces=200).save(tmp_path / "textured.glb")
    export(run, "--texture", "64", "--faces", "200", "--out", tmp_path / "textured2.glb")
    first, second = (trimesh.load_mesh(tmp_path / name) for name in ("textured.glb", "textured2.glb"))
    assert (first.vertices == second.vertices).all()


def test_what_does_not_go_together_is_refused(run: Path, tmp_path: Path) -> None:
    for words, about in [
        (["--alpha"], "--alpha: is for soups"),
        (["--crop", "auto"], "--crop: is for soups"),
        (["--texture", "66"], "multiple of 4"),
        (["--texture", "5"], "texture: is 5"),
        (["--texture", "64", "--normals", "--format", "obj"], "hold no normal map"),
        (["--normals"], "normals: has an effect only with --texture"),
        (["--texture", "128", "--lods", "2"], "lods: 2 times half of 128 texels is less than 64"),
        (["--lods", "1"], "lods: has an effect only with --texture"),
        (["--texture", "64", "--out", tmp_path / "none" / "ball.glb"], "create the folder first"),
        (["--out", run / "mesh.ply"], "is what is read"),
        (["--format", "off"], r"exported\.off: a mesh is not written into files of this kind; choose one of \.glb"),
        (["--format", "html"], r"exported\.html: a mesh is not written into files of this kind; choose one of"),
    ]:
        with pytest.raises(InputError, match=about):
            export(run, *words)
    with pytest.raises(InputError, match=r"^normals: has an effect only with texture; leave"):
        etsplat.ExportConfig(normals=True)
    with pytest.raises(InputError, match=r"^alpha: is for soups; of a reconstruction's mesh there are texture, fa"):
        etsplat.export(run, tmp_path / "a.glb", etsplat.ExportConfig(alpha=True))
    with pytest.raises(
        InputError, match=r"stored in another way; leave out compress, or choose a path that ends in \.glb$"
    ):
        etsplat.export(run, tmp_path / "a.ply", etsplat.ExportConfig(compress="quantize"))
    with pytest.raises(InputError, match="of `etsplat reconstruct`"):
        etsplat.texture_mesh(tmp_path)
    with pytest.raises(InputError, match="name a run of `etsplat train`"):
        open_run(run)


def test_a_run_of_something_else_by_now_is_refused(run: Path, tmp_path: Path) -> None:
    config = RunDirectory(run).read_config()
    source = Path(config["paths"]["source"])
    vertices, faces = icosphere(1)
    save_mesh(tmp_path / source.name, vertices, faces)
    with pytest.raises(InputError, match="is not what the run was made of"):
        etsplat.texture_mesh(run, size=64, scene=tmp_path / source.name)
    copy = tmp_path / "copy"
    RunDirectory.create(copy, {key: value for key, value in config.items() if key != "format"})
    with pytest.raises(InputError, match=r"has no mesh\.ply"):
        etsplat.texture_mesh(copy, size=64)
    assert json.loads((copy / "config.json").read_text())["task"] == "reconstruct"


@pytest.mark.parametrize("words", [["--up", "y"], ["--texture", "64"]])
def test_what_a_run_is_of_may_have_gone(run: Path, tmp_path: Path, words: list[str]) -> None:
    """Which was answered as if its path had been mistyped, with another that it might be."""
    shutil.copytree(run, tmp_path / "run")
    config = RunDirectory(run).read_config()
    config["paths"]["source"] = str(tmp_path / "photos")
    (tmp_path / "photo").mkdir()
    (tmp_path / "run" / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match=r"run: what it is of, .*photos, has gone; name where it is now with --scene$"):
        export(tmp_path / "run", *words)


def test_a_mesh_goes_to_the_world_where_the_run_says(run: Path, tmp_path: Path) -> None:
    """In doubles; without a record, and to a place of its own it is refused."""
    with pytest.raises(InputError, match=r"does not say where it lies in the world; write georeference\.json"):
        export(run, "--place", "world", "--out", tmp_path / "a.ply")
    Georeference((500_000.0, 5_400_000.0, 300.0), 2.0, "z").write(run)
    try:
        export(run, "--place", "world", "--out", tmp_path / "a.ply")
        table, own = read_ply_tables(tmp_path / "a.ply")["vertex"], load_mesh(run / "mesh.ply")
        found = np.stack([table[axis] for axis in "xyz"], axis=1)
        expected = 2 * own.vertices.double().numpy() + [500_000.0, 5_400_000.0, 300.0]
        assert np.abs(found - expected).max() < 1e-5
    finally:
        (run / "georeference.json").unlink()


def test_a_textured_mesh_goes_to_the_world_too(run: Path, tmp_path: Path) -> None:
    """By the same scale and offset, quantised or not, as digits or as the place of a node; not exactly."""
    Georeference((500_000.0, 5_400_000.0, 300.0), 2.0, "z").write(run)
    light = ("--texture", "64", "--faces", "100")
    try:
        export(run, *light, "--out", tmp_path / "near.glb")
        for end, more in ((".glb", ("--compress", "quantize")), (".obj", ())):
            export(run, *light, *more, "--place", "world", "--out", tmp_path / f"far{end}")
        with pytest.raises(
            InputError, match=r"leave out --up, --scale and --place, or choose --format glb or obj or ply"
        ):
            export(run, *light, "--place", "world", "--format", "safetensors")
    finally:
        (run / "georeference.json").unlink()
    near = load_mesh(tmp_path / "near.glb").vertices.double()
    low, high = 2 * near.amin(0), 2 * near.amax(0)
    (node,) = check_glb(tmp_path / "far.glb")["nodes"]
    x, y, z = node["translation"]
    assert [x, -z, y] == pytest.approx((low + torch.tensor([500_000, 5_400_000, 300])).tolist(), abs=1e-4)
    rows = [line.split()[1:] for line in (tmp_path / "far.obj").read_text().splitlines() if line.startswith("v ")]
    places = np.array(rows, dtype=np.float64) - [500_000, 5_400_000, 300]
    assert abs(places - np.clip(places, low.numpy() - 1e-4, high.numpy() + 1e-4)).max() == 0


def test_a_mesh_is_turned_scaled_and_placed(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By where up is as its photos were held; the object of a mesh has +y or +z up as it is."""
    sideways = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)  # y to z
    poses = circle_poses(6)
    poses[:, :3, :3] = poses[:, :3, :3] @ sideways.T
    write_colmap(tmp_path / "scene", [(16, 12)] * 6, poses=poses)
    own = load_mesh(run / "mesh.ply").vertices.double()
    export(run, "--scale", "0.5", "--up", "z", "--place", "ground", "--out", tmp_path / "still.ply")
    still = load_mesh(tmp_path / "still.ply").vertices.double()
    assert (still - still[0] - 0.5 * (own - own[0])).abs().max() < 1e-5
    said = capsys.readouterr().out
    assert "nothing is turned, since photos do not say where up is: +z is up if it was in the input" in said
    export(run, "--scene", tmp_path / "scene", "--up", "y", "--place", "ground", "--out", tmp_path / "up.glb")
    found = trimesh.load_mesh(tmp_path / "up.glb")
    low, high = torch.tensor(found.bounds)
    assert "turned by the photos of another scene" in capsys.readouterr().out
    assert abs(float(low[1])) < 1e-5
    assert (low + high)[[0, 2]].abs().max() < 1e-5
    height = (own @ sideways).amax(0) - (own @ sideways).amin(0)
    assert abs(float(high[1] - low[1] - height[1])) < 1e-3
    with pytest.raises(InputError, match="needs to know which way is up"):
        export(run, "--place", "ground", "--out", tmp_path / "b.glb")
    with pytest.raises(InputError, match="leave out --up z, or choose"):
        export(run, "--up", "z", "--out", tmp_path / "b.glb")


def test_a_textured_mesh_is_turned_with_its_normals(run: Path, tmp_path: Path) -> None:
    """Up is +z by the record: what was at (x, y, z) is at 2 (x, z, -y)."""
    light = ("--texture", "64", "--faces", "100", "--normals")
    export(run, *light, "--out", tmp_path / "own.glb")
    Georeference((0.0, 0.0, 0.0), 1.0, "z").write(run)
    try:
        export(run, *light, "--up", "y", "--scale", "2", "--out", tmp_path / "up.glb")
    finally:
        (run / "georeference.json").unlink()
    own, up = (trimesh.load_mesh(tmp_path / name, process=False) for name in ("own.glb", "up.glb"))
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    np.testing.assert_allclose(up.vertices, 2 * own.vertices @ turn.T, atol=1e-5)
    np.testing.assert_allclose(up.vertex_normals, own.vertex_normals @ turn.T, atol=1e-5)


def test_how_a_file_is_stored(run: Path, tmp_path: Path) -> None:
    """Smaller, and with the same faces; other kinds of files, and soups' settings without effect, are refused."""
    light = ("--texture", "128", "--faces", "300")
    export(run, *light, "--out", tmp_path / "a.glb")
    export(run, *light, "--compress", "quantize", "--pictures", "webp", "--out", tmp_path / "b.glb")
    first, second = (load_mesh(tmp_path / name) for name in ("a.glb", "b.glb"))
    assert len(first.faces) == len(second.faces)
    assert (first.vertices.amax(0) - second.vertices.amax(0)).abs().max() < 6 / 65535
    assert (tmp_path / "b.glb").stat().st_size < 0.8 * (tmp_path / "a.glb").stat().st_size
    export(run, "--compress", "quantize", "--out", tmp_path / "c.glb")
    assert check_glb(tmp_path / "c.glb")["extensionsRequired"] == ["KHR_mesh_quantization"]
    for words, about in [
        (["--compress", "quantize", "--format", "obj"], r"leave out --compress, or choose --format glb"),
        ([*light, "--pictures", "webp", "--format", "obj"], r"leave out --pictures, or choose --format glb"),
        (["--pictures", "webp"], "pictures: has an effect only with --texture"),
        ([*light, "--occlusion"], "occlusion: has an effect only with --normals"),
    ]:
        with pytest.raises(InputError, match=about):
            export(run, *words)


def test_ambient_occlusion_lies_beside_normals(run: Path, tmp_path: Path) -> None:
    """Of a ball, which nothing shades, nearly white; half as many texels along each side."""
    export(run, "--texture", "128", "--faces", "100", "--normals", "--occlusion", "--out", tmp_path / "ball.glb")
    (material,) = check_glb(tmp_path / "ball.glb")["materials"]
    assert material["occlusionTexture"] == {"index": 2}
    shade = np.asarray(trimesh.load_mesh(tmp_path / "ball.glb").visual.material.occlusionTexture)
    assert shade.shape == (64, 64)
    assert np.median(shade) > 230


def test_a_demo_is_a_scene_of_files_and_meshes_too(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its name was taken for a folder's."""
    monkeypatch.setattr(sources, "demo_scene", lambda *size, progress=None: small_demo_scene())
    assert open_run(run / "mesh.glb", Path("demo:scene"), "cpu").needed_capture().names == small_demo_scene().names
    export(run, "--scene", "demo:owl", "--up", "y", "--out", tmp_path / "up.glb")
    assert "nothing is turned" in capsys.readouterr().out
    with pytest.raises(InputError, match="demo:owls"):
        open_run(run / "mesh.glb", "demo:owls", "cpu")
