"""Shape reconstruction (paper section 3.3): posed images of an object in, a run directory with its mesh out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from etsplat.engines.choice import engine, engine_for, resolve_device
from etsplat.io.mesh_files import MeshFile, save_mesh
from etsplat.io.run_directory import RunDirectory
from etsplat.ops.antialias_nvdiffrast import load_nvdiffrast
from etsplat.optim.loop import Progress
from etsplat.tasks.mesh_fitting import MeshFitting
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.running import (
    Callback,
    NoteEvent,
    Place,
    PrepareEvent,
    announcer,
    common_metrics,
    fit,
    loop_settings,
    make_record,
    path_of,
)
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.sources import Source, fingerprint, load_source, load_start, make_start, make_subject


@dataclass(frozen=True)
class ReconstructResult:
    """What a run gives back; all of it is in the run directory too.

    Attributes:
        path: the run directory.
        mesh: the result with its colours, in the units of the input.
        metrics: as in metrics.json.
    """

    path: Path
    mesh: MeshFile
    metrics: dict[str, Any]


def reconstruct(
    source: Source,
    out: str | Path,
    config: ReconstructConfig | None = None,
    *,
    init_mesh: str | Path | MeshFile | None = None,
    masks: str | Path | None = None,
    callbacks: Sequence[Callback] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> ReconstructResult:
    """Deforms a sphere into the object that the source shows.

    A run ends with the same bits on the same machine, torch and number of threads, also if it was killed and resumed
    any number of times. Ctrl-C leaves a checkpoint of the last whole iteration.

    Args:
        source: a mesh file or `MeshFile`, which is photographed from 40 sides; "demo:owl", an object built in code; a
            folder with posed images and masks, or a `Dataset` with the object in the unit sphere (`renormalized` and
            `bounding_sphere` bring it there).
        out: the run directory; made if it does not exist. README.txt in it explains what is there.
        config: settings; None for preset "best". See `ReconstructConfig`.
        init_mesh: a mesh to start from instead of the sphere, in the units of the source.
        masks: folder with a mask (white inside the object) for every image of a scene folder, instead of its own masks/
            or the images' transparency.
        callbacks: each is called with every event, in the thread of the caller.
        resume: continue the run in `out`, which must have been started with the same source and settings; from the
            beginning if it has no checkpoint yet.
        overwrite: replace a run in `out`. Nothing but files of a run is ever removed.

    Raises:
        InputError: something handed in cannot be used; earlier results in `out` are as they were.
        DivergedError: the optimization went to NaN or infinity.
    """
    config = config or ReconstructConfig()
    device = resolve_device(config.device, config.engine)
    place, announce = Place(Path(out), resume, overwrite), announcer(callbacks)
    place.check()
    loaded, start = load_source(source, config, masks), load_start(init_mesh)
    hashes = {"fingerprint": fingerprint(loaded), "init_mesh": fingerprint(start)}
    paths = {"source": path_of(source), "init_mesh": path_of(init_mesh)}
    record = make_record(config, config.iterations, hashes, paths)
    if resume:
        place.open(record)  # refuses another run before pictures are taken
    for name, mesh in (("source", loaded), ("init_mesh", start)):
        for note in mesh.notes if isinstance(mesh, MeshFile) else ():
            announce(NoteEvent(f"{name}: {note}"))
    subject = make_subject(loaded, config, lambda done, total: announce(PrepareEvent(done, total)), device)
    if config.drawing.backend == "nvdiffrast":
        load_nvdiffrast()  # now rather than at the first step
    with engine(config.engine):
        scorer = Scorer(subject, config, device)
        fitting = MeshFitting(make_start(start, subject.views, config, device), subject.views, config, scorer.cheap)
        run = place.open(record)
        with engine_for(fitting.mesh.vertices).looping():
            progress = fit(fitting, run, loop_settings(config), record, announce)
        return _finish(fitting, progress, run, scorer, subject.views.normalization.invert, config)


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
    colors = mesh.named(mesh.display_colors.cpu())
    result = MeshFile(to_input_units(mesh.vertices.detach().cpu()), mesh.faces.cpu(), **colors)
    for suffix in (".ply", ".obj", ".glb"):
        save_mesh(run.mesh_path(suffix), result.vertices, result.faces, **colors)
    run.write_metrics({**scorer.full(mesh, run.test), **common_metrics(progress, config, mesh.vertices)})
    return ReconstructResult(run.path, result, run.read_metrics())
