"""Shape reconstruction from end to end, on a preset that takes a second."""

import json
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.geometry.topology import MeshTopology
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.io.run_directory import RunDirectory
from etsplat.optim.loop import (
    CheckpointEvent,
    DivergedError,
    DoneEvent,
    Event,
    PrepareEvent,
    RefineEvent,
    StepEvent,
)
from etsplat.optim.trainer import Trainer
from etsplat.tasks.reconstruct import ReconstructResult, reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from helpers.reconstructions import SHORT, TINY, KilledError, kill_at, pebble_mesh, untimed


@pytest.fixture(scope="module")
def pebble() -> MeshFile:
    return pebble_mesh()


@pytest.fixture(scope="module")
def whole_run(pebble: MeshFile, tmp_path_factory: pytest.TempPathFactory) -> ReconstructResult:
    """A run of SHORT that nothing interrupted."""
    return reconstruct(pebble, tmp_path_factory.mktemp("whole"), SHORT)


@pytest.fixture(scope="module")
def owl(tmp_path_factory: pytest.TempPathFactory) -> tuple[ReconstructResult, list[Event]]:
    """The demo's object with preset tiny, and the events."""
    events: list[Event] = []
    return reconstruct(demo_object(), tmp_path_factory.mktemp("owl"), TINY, callbacks=[events.append]), events


def test_a_small_shape_is_reconstructed(owl: tuple[ReconstructResult, list[Event]]) -> None:
    """From a sphere with a Chamfer distance of about 0.4, the owl at 64 x 64 gets below 0.01, and looks like it."""
    metrics = owl[0].metrics
    assert metrics["chamfer"] < 0.01
    assert metrics["chamfer_exact"] < metrics["chamfer"]
    assert metrics["psnr"] > 18
    assert metrics["psnr_mesh"] > 18
    assert TINY.max_faces - 4 <= metrics["faces"] <= TINY.max_faces
    assert metrics["degenerate_faces"] == 0


def test_the_result_is_a_closed_oriented_mesh(owl: tuple[ReconstructResult, list[Event]]) -> None:
    """Subdivision kept the sphere's topology: closed, manifold, oriented, Euler characteristic 2."""
    mesh = owl[0].mesh
    topology = MeshTopology.from_faces(mesh.faces, len(mesh.vertices))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()
    assert topology.euler_characteristic() == 2


def test_a_run_directory_holds_everything(owl: tuple[ReconstructResult, list[Event]]) -> None:
    """Meshes, metrics with every key, history, pictures of all 8 test views, two checkpoints, config, README."""
    run = RunDirectory(owl[0].path)
    keys = """chamfer chamfer_floor chamfer_exact f_score psnr psnr_mesh ssim flip flip_mesh lpips faces vertices
        degenerate_faces self_intersections iterations seconds seconds_per_iteration engine method preset seed
        versions"""
    assert set(keys.split()) <= set(run.read_metrics())
    assert sorted(path.name for path in run.test.iterdir()) == sorted(
        f"{view:03d}_{kind}.png" for view in range(8) for kind in ("render", "truth", "mesh")
    )
    assert [path.name for path in sorted(run.checkpoints.iterdir())] == [
        "step_000250.safetensors",
        "step_000300.safetensors",
    ]
    saved = load_mesh(run.mesh_path(".ply"))
    assert torch.equal(saved.faces, owl[0].mesh.faces)
    assert torch.allclose(saved.vertices, owl[0].mesh.vertices)
    assert saved.face_colors is not None
    assert (run.path / "README.txt").exists()
    assert run.mesh_path(".obj").exists()
    assert run.mesh_path(".glb").exists()


def test_history_has_a_line_for_every_log_step(owl: tuple[ReconstructResult, list[Event]]) -> None:
    """Every 20 iterations, with PSNR and Chamfer distance every 100; the last ones are those of metrics.json,
    Chamfer up to its estimation."""
    history = RunDirectory(owl[0].path).read_history()
    assert [line["iteration"] for line in history] == list(range(20, 301, 20))
    assert [line["iteration"] for line in history if "psnr" in line and "chamfer" in line] == [100, 200, 300]
    assert all(line.keys() >= {"iteration", "seconds", "loss", "faces", "sigma"} for line in history)
    assert history[-1]["chamfer"] == pytest.approx(owl[0].metrics["chamfer"], rel=0.2)
    assert history[-1]["psnr"] == pytest.approx(owl[0].metrics["psnr"])


def test_callbacks_see_all_events_in_order(owl: tuple[ReconstructResult, list[Event]]) -> None:
    """40 views are photographed first; iterations never go back; refinements grow the mesh; done is last."""
    events = owl[1]
    prepared = [event for event in events if isinstance(event, PrepareEvent)]
    rest = [event for event in events if not isinstance(event, PrepareEvent)]
    assert prepared == [PrepareEvent(n, 40) for n in range(1, 41)]
    assert events[:40] == prepared
    assert [event.iteration for event in rest] == sorted(event.iteration for event in rest)
    faces = [320] + [event.count for event in rest if isinstance(event, RefineEvent)]
    assert len(faces) == 6
    assert faces == sorted(faces)
    assert [event.iteration for event in rest if isinstance(event, CheckpointEvent)] == list(range(50, 301, 50))
    assert isinstance(rest[-1], DoneEvent)


def test_the_result_is_in_the_units_of_the_input(pebble: MeshFile, whole_run: ReconstructResult) -> None:
    """The exported mesh lies where the input lies and has about its size."""
    low, high = pebble.vertices.amin(0), pebble.vertices.amax(0)
    result = whole_run.mesh.vertices
    assert torch.allclose((result.amin(0) + result.amax(0)) / 2, (low + high) / 2, atol=1.5)
    assert 0.3 < float((result.amax(0) - result.amin(0)).norm() / (high - low).norm()) < 1.5


@pytest.mark.parametrize("iterations", [(3,), (12,), (16,), (24,), (12, 16, 33), (39,), (40,)])
def test_a_killed_run_resumes_to_the_same_bits(
    pebble: MeshFile, whole_run: ReconstructResult, tmp_path: Path, iterations: tuple[int, ...]
) -> None:
    """Killed before the first checkpoint, after one, between a subdivision and the next checkpoint, several times,
    just before and after the last step: history, metrics, meshes and pictures are those of the whole run."""
    for number, iteration in enumerate(iterations):
        with pytest.raises(KilledError):
            reconstruct(pebble, tmp_path, SHORT, callbacks=[kill_at(iteration)], resume=number > 0)
    reconstruct(pebble, tmp_path, SHORT, resume=True)
    assert untimed(tmp_path) == untimed(whole_run.path)


def test_ctrl_c_leaves_a_checkpoint_to_resume_from(
    pebble: MeshFile, whole_run: ReconstructResult, tmp_path: Path
) -> None:
    """Interrupted at iteration 15, the run keeps a checkpoint of it and ends with the whole run's bits."""

    def press(event: Event) -> None:
        if isinstance(event, StepEvent) and event.iteration == 15:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        reconstruct(pebble, tmp_path, SHORT, callbacks=[press])
    assert (tmp_path / "checkpoints" / "step_000015.safetensors").exists()
    events: list[Event] = []
    reconstruct(pebble, tmp_path, SHORT, callbacks=[events.append], resume=True)
    assert min(event.iteration for event in events if not isinstance(event, PrepareEvent)) > 15
    assert untimed(tmp_path) == untimed(whole_run.path)


def test_the_number_of_threads_does_not_matter(pebble: MeshFile, whole_run: ReconstructResult, tmp_path: Path) -> None:
    """One native thread gives the bits of many."""
    before = num_threads()
    set_num_threads(1 if before > 1 else 3)
    try:
        result = reconstruct(pebble, tmp_path, SHORT)
    finally:
        set_num_threads(before)
    assert torch.equal(result.mesh.vertices, whole_run.mesh.vertices)


def test_another_seed_gives_another_result(pebble: MeshFile, whole_run: ReconstructResult, tmp_path: Path) -> None:
    """The seed decides the order of views and the backgrounds."""
    result = reconstruct(pebble, tmp_path, replace(SHORT, seed=1))
    assert not torch.equal(result.mesh.vertices, whole_run.mesh.vertices)


@pytest.mark.parametrize(
    "changes",
    [
        *({"method": method} for method in ("bilateral", "single-sided", "raster-face", "raster-vertex")),
        {"drawing.harmonics": 2},
    ],
)
def test_the_other_methods_run_too(pebble: MeshFile, tmp_path: Path, changes: dict[str, object]) -> None:
    """All baselines go through the same call, record their name, and resume to the same bits; so do harmonics."""
    config = SHORT.changed(changes)
    metrics = reconstruct(pebble, tmp_path / "whole", config).metrics
    assert metrics["method"] == changes.get("method", "elastic")
    with pytest.raises(KilledError):
        reconstruct(pebble, tmp_path / "killed", config, callbacks=[kill_at(27)])
    reconstruct(pebble, tmp_path / "killed", config, resume=True)
    assert untimed(tmp_path / "killed") == untimed(tmp_path / "whole")


@pytest.mark.parametrize("settings", [{"method": "raster-vertex"}, {"drawing.colors": "vertex"}])
def test_vertex_colors_reach_the_files(tmp_path: Path, settings: dict[str, str]) -> None:
    """The mesh and its files have a colour per vertex, and the mesh looks like the truth more than a sphere does."""
    result = reconstruct(demo_object(), tmp_path, TINY.changed(settings))
    assert result.metrics["psnr_mesh"] > 12
    assert result.mesh.face_colors is None
    assert result.mesh.vertex_colors is not None
    for suffix in (".ply", ".obj", ".glb"):
        saved = load_mesh(RunDirectory(tmp_path).mesh_path(suffix))
        assert saved.vertex_colors is not None
        assert torch.allclose(saved.vertex_colors, result.mesh.vertex_colors, atol=0.01)


def test_a_backend_that_is_missing_is_named(pebble: MeshFile, tmp_path: Path) -> None:
    """Without nvdiffrast or CUDA the run ends before it starts, in one line; soft triangles have no such backend."""
    with pytest.raises(InputError, match=r'choose method="raster-face" or "raster-vertex"$'):
        SHORT.changed({"drawing.backend": "nvdiffrast"})
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="needs a CUDA device"):
            reconstruct(pebble, tmp_path, SHORT.changed({"method": "raster-face", "drawing.backend": "nvdiffrast"}))


def test_views_can_be_handed_over(pebble: MeshFile, tmp_path: Path) -> None:
    """A data set of an object without a true mesh: image metrics are there, those against the mesh are null."""
    metrics = reconstruct(photograph(pebble, 48, 48, supersampling=1), tmp_path, SHORT).metrics
    assert metrics["psnr"] > 5
    assert metrics["chamfer"] is None
    assert metrics["self_intersections"] is not None
    assert "chamfer" not in RunDirectory(tmp_path).read_history()[-1]


def test_what_was_learned_of_each_photo_is_in_a_file_of_its_own(pebble: MeshFile, tmp_path: Path) -> None:
    """A matrix for every training photo, neutral in the mean; not there when the run is replaced by one without."""
    views, out = photograph(pebble, 32, 32, supersampling=1), tmp_path / "run"
    result = reconstruct(views, out, SHORT.changed({"exposure": "on"}))
    found = json.loads((out / "exposure.json").read_text())
    assert list(found["matrices"]) == [views.names[index] for index in views.train]
    mean = torch.tensor(list(found["matrices"].values())).mean(dim=0)
    torch.testing.assert_close(mean, torch.eye(3), atol=0.02, rtol=0)
    assert result.metrics["exposure_learned"] is True
    assert -1 < result.metrics["exposure_explained"] < 1
    assert result.metrics["psnr_affine"] >= result.metrics["psnr"]
    assert "exposure.json" in (out / "README.txt").read_text()
    metrics = reconstruct(views, out, SHORT, overwrite=True).metrics
    assert not (out / "exposure.json").exists()
    assert metrics["exposure_learned"] is False


@pytest.mark.shared_data
def test_a_scene_folder_is_reconstructed(shared_data: Path, tmp_path: Path) -> None:
    """NeRF-synthetic lego at 64 x 64: a closed mesh with about its outline, which draws like the splats."""
    result = reconstruct(shared_data / "scenes" / "lego_blender", tmp_path, TINY)
    metrics = result.metrics
    assert metrics["silhouette_iou"] > 0.85
    topology = MeshTopology.from_faces(result.mesh.faces, len(result.mesh.vertices))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert metrics["psnr"] > 17
    assert metrics["psnr_mesh"] > metrics["psnr"] - 2


@pytest.mark.shared_data
def test_masks_can_come_from_elsewhere_and_must_come_from_somewhere(shared_data: Path, tmp_path: Path) -> None:
    """Photos without masks are refused in words; with a folder of masks they load; a mesh takes no masks."""
    scene = tmp_path / "scene"
    scene.mkdir()
    lego = shared_data / "scenes" / "lego_blender"
    (tmp_path / "masks").mkdir()
    document = json.loads((lego / "transforms_train.json").read_text())
    document["frames"] = document["frames"][::10]
    for frame in document["frames"]:
        image = Image.open(lego / f"{frame['file_path']}.png")
        path = scene / f"{frame['file_path']}.png"
        path.parent.mkdir(exist_ok=True)
        image.convert("RGB").save(path)
        image.getchannel("A").save(tmp_path / "masks" / path.name)
    (scene / "transforms.json").write_text(json.dumps(document))
    config = replace(TINY, iterations=2)
    with pytest.raises(InputError, match="cannot be told from its background"):
        reconstruct(scene, tmp_path / "run", config)
    assert reconstruct(scene, tmp_path / "run", config, masks=tmp_path / "masks").metrics["silhouette_iou"] > 0.2
    with pytest.raises(InputError, match="leave them out"):
        reconstruct(demo_object(), tmp_path / "mesh", config, masks=tmp_path / "masks")


def test_a_finished_run_is_not_overwritten_unasked(pebble: MeshFile, tmp_path: Path) -> None:
    """A second run into the same folder is refused and changes nothing; with overwrite it replaces the first."""
    config = replace(SHORT, iterations=4)
    reconstruct(pebble, tmp_path, config)
    before = untimed(tmp_path)
    with pytest.raises(InputError, match="holds a run already"):
        reconstruct(pebble, tmp_path, replace(config, seed=1))
    assert untimed(tmp_path) == before
    reconstruct(pebble, tmp_path, replace(config, seed=1), overwrite=True)
    assert RunDirectory(tmp_path).read_metrics()["seed"] == 1


def test_resume_refuses_other_settings_and_other_input(pebble: MeshFile, tmp_path: Path) -> None:
    """The message names the setting that differs, or the fingerprint of the input; the run is left as it was."""
    with pytest.raises(KilledError):
        reconstruct(pebble, tmp_path, SHORT, callbacks=[kill_at(20)])
    with pytest.raises(InputError, match=r"optimizer\.lr_colors=0\.02 \(not 0\.5\)"):
        reconstruct(pebble, tmp_path, SHORT.changed({"optimizer.lr_colors": 0.5}), resume=True)
    with pytest.raises(InputError, match="fingerprint"):
        reconstruct(demo_object(), tmp_path, SHORT, resume=True)
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2


def test_a_cut_checkpoint_is_named_and_an_earlier_one_works(
    pebble: MeshFile, whole_run: ReconstructResult, tmp_path: Path
) -> None:
    """A damaged checkpoint stops the resume; once it is deleted, the one before leads to the same bits."""
    with pytest.raises(KilledError):
        reconstruct(pebble, tmp_path, SHORT, callbacks=[kill_at(27)])
    newest = tmp_path / "checkpoints" / "step_000020.safetensors"
    newest.write_bytes(newest.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"step_000020.* delete it to resume from step_000010"):
        reconstruct(pebble, tmp_path, SHORT, resume=True)
    newest.unlink()
    reconstruct(pebble, tmp_path, SHORT, resume=True)
    assert untimed(tmp_path) == untimed(whole_run.path)


def test_resume_wants_a_run_and_a_source_that_is_there(pebble: MeshFile, tmp_path: Path) -> None:
    """Nothing to resume, and a source that does not exist, are errors of one line; no folder is made."""
    with pytest.raises(InputError, match="no run to resume"):
        reconstruct(pebble, tmp_path / "run", SHORT, resume=True)
    with pytest.raises(InputError, match=r"nothing\.obj: no such file or folder"):
        reconstruct(tmp_path / "nothing.obj", tmp_path / "run", SHORT)
    assert not (tmp_path / "run").exists()


def test_a_run_that_diverges_names_the_iteration_and_the_checkpoint(
    pebble: MeshFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vertex that becomes NaN after iteration 13 is found at the next log, and no checkpoint holds it."""
    advance = Trainer.advance

    def poisoned(self: Trainer[Any], iteration: int, last: int) -> list[float]:
        losses = advance(self, iteration, last)
        if iteration == 13:
            with torch.no_grad():
                self.model.colors[0] = float("nan")
        return losses

    monkeypatch.setattr(Trainer, "advance", poisoned)
    with pytest.raises(DivergedError, match=r"iteration 1[45].*step_000010") as error:
        reconstruct(pebble, tmp_path, SHORT)
    assert "\n" not in str(error.value)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["step_000010.safetensors"]


def test_config_json_says_how_to_make_it_again(whole_run: ReconstructResult) -> None:
    """Every setting, the fingerprint of the input and the versions are recorded."""
    path = whole_run.path / "config.json"
    config = json.loads(path.read_text())
    assert ReconstructConfig.from_file(path) == SHORT
    assert len(config["source"]["fingerprint"]) == 16
    assert set(config["versions"]) == {"etsplat", "torch", "python"}
