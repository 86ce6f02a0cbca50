"""Runs that end with a light textured mesh beside their mesh."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile, save_mesh
from etsplat.io.run_directory import RunDirectory
from etsplat.model.textured_mesh import TexturedMesh
from etsplat.optim.loop import Event, StageEvent
from etsplat.report import write_report
from etsplat.tasks import reconstruct as task
from etsplat.tasks import texturing
from etsplat.tasks.export_mesh import texture_mesh
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from helpers.reconstructions import KilledError
from helpers.torch_threads import on_each_count

pytest.importorskip("xatlas")
pytest.importorskip("fast_simplification")

SHORT = ReconstructConfig.tiny().changed({"iterations": 20, "resolution": 32, "start.level": 3})
TEXTURED = SHORT.changed({"texture": 64, "output.texture_faces": 200})


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball in many colours, far from the origin."""
    path = tmp_path_factory.mktemp("meshes") / "ball.ply"
    vertices, faces = icosphere(2)
    save_mesh(path, 3 * vertices + 10, faces, face_colors=0.5 + 0.4 * vertices[faces].mean(dim=1))
    return path


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texturing, "EPOCHS", (1, 1, 1))


def test_a_run_ends_with_the_file_that_export_writes(ball: Path, tmp_path: Path) -> None:
    """In the same bits; its score and size are in metrics.json and on the page, and it is said how far it is."""
    events: list[Event] = []
    result = reconstruct(ball, tmp_path / "run", TEXTURED, callbacks=[events.append])
    run = RunDirectory(result.path)
    texture_mesh(run.path, size=64, faces=200).save(tmp_path / "textured.glb")
    assert run.textured_path.read_bytes() == (tmp_path / "textured.glb").read_bytes()
    found = TexturedMesh.load(run.textured_path)
    assert found.count == result.metrics["textured_faces"] <= 200
    assert found.texture.shape == (64, 64, 3)
    assert result.metrics["psnr_textured"] > result.metrics["psnr_mesh"] + 5
    stages = [event for event in events if isinstance(event, StageEvent)]
    assert {event.name for event in stages} == {"Simplifying", "Unwrapping", "Fitting the texture"}
    assert (stages[-1].done, stages[-1].total) == (96, 96)
    page = write_report(run.path).read_text(encoding="utf-8")
    assert f"{result.metrics['psnr_textured']:.2f}" in page
    assert "under a texture of 64 × 64 texels" in page
    assert "textured.glb" in (run.path / "README.txt").read_text(encoding="utf-8")
    reconstruct(ball, run.path, SHORT, overwrite=True)
    assert not run.textured_path.exists()


def test_a_run_that_was_killed_while_its_texture_was_fitted_ends_the_same(ball: Path, tmp_path: Path) -> None:
    """Resumed it has the file of one that was never interrupted."""

    def kill(event: Event) -> None:
        if isinstance(event, StageEvent) and event.done > 40:
            raise KilledError

    with pytest.raises(KilledError):
        reconstruct(ball, tmp_path / "killed", TEXTURED, callbacks=[kill])
    killed = RunDirectory(tmp_path / "killed")
    assert killed.mesh_path(".ply").is_file()
    assert not killed.textured_path.exists()
    assert not killed.metrics_path.exists()
    reconstruct(ball, killed.path, TEXTURED, resume=True)
    whole = RunDirectory(reconstruct(ball, tmp_path / "whole", TEXTURED).path)
    assert killed.textured_path.read_bytes() == whole.textured_path.read_bytes()


def test_photos_that_watched_the_run_are_fitted_to_as_well(
    ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Dataset] = []
    fit = texturing.texture_object

    def keep(mesh: MeshFile, views: Dataset, **more: object) -> TexturedMesh:
        seen.append(views)
        return fit(mesh, views, **more)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr("etsplat.tasks.export_mesh.texture_object", keep)
    reconstruct(ball, tmp_path / "run", replace(TEXTURED, watch=4))
    assert (len(seen[0].train), len(seen[0].test), seen[0].watched) == (32, 8, [])


def test_what_cannot_be_made_is_refused_before_the_run(
    ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A size that cannot be halved twice, faces without a texture, a missing package: no folder is left."""
    with pytest.raises(InputError, match="texture: is 66; it must be a multiple of 4"):
        SHORT.changed({"texture": 66})
    with pytest.raises(InputError, match=r"output\.texture_faces: has an effect only with a texture"):
        SHORT.changed({"output.texture_faces": 100})

    def missing() -> None:
        raise InputError("textures need xatlas")

    monkeypatch.setattr(task, "check_installed", missing)
    with pytest.raises(InputError, match="need xatlas"):
        reconstruct(ball, tmp_path / "run", TEXTURED)
    assert not (tmp_path / "run").exists()


def test_the_texture_has_equal_bits_on_any_number_of_torchs_threads(ball: Path, tmp_path: Path) -> None:
    """Every byte of the file."""
    run = reconstruct(ball, tmp_path / "run", SHORT).path

    def written() -> bytes:
        texture_mesh(run, size=512, faces=200).save(tmp_path / "light.glb")
        return (tmp_path / "light.glb").read_bytes()

    assert len(set(on_each_count(written))) == 1


def test_runs_have_torch_compute_on_one_thread(ball: Path, tmp_path: Path) -> None:
    """Also between their loops."""
    seen: set[int] = set()

    def hear(event: Event) -> None:
        seen.add(torch.get_num_threads())

    on_each_count(lambda: reconstruct(ball, tmp_path / "run", TEXTURED, callbacks=[hear], overwrite=True))
    assert seen == {1}
