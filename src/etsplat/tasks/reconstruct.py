"""Shape reconstruction (paper section 3.3): posed images of an object in, a run directory with its mesh out."""

import hashlib
import json
import platform
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from etsplat.core.errors import InputError
from etsplat.io.mesh_files import MeshFile, save_mesh
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.ops.engines import num_threads, one_torch_thread, resolve_engine
from etsplat.optim.checkpoints import load_latest_checkpoint, save_checkpoint
from etsplat.optim.loop import Event, LoopSettings, Progress, StepEvent, optimize
from etsplat.tasks.mesh_fitting import MeshFitting
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.sources import Source, fingerprint, load_source, load_start, make_start, make_subject


@dataclass(frozen=True)
class PrepareEvent:
    """While a mesh is photographed, before the first step.

    Attributes:
        done: views taken.
        total: views to take.
    """

    done: int
    total: int


@dataclass(frozen=True)
class NoteEvent:
    """Something about the input that its owner should know, such as a repair made while reading it.

    Attributes:
        text: a sentence.
    """

    text: str


@dataclass(frozen=True)
class ReconstructResult:
    """What a run gives back; all of it is in the run directory too.

    Attributes:
        path: the run directory.
        mesh: the result with face colours, in the units of the input.
        metrics: as in metrics.json.
    """

    path: Path
    mesh: MeshFile
    metrics: dict[str, Any]


Callback = Callable[[Event | PrepareEvent | NoteEvent], None]


def reconstruct(
    source: Source,
    out: str | Path,
    config: ReconstructConfig | None = None,
    *,
    init_mesh: str | Path | MeshFile | None = None,
    callbacks: Sequence[Callback] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> ReconstructResult:
    """Deforms a sphere into the object that the source shows.

    A run ends with the same bits on the same machine, torch and number of threads, also if it was killed and resumed
    any number of times. Ctrl-C leaves a checkpoint of the last whole iteration.

    Args:
        source: a mesh file or `MeshFile`, which is photographed from 40 sides; "demo:owl", an object built in code; a
            folder with posed images and masks, or `PosedViews` with the object in the unit sphere (`renormalized` and
            `bounding_sphere` bring it there).
        out: the run directory; made if it does not exist. README.txt in it explains what is there.
        config: settings; None for preset "paper". See `PRESETS`.
        init_mesh: a mesh to start from instead of the sphere, in the units of the source.
        callbacks: each is called with every event, in the thread of the caller.
        resume: continue the run in `out`, which must have been started with the same source and settings; from the
            beginning if it has no checkpoint yet.
        overwrite: replace a run in `out`. Nothing but files of a run is ever removed.

    Raises:
        InputError: something handed in cannot be used; earlier results in `out` are as they were.
        DivergedError: the optimization went to NaN or infinity.
    """
    config = config or ReconstructConfig()
    out = Path(out)
    if resume and not is_run(out):
        raise InputError(f"{out}: holds no run to resume; start it without --resume")
    if not resume:
        RunDirectory.check_free(out, overwrite=overwrite)

    loaded, start = load_source(source, config), load_start(init_mesh)
    hashes = {"fingerprint": fingerprint(loaded), "init_mesh": fingerprint(start)}
    record = _record(config, hashes, {"source": _path_of(source), "init_mesh": _path_of(init_mesh)})
    if resume:
        RunDirectory.resume(out, record)

    def announce(event: Event | PrepareEvent | NoteEvent) -> None:
        for callback in callbacks:
            callback(event)

    for name, mesh in (("source", loaded), ("init_mesh", start)):
        for note in mesh.notes if isinstance(mesh, MeshFile) else ():
            announce(NoteEvent(f"{name}: {note}"))
    subject = make_subject(loaded, config, lambda done, total: announce(PrepareEvent(done, total)))
    scorer = Scorer(subject, config)
    fitting = MeshFitting(make_start(start, subject.views, config), subject.views, config, scorer.cheap)
    run = RunDirectory.resume(out, record) if resume else RunDirectory.create(out, record, overwrite=overwrite)
    native = resolve_engine(config.engine, fitting.mesh.vertices) == "cpu"
    with one_torch_thread() if native else nullcontext():
        progress = _fit(fitting, run, config, _hash(record), announce)
    return _finish(fitting, progress, run, scorer, subject.views.normalization.invert, config)


def _fit(
    fitting: MeshFitting, run: RunDirectory, config: ReconstructConfig, run_hash: str, announce: Callback
) -> Progress:
    """Runs the loop from the last checkpoint, or from the start, to the end."""
    progress = Progress()
    checkpoint = load_latest_checkpoint(run.checkpoints, run_hash)
    if checkpoint is not None:
        progress = fitting.load_state(checkpoint.tensors, checkpoint.iteration)
    run.truncate_history(progress.iteration)
    settings = LoopSettings(config.iterations, config.log_every, config.evaluate_every, config.checkpoint_every)

    def save(at: Progress) -> Path:
        return save_checkpoint(run.checkpoints, at.iteration, fitting.state(at), run_hash)

    for event in optimize(fitting, settings, progress, save, run.checkpoints):
        if isinstance(event, StepEvent):
            run.append_history(
                {
                    "iteration": event.iteration,
                    "seconds": round(event.seconds, 3),
                    "loss": event.loss,
                    "faces": event.faces,
                    "sigma": event.sigma,
                    **event.metrics,
                }
            )
        announce(event)
    return progress


def _finish(
    fitting: MeshFitting,
    progress: Progress,
    run: RunDirectory,
    scorer: Scorer,
    to_input_units: Callable[[torch.Tensor], torch.Tensor],
    config: ReconstructConfig,
) -> ReconstructResult:
    """Exports the mesh, draws the test views, measures everything."""
    mesh = fitting.mesh
    vertices = mesh.vertices.detach()
    result = MeshFile(to_input_units(vertices), mesh.faces, face_colors=mesh.display_colors)
    for suffix in (".ply", ".obj", ".glb"):
        save_mesh(run.mesh_path(suffix), result.vertices, result.faces, result.face_colors)
    metrics = {
        **scorer.full(mesh, run.test),
        "iterations": progress.iteration,
        "seconds": progress.seconds,
        "seconds_per_iteration": progress.seconds / progress.iteration,
        "engine": resolve_engine(config.engine, vertices),
        "threads": num_threads(),
        "method": config.method,
        "preset": config.preset,
        "seed": config.seed,
        "versions": _versions(),
    }
    run.write_metrics(metrics)
    return ReconstructResult(run.path, result, run.read_metrics())


def _record(config: ReconstructConfig, hashes: dict[str, str | None], paths: dict[str, str | None]) -> dict[str, Any]:
    """What config.json holds. Inputs are identified by their hashes; paths are for the reader."""
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in vars(config).items()}
    return {"task": "reconstruct", "config": settings, "source": hashes, "paths": paths, "versions": _versions()}


def _path_of(source: object) -> str | None:
    return str(source) if isinstance(source, str | Path) else None


def _hash(record: dict[str, Any]) -> str:
    """Identifies all that the result depends on."""
    relevant = {key: record[key] for key in ("task", "config", "source")}
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()


def _versions() -> dict[str, str]:
    return {"etsplat": version("etsplat"), "torch": torch.__version__, "python": platform.python_version()}
