"""`etsplat.export` of the mesh of a reconstruction, from Python."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import etsplat
from etsplat.io.mesh_files import load_exported
from etsplat.model.soup_import import load_soup
from etsplat.tasks.export_mesh import export_mesh
from etsplat.tasks.starts import load_start

TINY = etsplat.ReconstructConfig.tiny().changed({"iterations": 5, "resolution": 24})


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> etsplat.ReconstructResult:
    return etsplat.reconstruct("demo:owl", tmp_path_factory.mktemp("runs") / "owl", TINY)


@pytest.mark.parametrize("folder", [False, True])
def test_the_mesh_is_written_as_it_is(result: etsplat.ReconstructResult, folder: bool, tmp_path: Path) -> None:
    written = etsplat.export(result.path if folder else result, tmp_path / "owl.ply")
    found = etsplat.load_mesh(written.path)
    assert written.triangles == len(found.faces) == len(result.mesh.faces)
    torch.testing.assert_close(found.vertices, result.mesh.vertices)


def test_it_is_scaled_and_placed_and_says_how(result: etsplat.ReconstructResult, tmp_path: Path) -> None:
    config = etsplat.ExportConfig(up="y", scale=2.0, place="ground")
    written = etsplat.export(result, tmp_path / "owl.obj", config)
    found = etsplat.load_mesh(written.path).vertices
    assert float(found[:, 1].min()) == pytest.approx(0, abs=1e-5)
    moved = written.transform.apply(result.mesh.vertices).float()
    torch.testing.assert_close(moved.aminmax(dim=0).max, found.aminmax(dim=0).max, atol=1e-5, rtol=0)


def test_what_meshes_do_not_know_is_refused(result: etsplat.ReconstructResult, tmp_path: Path) -> None:
    with pytest.raises(etsplat.InputError, match="is for soups"):
        etsplat.export(result, tmp_path / "owl.glb", etsplat.ExportConfig(colors="keep"))
    with pytest.raises(etsplat.InputError, match="a mesh is not written into files of this kind"):
        etsplat.export(result, tmp_path / "owl.html")


def test_a_mesh_in_memory_is_handed_in_again(tmp_path: Path) -> None:
    """Of it +y is up, as of one in a file."""
    mesh = etsplat.MeshFile(*etsplat.icosphere(2))
    config = etsplat.ReconstructConfig.tiny().changed({"iterations": 20})
    result = etsplat.reconstruct(mesh, tmp_path / "run", config)
    upright, path = etsplat.ExportConfig(up="y"), tmp_path / "ball.glb"
    with pytest.raises(etsplat.InputError, match=r"a mesh in memory perhaps.*hand it in again"):
        etsplat.export(result, path, upright)
    written = etsplat.export(result, path, upright, scene=mesh)
    assert any("+y is up if it was in the input" in note for note in written.notes)


def test_the_mesh_that_is_read_is_not_written_over(result: etsplat.ReconstructResult) -> None:
    """Moved in its own place it would be moved again by the next export, and a texture fitted to it where it is not."""
    for source in (result, result.path):
        with pytest.raises(etsplat.InputError, match=r"mesh\.ply: is what is read; choose another file"):
            etsplat.export(source, result.path / "mesh.ply", etsplat.ExportConfig(scale=2.0))


@pytest.mark.parametrize(
    ("kind", "textured"), [("glb", False), ("ply", False), ("obj", False), ("glb", True), ("obj", True)]
)
def test_a_file_says_how_it_was_moved_and_is_led_back(
    result: etsplat.ReconstructResult, kind: str, textured: bool, tmp_path: Path
) -> None:
    """It said nothing, where files of scenes do."""
    path = tmp_path / f"owl.{kind}"
    config = etsplat.ExportConfig(up="y", scale=3.0, place="ground", **({"texture": 64} if textured else {}))
    export_mesh(result.path, path, config)
    there, (back, record) = etsplat.load_mesh(path).vertices, load_exported(path)
    assert (record["up"], record["place"]) == ("y", "ground")
    assert float(there[:, 1].min()) == pytest.approx(0, abs=0.05)
    low, high = result.mesh.vertices.aminmax(dim=0)
    found_low, found_high = back.vertices.aminmax(dim=0)
    tolerance = 0.2 if textured else 1e-5  # fewer faces
    torch.testing.assert_close(found_low, low, atol=tolerance, rtol=0)
    torch.testing.assert_close(found_high, high, atol=tolerance, rtol=0)
    opened = load_soup(path).vertices.reshape(-1, 3)
    torch.testing.assert_close(opened.aminmax(dim=0).max, found_high, atol=1e-5, rtol=0)


def test_photos_of_another_scene_are_said_to_turn_it(tmp_path: Path) -> None:
    """As where a name was mistyped; the same photos elsewhere, in another unit, are its own."""
    own = etsplat.photograph(etsplat.demo_object(), 16, 16)
    result = etsplat.reconstruct(own, tmp_path / "run", TINY)
    assert result.path is not None
    config = etsplat.ExportConfig(up="y")
    moved = own.renormalized((1.0, 2.0, 3.0), 2.0)
    assert etsplat.export(result, tmp_path / "own.ply", config, scene=moved).notes == ()
    other = replace(own, viewmats=own.viewmats.flip(0))
    (note,) = etsplat.export(result, tmp_path / "other.ply", config, scene=other).notes
    assert note == "it is turned by the photos of another scene than the run was made of, which scene= names"


def test_a_scene_that_has_no_use_is_told(result: etsplat.ReconstructResult, tmp_path: Path) -> None:
    """Where nothing is turned, even a folder that is not there was taken without a word."""
    (note,) = etsplat.export(result, tmp_path / "a.ply", scene=tmp_path / "nowhere").notes
    assert note.startswith('scene has no use here: its photos say where up is, with up="y" or "z", and')


@pytest.mark.parametrize("kind", ["glb", "ply", "obj"])
def test_a_mesh_that_was_moved_says_so_and_is_led_back_where_runs_start_from_it(
    result: etsplat.ReconstructResult, kind: str, tmp_path: Path
) -> None:
    """It lay elsewhere than its run without a word; a run that was to start from it began beside its object."""
    path, still = tmp_path / f"moved.{kind}", tmp_path / f"still.{kind}"
    etsplat.export(result, path, etsplat.ExportConfig(up="y", scale=100.0, place="ground"))
    etsplat.export(result, still)
    assert etsplat.load_mesh(still).notes == ()
    (note,) = etsplat.load_mesh(path).notes
    assert "lies as in the file, and not as the run that it is of" in note
    start, same = load_start(path), load_start(still)
    assert start is not None
    assert same is not None
    assert "led back to where it was" in start.notes[0]
    torch.testing.assert_close(start.vertices.aminmax(dim=0), same.vertices.aminmax(dim=0), atol=1e-4, rtol=0)
