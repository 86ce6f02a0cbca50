"""`etsplat.export`: from memory and from folders, what `etsplat export` writes."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

import etsplat
from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from etsplat.model.solid_soup import SolidSoup
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.render_soup import draw, drawn_soup

TINY = etsplat.TrainConfig.tiny().changed({"width": 32, "iterations": 60})


@pytest.fixture(scope="module")
def capture() -> etsplat.Dataset:
    return etsplat.demo_scene(32, 24)


@pytest.fixture(scope="module")
def result(capture: etsplat.Dataset, tmp_path_factory: pytest.TempPathFactory) -> etsplat.TrainResult:
    return etsplat.train(capture, tmp_path_factory.mktemp("run"), TINY.changed({"asset": True}))


def test_a_result_its_folder_and_the_command_line_write_the_same(result, capture, tmp_path: Path) -> None:
    """The opaque mesh of a run of a data set in memory, which is handed in for what the run cannot say."""
    config = etsplat.ExportConfig(clean=True)
    export_soup(open_run(result.path, capture), tmp_path / "scene.glb", config)
    asked = (tmp_path / "scene.glb").read_bytes()
    for name, source in (("result", result), ("folder", result.path), ("text", str(result.path))):
        (tmp_path / name).mkdir()
        written = etsplat.export(source, tmp_path / name / "scene.glb", config, scene=capture)
        assert written.path.read_bytes() == asked
        loaded = trimesh.load(written.path)
        assert sum(len(mesh.faces) for mesh in loaded.geometry.values()) == written.triangles


def test_a_soup_is_written_by_itself(result, capture, tmp_path: Path) -> None:
    """As it is drawn; colours are baked by the photos that are named."""
    soup = replace(result.soup, appearance=replace(result.soup.appearance, opacity_floor=0.9))
    alone = etsplat.export(soup, tmp_path / "alone.ply")
    assert alone.triangles + sum(alone.removed.values()) == len(soup)
    assert set(alone.removed) == {"sky"}
    seen = etsplat.export(soup, tmp_path / "seen.ply", scene=capture)
    assert alone.path.read_bytes() != seen.path.read_bytes()
    etsplat.export(soup, tmp_path / "soup.safetensors")
    again = etsplat.TriangleSoup.load(tmp_path / "soup.safetensors")
    torch.testing.assert_close(again.opacities, soup.drawn_opacities)


def test_what_it_cannot_do_is_said(result, tmp_path: Path) -> None:
    """Of settings of meshes, and of a scene that is nowhere."""
    with pytest.raises(InputError, match=r"texture: belongs to a run of reconstruct; take etsplat\.texture_mesh"):
        etsplat.export(result, tmp_path / "scene.glb", etsplat.ExportConfig(texture=512))
    with pytest.raises(InputError, match="was a Dataset in memory, or has moved; name the scene's folder"):
        etsplat.export(result, tmp_path / "scene.glb", etsplat.ExportConfig(clean=True))
    with pytest.raises(ValueError, match="config must be an ExportConfig, got TrainConfig"):
        etsplat.export(result, tmp_path / "scene.glb", TINY)


def test_settings_of_soups_say_so_where_there_is_an_opaque_mesh(result, capture, tmp_path: Path) -> None:
    """Which has no opacities; its depths and normals are drawn of it, as its colours are."""
    with pytest.raises(
        InputError, match=r'^min_opacity: the opaque mesh has no fainter triangles; leave it out, or triangles="soup"$'
    ):
        etsplat.export(result, tmp_path / "scene.glb", etsplat.ExportConfig(min_opacity=0.5))
    soup = etsplat.ExportConfig(min_opacity=0.1, triangles="soup")
    assert etsplat.export(result, tmp_path / "scene.glb", soup).triangles != len(result.opaque.faces)
    run = open_run(result.path, capture)
    drawn = drawn_soup(run, RenderConfig(opaque=True, depth=True, normals=True))
    assert isinstance(drawn, SolidSoup)
    pictures = draw(drawn, capture.cameras[0], RenderConfig(opaque=True, depth=True, normals=True))
    assert torch.equal(pictures["color"], draw(drawn, capture.cameras[0], RenderConfig(opaque=True))["color"])
    assert (pictures["depth"] > 0).float().mean() > 0.9


def test_a_texture_of_a_run_in_memory_is_made_of_the_data_set(tmp_path: Path) -> None:
    """Which is handed in again; without it, or with another, it is said what is missing."""
    pytest.importorskip("xatlas")
    views = etsplat.photograph(etsplat.demo_object(), 24, 24, elevations=(-30.0, 30.0), azimuths=6, supersampling=1)
    etsplat.reconstruct(views, tmp_path / "run", etsplat.ReconstructConfig.tiny().changed({"iterations": 20}))
    assert etsplat.texture_mesh(tmp_path / "run", size=64, faces=100, scene=views).count <= 100
    with pytest.raises(InputError, match="does not say what it is of, a Dataset or a mesh in memory perhaps"):
        etsplat.texture_mesh(tmp_path / "run", size=64, faces=100)
    with pytest.raises(InputError, match="size: is 66; it must be a multiple of 4"):
        etsplat.texture_mesh(tmp_path / "run", size=66)
    with pytest.raises(InputError, match="the data set is not what the run was made of"):
        etsplat.texture_mesh(tmp_path / "run", size=64, faces=100, scene=replace(views, train=views.train[1:]))


@pytest.mark.parametrize("name", ["soup.safetensors", "opaque.safetensors"])
def test_what_a_run_is_read_from_is_not_written_over(result, tmp_path: Path, name: str) -> None:
    """The opaque mesh of a run was replaced by its soup, after which nothing could open the run."""
    shutil.copytree(result.path, tmp_path / "run")
    before = (tmp_path / "run" / name).read_bytes()
    with pytest.raises(InputError, match=rf"^\S*{name}: is what is read; choose another file$"):
        etsplat.export(tmp_path / "run", tmp_path / "run" / name)
    with pytest.raises(InputError, match=rf"^--out \S*{name}: is what is read; choose another file$"):
        parse(["export", str(tmp_path / "run"), "--out", str(tmp_path / "run" / name)]).run([])
    assert (tmp_path / "run" / name).read_bytes() == before
