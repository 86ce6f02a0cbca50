"""`etsplat.export` of the mesh of a reconstruction, from Python."""

from pathlib import Path

import pytest
import torch

import etsplat
from etsplat.io.mesh_files import load_exported
from etsplat.model.soup_import import open_soup
from etsplat.tasks.export_mesh import export_mesh

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
    with pytest.raises(etsplat.InputError, match="files of this kind are for soups"):
        etsplat.export(result, tmp_path / "owl.html")


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
    opened = open_soup(path).vertices.reshape(-1, 3)
    torch.testing.assert_close(opened.aminmax(dim=0).max, found_high, atol=1e-5, rtol=0)
