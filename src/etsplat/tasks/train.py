"""Novel-view synthesis (paper section 3.4): photos in, a run directory with a triangle soup out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from etsplat.core.precision import usual_defaults
from etsplat.core.spelling import option
from etsplat.core.workers import together, workers
from etsplat.data.dataset import Dataset
from etsplat.data.stray_points import without_strays
from etsplat.engines.choice import engine, engine_for
from etsplat.engines.threads import one_torch_thread
from etsplat.io.mesh_files import MeshFile
from etsplat.io.opaque_files import save_opaque
from etsplat.io.run_directory import RunDirectory
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import FOCAL_NOTE, GEOREFERENCE_NOTE, TriangleSoup
from etsplat.optim.exposure import Exposure
from etsplat.optim.loop import Callback, CheckpointEvent, DivergedError, Event, NoteEvent
from etsplat.optim.schedules import limited_iterations
from etsplat.tasks.block_training import check_blocks, shape_of, train_blocks
from etsplat.tasks.camera_results import conclude_cameras
from etsplat.tasks.dense_starts import DOUBTFUL, POOR, with_swept_points
from etsplat.tasks.depths import trusted_depths, wanted_depths, with_shown_points
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opaque import fit_opaque_mesh
from etsplat.tasks.opened_runs import SoupRun
from etsplat.tasks.pixel_limits import triangle_limit
from etsplat.tasks.refined_cameras import kept_aside
from etsplat.tasks.running import Job, Result, path_of, settings_for
from etsplat.tasks.scene_part import ScenePart, keep_colors
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.soup_trainer import background_of, start_trainer, surroundings_of_run
from etsplat.tasks.sources import load_scene, views_digest, with_cloud
from etsplat.tasks.train_checks import check_train, doubtful_scale
from etsplat.tasks.train_config import TrainConfig
from etsplat.tasks.train_memory import bytes_around

Onlooker = Callable[[Dataset, int, Callable[[], TriangleSoup]], None]
"""Called with the capture, in its own units; iterations done; and what gives a copy of the soup as it is now, in these
units, on the CPU, while the call lasts. It costs nothing but what the onlooker takes."""


@dataclass(frozen=True)
class TrainResult(Result):
    """What a run gives back; all of it is in the run directory too.

    Attributes:
        path: the run directory.
        soup: the triangles, in the units of the input.
        opaque: the opaque mesh beside it, likewise, with a colour at each vertex; None if none was asked for.
        metrics: as in metrics.json.

    Example:
        Of the example of `etsplat.train`:

        >>> result.soup.count == result.metrics["triangles"], result.opaque is None
        (True, True)
    """

    OPAQUE = TriangleSoup.OPAQUE

    soup: TriangleSoup
    opaque: MeshFile | None = None


@together()
@one_torch_thread()
@usual_defaults()
def train(
    source: str | Path | Dataset,
    out: str | Path,
    config: TrainConfig | None = None,
    *,
    images: str | None = None,
    masks: str | Path | None = None,
    depths: str | Path | None = None,
    depth_unit: float | None = None,
    init_points: str | Path | None = None,
    blocks: str | None = None,
    callbacks: Sequence[Callback] = (),
    onlooker: Onlooker | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> TrainResult:
    """Fits a triangle soup to the photos of a scene, and makes an opaque mesh beside it if that is asked for.

    A run ends with the same bits on the same machine and version of torch, on any number of threads, also if it was
    killed and resumed any number of times, or made by several workers of torchrun (docs/distributed.md), which all call
    this. Ctrl-C leaves a checkpoint of the last whole iteration.

    Args:
        source: a folder with posed photos (of the programs in `docs/captures.md`), a `Dataset` in its own units, or
            "demo:scene".
        out: the run directory; made if it does not exist. README.txt in it explains what is there.
        config: settings; None for preset "quick", outdoor. See `TrainConfig`.
        images: folder in the scene to take the photos from, such as "images_4".
        masks: folder with a mask for every photo, white where pixels count.
        depths: folder with depth maps of photos (16-bit PNG, NPY or EXR); None for the scene's own, if it has any. What
            becomes of them `loss.depth` says.
        depth_unit: units of the scene in a step of their numbers; None for what the scene says of them, or else 0.001
            for integers and 1 for others.
        init_points: a dense cloud (PLY or LAS) in the scene's units, to start from instead of its own points. What
            photos do not speak for is left out, and it is thinned to half of the triangles that there may be.
        blocks: cuts the scene into so many columns and rows of blocks, as "3x2", or "auto", and trains one after the
            other, for scenes larger than memory (docs/blocks.md). Settings are those of each block.
        callbacks: each is called with every event, in the thread of the caller. With none a notebook shows a line.
        onlooker: told of the soup before the first step and after steps, in the thread of the caller.
        resume: continue the run in `out`, which must have been started with the same source and settings.
        overwrite: replace a run in `out`. Nothing but files of a run is ever removed.

    Raises:
        InputError: something handed in cannot be used; earlier results in `out` are as they were.
        DivergedError: the optimization went to NaN or infinity.
        WorkerLostError: another worker ended.

    Example:
        >>> tiny = etsplat.TrainConfig.tiny().changed({"width": 32, "iterations": 10})
        >>> result = etsplat.train("demo:scene", "runs/scene", tiny)
        >>> result.metrics["triangles"] > 0
        True
    """
    config = settings_for(config, TrainConfig)
    if blocks is not None:
        check_blocks(blocks, config, watched=onlooker is not None)
    job = Job(config, out, callbacks, resume=resume, overwrite=overwrite)
    maps = wanted_depths(depths, depth_unit, config.loss.depth)
    memory = None if blocks is None else 0  # in blocks, photos are those of one block
    own = load_scene(
        source, config.width, images, masks, job.prepared, depths=maps, depth_unit=depth_unit, memory=memory
    )
    own = kept_aside(own, config.watch, config.refine_cameras)
    if init_points is None:
        own = without_strays(own, config.start.nearest)
    else:
        own, note = with_cloud(own, init_points, triangle_limit(own, config), job.prepared)
        job.announce(NoteEvent(note))
    folders = {"masks": path_of(masks), "depths": path_of(depths), "init_points": path_of(init_points)}
    paths = {"source": path_of(source), "images": images, **folders}
    if blocks is None:
        return _fit(job, own, paths, onlooker)
    if (shape := shape_of(blocks, own, config)) == (1, 1):  # its photos may stay in memory after all
        return _fit(job, own.of_views(range(len(own))), paths)

    def fit(each: Job[TrainConfig], capture: Dataset, part: ScenePart | None) -> tuple[TriangleSoup, dict[str, Any]]:
        done = _fit(each, capture, paths, part=part)
        return done.soup, done.metrics

    soup, metrics = train_blocks(job, own, shape, {**paths, "blocks": blocks}, fit)
    return TrainResult(job.run.path, metrics, soup)


def _fit(
    job: Job[TrainConfig],
    own: Dataset,
    paths: dict[str, str | None],
    onlooker: Onlooker | None = None,
    part: ScenePart | None = None,
) -> TrainResult:
    """A run over a capture in its own units, or over a part of one."""
    config = job.config
    frame = own.frame if part is None else part.frame
    capture = own.renormalized(frame.center, frame.radius) if config.normalize else own
    iterations = limited_iterations(config.iterations, config.schedule.max_epochs, len(own.train), config.batch)
    degree = config.drawing.sh_degree
    around = 0 if part is None else bytes_around(len(part.rest), degree, recolored=part.recolors)
    streams = part is not None and part.recolors  # the sky among all blocks
    for note in (*own.notes, *check_train(own, config, iterations, job.device, around, streams=streams)):
        job.announce(NoteEvent(note))
    hashes = {"fingerprint": own.fingerprint(), **({} if part is None else {"part": part.digest()})}
    job.identify(hashes, paths, iterations, views=views_digest(own))
    if part is not None and (metrics := job.measured()) is not None:  # a block that is done
        path = job.place.path
        return TrainResult(path, metrics, job.first(lambda: TriangleSoup.load(RunDirectory(path).soup_path)))
    job.config = config = replace(config, iterations=iterations)
    with engine(config.engine):
        scorer = Scorer(capture, job.device, background=background_of(config))
        loss, first = config.loss, config.at(config.loss.depth_from)
        trust = trusted_depths(capture, loss.depth if loss.lambda_depth else "off", first, job.announce)
        start = capture
        if part is None:
            most = triangle_limit(own, config)
            start = with_shown_points(capture, trust, most, job.announce)
            if start is capture and config.start.dense and config.finish == "none" and paths["init_points"] is None:
                start, consistent = with_swept_points(capture, most, job.device, job.announce, job.prepared)
                if consistent < POOR and config.refine_cameras == "off":
                    config = _of_poor_poses(job, consistent, len(own.train), shorten=trust is None)
        trainer = start_trainer(start, config, scorer.cheap, job.device, trust, part)
        if capture.exact_points is None and Surroundings.of(start).radius > Surroundings.of(capture).radius:
            # Cameras alone do not say that the sky is behind what was found, where the opaque mesh begins, too.
            capture = replace(capture, exact_points=start.exact_points, point_colors=start.point_colors)

        def look(iteration: int) -> None:
            if onlooker is not None and workers().leads:
                onlooker(own, iteration, lambda: _copy(_in_own_units(trainer.model, iteration, capture, config)))

        def keep(event: Event) -> None:
            if isinstance(event, CheckpointEvent):  # so that `etsplat view` can follow
                _in_own_units(trainer.model, event.iteration, capture, config).save(job.run.soup_path)

        # What only the first of several workers does goes through `job.first`.
        with job.writing(), engine_for(trainer.model.vertices).looping():
            if capture.georeference is not None:
                job.first(partial(capture.georeference.write, job.run.path))
            try:
                look(0)
                trainer.onlooker = look
                outcome = job.fit(trainer, keep)
            except DivergedError as error:
                if doubt := doubtful_scale(own, config):
                    raise DivergedError(f"{error}. But first: {doubt}") from error
                raise
            soup = outcome.model.finished()
            capture = conclude_cameras(job, trainer, capture, scorer)
            scores = job.first(lambda: scorer.full(soup, job.run.test))
            result = _in_own_units(soup, outcome.iteration, capture, config)
            job.first(lambda: result.save(job.run.soup_path))
            keep_colors(soup, job.run.path)
            opaque, about_opaque = None, {}
            if config.asset and (mesh := _opaque_mesh(job, soup, trainer.exposure, capture, config)) is not None:
                about_opaque = job.first(partial(scorer.asset, mesh, job.run.test))
                opaque = mesh.to_file(capture.normalization)
                job.first(partial(_write_opaque, SoupRun(job.run.path, result, own, opaque), job.run, opaque))
            found = {
                **scores,
                **about_opaque,
                "psnr_opaque_loss": None if scores["psnr"] is None else scores["psnr"] - scores["psnr_opaque"],
                **outcome.model.describe(),
                **outcome.metrics,
                **trainer.trial.metrics,
                **job.exposed(trainer.exposure, capture.names),
                **({} if trust is None else trust.metrics()),
                "width": capture.images.sizes[0][0],
                "height": capture.images.sizes[0][1],
                "train_views": len(capture.train),
                "scene_type": config.scene_type,
                "finish": config.finish,
            }
            return TrainResult(job.run.path, job.finish(trainer.progress, found, soup.vertices), result, opaque)


def _of_poor_poses(job: Job[TrainConfig], consistent: float, views: int, *, shorten: bool) -> TrainConfig:
    """The settings of a run whose photos contradict each other's depths: it says so, and may have fewer iterations."""
    config, most = job.config, job.config.schedule.doubtful_epochs
    told = (
        f"poses: of the places that a photo finds its neighbours find only {100 * consistent:.0f} %: cameras are"
        f" probably off by a pixel and more, or things moved. {option('refine_cameras', 'poses')} mends small errors,"
        " etsplat data sfm finds cameras anew; of right poses photos are too far apart, or too plain, to tell depths"
    )
    iterations = limited_iterations(config.iterations, most, views, config.batch)
    if shorten and consistent < DOUBTFUL and iterations < config.iterations:
        told += f"; {iterations:,} iterations, not {config.iterations:,} (schedule.doubtful_epochs {most})"
        job.shorten(iterations)
    job.announce(NoteEvent(told))
    return job.config


def _opaque_mesh(
    job: Job, soup: TriangleSoup, exposure: Exposure, capture: Dataset, config: TrainConfig
) -> TriangleMesh | None:
    """The opaque mesh; without one the soup is still a result, and the run says why there is none."""
    try:
        mesh = fit_opaque_mesh(job, soup, exposure, capture, config)
    except DivergedError as error:
        job.announce(NoteEvent(f"no opaque mesh: {error}"))
        return None
    around = surroundings_of_run(capture, config)
    if around is not None and bool(around.outermost(mesh.vertices.detach()[mesh.faces].cpu()).all()):
        job.announce(NoteEvent("no opaque mesh: nothing but the sky is left"))  # as where poses are all wrong
        return None
    return mesh


def _write_opaque(done: SoupRun, run: RunDirectory, opaque: MeshFile) -> None:
    save_opaque(run.opaque_path, opaque)
    export_soup(done, run.path / "opaque.glb", ExportConfig())


def _copy(soup: TriangleSoup) -> TriangleSoup:
    """The same in tensors of its own, which training does not change."""
    return replace(soup, **{name: tensor.clone() for name, tensor in soup.state().items()})


def _in_own_units(soup: TriangleSoup, iteration: int, capture: Dataset, config: TrainConfig) -> TriangleSoup:
    """The soup as it is now, on the CPU."""
    soup, own = soup.finished().to(torch.device("cpu")), capture.normalization
    return TriangleSoup(
        **{name: soup.state()[name] for name in TriangleSoup.RATES if name != "vertices"},
        vertices=own.invert(soup.vertices.double()).float(),
        appearance=replace(soup.appearance, near_plane=soup.appearance.near_plane * own.radius),
        notes={
            "iteration": str(iteration),
            "method": config.method,
            "preset": config.preset,
            Surroundings.NOTE: _sky_note(capture, config),
            **({} if capture.georeference is None else {GEOREFERENCE_NOTE: capture.georeference.to_json()}),
            FOCAL_NOTE: f"{float(capture.Ks[capture.train, 0, 0].mean()):.9g}",
        },
    )


def _sky_note(capture: Dataset, config: TrainConfig) -> str:
    """For those who use the soup: where its sky is, in the capture's own units."""
    if (sky := surroundings_of_run(capture, config)) is None:
        return "none"
    own = capture.normalization
    return Surroundings(own.invert(sky.middle.double()), sky.radius * own.radius).note
