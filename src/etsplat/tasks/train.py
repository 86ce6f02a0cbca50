"""Novel-view synthesis (paper section 3.4): photos in, a run directory with a triangle soup out."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from etsplat.data.dataset import Dataset
from etsplat.data.shown_width import shown_width
from etsplat.engines.choice import engine, engine_for
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.soup_init import StartPoints, random_points, start_soup
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.densification import PruneRules
from etsplat.optim.exposure import Exposure
from etsplat.optim.loop import Callback, CheckpointEvent, DivergedError, Event, NoteEvent
from etsplat.optim.objective import Objective
from etsplat.optim.schedules import Schedule, Scheduled, exponential_decay, limited_iterations, ramp
from etsplat.optim.strategies import DensifyAndPrune
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.terms.soup import Spared
from etsplat.optim.trainer import Trainer
from etsplat.tasks.running import Job, Result, path_of, terms_of
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.sources import load_scene
from etsplat.tasks.train_checks import check_train, doubtful_scale, triangle_limit
from etsplat.tasks.train_config import TrainConfig

LARGE_SPAN = 300.0
"""Above this many units across, Triangle Splatting compares outdoor scenes by squares."""

SETTLED = 0.1
"""What is left, at the end of a run, of the learning rates that settle (`lr_settle`)."""

FINAL_FLOOR, OPAQUE_AT = 0.995, 0.2
FIRST_CEILING, FINAL_CEILING, SHARP_FROM, SHARP_AT = 1.0, 0.05, 0.3, 0.95
HIDDEN = 0.005
"""The opaque finish, as fractions of a run: opacities are squeezed above a floor that soon has its final height, so
that most of the run is spent on an opaque soup, while its edges still give wide gradients. Then sigma is cut at a
ceiling that falls. What is hidden meanwhile is removed (its blend weight stays below the last number), and others
multiply in its place. The thresholds of soft soups take too much away (research/ablations.md)."""


@dataclass(frozen=True)
class TrainResult(Result):
    """What a run gives back; all of it is in the run directory too.

    Attributes:
        path: the run directory.
        soup: the triangles, in the units of the input.
        metrics: as in metrics.json.
    """

    OPAQUE = TriangleSoup.OPAQUE

    soup: TriangleSoup


def train(
    source: str | Path | Dataset,
    out: str | Path,
    config: TrainConfig | None = None,
    *,
    images: str | None = None,
    masks: str | Path | None = None,
    callbacks: Sequence[Callback] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> TrainResult:
    """Fits a triangle soup to the photos of a scene.

    A run ends with the same bits on the same machine, torch and number of threads, also if it was killed and resumed
    any number of times. Ctrl-C leaves a checkpoint of the last whole iteration.

    Args:
        source: a folder with posed photos (COLMAP, nerfstudio, Blender), a `Dataset` in its own units, or "demo:scene".
        out: the run directory; made if it does not exist. README.txt in it explains what is there.
        config: settings; None for preset "quick", outdoor. See `TrainConfig`.
        images: folder in the scene to take the photos from, such as "images_4".
        masks: folder with a mask for every photo, white where pixels count.
        callbacks: each is called with every event, in the thread of the caller. With none a notebook shows a line.
        resume: continue the run in `out`, which must have been started with the same source and settings.
        overwrite: replace a run in `out`. Nothing but files of a run is ever removed.

    Raises:
        InputError: something handed in cannot be used; earlier results in `out` are as they were.
        DivergedError: the optimization went to NaN or infinity.
    """
    config = config or TrainConfig()
    job = Job(config, out, callbacks, resume=resume, overwrite=overwrite)
    own = load_scene(source, config.width, images, masks, job.prepared).watching(config.watch)
    capture = own.normalized() if config.normalize else own
    iterations = limited_iterations(config.iterations, config.schedule.max_epochs, len(own.train), config.batch)
    for note in check_train(own, config, iterations, job.device):
        job.announce(NoteEvent(note))
    paths = {"source": path_of(source), "images": images, "masks": path_of(masks)}
    job.identify({"fingerprint": own.fingerprint()}, paths, iterations)
    job.config = config = replace(config, iterations=iterations)
    with engine(config.engine):
        scorer = Scorer(capture, job.device, background=_background(config))
        trainer = start_trainer(capture, config, scorer.cheap, job.device)

        def keep(event: Event) -> None:
            if isinstance(event, CheckpointEvent):  # so that `etsplat view` can follow
                _in_own_units(trainer.model, event.iteration, capture, config).save(job.run.soup_path)

        with job.writing(), engine_for(trainer.model.vertices).looping():
            try:
                outcome = job.fit(trainer, keep)
            except DivergedError as error:
                if doubt := doubtful_scale(own, config):
                    raise DivergedError(f"{error}. But first: {doubt}") from error
                raise
            soup = outcome.model.finished()
            scores = scorer.full(soup, job.run.test)
            result = _in_own_units(soup, outcome.iteration, capture, config)
            result.save(job.run.soup_path)
            found = {
                **scores,
                "psnr_opaque_loss": None if scores["psnr"] is None else scores["psnr"] - scores["psnr_opaque"],
                **outcome.model.describe(),
                **outcome.metrics,
                **job.exposed(trainer.exposure, capture.names),
                "width": capture.images.sizes[0][0],
                "height": capture.images.sizes[0][1],
                "train_views": len(capture.train),
                "scene_type": config.scene_type,
                "finish": config.finish,
            }
            return TrainResult(job.run.path, job.finish(trainer.progress, found, soup.vertices), result)


def start_trainer(
    capture: Dataset,
    config: TrainConfig,
    evaluate: Callable[[TriangleSoup], dict[str, float]] | None = None,
    device: torch.device | None = None,
) -> Trainer[TriangleSoup]:
    """The start of a run: triangles at the capture's points, or at random ones.

    Args:
        capture: photos in the frame that is trained in.
        config: settings.
        evaluate: cheap metrics of a soup.
        device: where the soup lives; None for the CPU.
    """
    generator = torch.Generator().manual_seed(config.seed)
    points = _start_points(capture, config, generator)
    soup = start_soup(
        points,
        generator,
        scale=config.start.scale,
        opacity=config.start.opacity,
        sigma=config.start.sigma,
        sh_degree=config.drawing.sh_degree,
        centers=capture.centers[capture.train],
        limit=config.start.limit,
    )
    if config.sky == "sphere":
        soup = soup.joined(Surroundings.of(capture).soup(capture, config.drawing.sh_degree))
    squared = config.scene_type == "outdoor" and not config.normalize and points.span > LARGE_SPAN
    soup = soup.to(device or torch.device("cpu"))
    return make_trainer(soup, capture, config, evaluate, generator, squared=squared)


def make_trainer(
    soup: TriangleSoup,
    capture: Dataset,
    config: TrainConfig,
    evaluate: Callable[[TriangleSoup], dict[str, float]] | None = None,
    generator: torch.Generator | None = None,
    *,
    squared: bool = False,
) -> Trainer[TriangleSoup]:
    """The paper's way from a start to the scene that photos show: L_nvs, Adam, densification and pruning.

    Args:
        soup: the start; changed in place.
        capture: what it is fitted to.
        config: settings.
        evaluate: cheap metrics of a soup.
        generator: of every random choice; None for a new one with the seed of `config`.
        squared: photos are compared by squares.
    """
    closed = Surroundings.of(capture).to(soup.vertices.device) if config.sky == "sphere" else None
    spared = None if closed is None else closed.outermost
    return Trainer(
        soup,
        capture,
        _objective(config, spared, squared=squared),
        _strategy(config, triangle_limit(capture, config), spared),
        schedule=_schedule(config, _vertex_unit(soup, capture, config)),
        batch=config.batch,
        background=None if config.background == "random" else _background(config),
        exposure=Exposure.of(config.exposure, config.iterations, len(capture.train) / config.batch),
        evaluate=evaluate,
        seed=generator or config.seed,
    )


def _objective(config: TrainConfig, spared: Spared | None, *, squared: bool) -> Objective:
    """L_nvs. Where no view looks, nothing would hold what is spared against the pull to transparency."""

    def late(weight: float) -> Scheduled:
        return lambda iteration: weight if iteration > config.at(config.loss.regularize_from) else 0.0

    def early(weight: float) -> Scheduled:
        return lambda iteration: weight if iteration < config.at(config.densification.end) else 0.0

    terms = terms_of(
        config.loss,
        leaving=("dssim", "opacity") if config.finish == "opaque" else ("dssim",),
        scheduled={"size": early, "depth_normal": late, "distortion": late},
        arguments={"opacity": {"spared": spared}},
    )
    photometric = Photometric(config.loss.lambda_dssim, "l2" if squared else "l1")
    return Objective(photometric, terms, depth_of="centroid")


def _strategy(config: TrainConfig, most: int, spared: Spared | None) -> DensifyAndPrune:
    times = {name: config.at(getattr(config.densification, name)) for name in ("begin", "end", "every")}
    rules = {**vars(config.pruning), "screen_size": config.pruning.screen_size or math.inf}
    if config.finish == "opaque":
        rules["importance"] = min(config.pruning.importance, HIDDEN)
    return DensifyAndPrune(
        **{**vars(config.densification), **times},
        last=config.iterations,
        max_triangles=most,
        prune=PruneRules(**rules),
        spared=spared,
    )


def _vertex_unit(soup: TriangleSoup, capture: Dataset, config: TrainConfig) -> float:
    """What the rate of positions is a fraction of, in units of the frame."""
    if config.optimizer.lr_vertices_unit == "frame":
        return 1.0
    points = soup.vertices.detach().mean(dim=1).cpu() if capture.points is None else capture.points
    return shown_width(capture, points) or 1.0


def _schedule(config: TrainConfig, unit: float) -> Schedule:
    length, given = config.iterations, config.optimizer
    faster = 1.0 if given.lr_vertices_length is None else math.sqrt(given.lr_vertices_length / length)

    def vertices(iteration: int) -> float:
        return unit * given.lr_vertices * exponential_decay(iteration, length, given.lr_vertices_final) * faster

    def settling(rate: float) -> Scheduled:
        if given.lr_settle is None:
            return rate
        first = config.at(given.lr_settle)
        return lambda iteration: rate * SETTLED ** ramp(iteration, first, length)

    rates: dict[str, Scheduled] = {
        "vertices": vertices,
        "opacity_logits": settling(given.lr_opacities),
        "sigma_raw": settling(given.lr_sigma),
        "sh_dc": settling(given.lr_sh_dc),
        "sh_rest": settling(given.lr_sh_rest),
    }
    return Schedule(rates, appearance=partial(_appearance, config))


def _appearance(config: TrainConfig, iteration: int) -> SoupAppearance:
    """How the soup is drawn at an iteration: bands of the colours come one by one; the opaque finish."""
    plain = SoupAppearance(
        kernel=config.kernel,
        distance=config.distance,
        sh_degree=min(config.drawing.sh_degree, iteration // config.at(config.schedule.sh_every)),
        cull_small=config.drawing.cull_small,
        cull_large=math.inf if config.drawing.cull_large is None else config.drawing.cull_large,
        freeze_inradius=config.drawing.freeze_inradius and config.distance == "sdf",
        near_plane=config.drawing.near_plane,
        background=_background(config),
    )
    if config.finish == "none":
        return plain
    opaque = ramp(iteration, 0, round(OPAQUE_AT * config.iterations))
    sharp = ramp(iteration, round(SHARP_FROM * config.iterations), round(SHARP_AT * config.iterations))
    ceiling = FIRST_CEILING * (FINAL_CEILING / FIRST_CEILING) ** sharp
    return replace(plain, opacity_floor=FINAL_FLOOR * opaque, sigma_ceiling=ceiling)


def _start_points(capture: Dataset, config: TrainConfig, generator: torch.Generator) -> StartPoints:
    """The capture's points, or random ones in a cube that holds what the cameras look at."""
    positions, colors = capture.points, capture.point_colors
    if positions is None:
        points = random_points(config.start.points, capture.viewmats[capture.train], generator)
    else:
        grey = torch.full_like(positions, 0.5)
        points = StartPoints(positions, grey if colors is None else colors)
    return points.with_sky() if config.sky == "dome" else points


def _background(config: TrainConfig) -> tuple[float, float, float]:
    """Behind the pictures that are measured."""
    grey = 1.0 if config.background == "white" else 0.0
    return grey, grey, grey


def _in_own_units(soup: TriangleSoup, iteration: int, capture: Dataset, config: TrainConfig) -> TriangleSoup:
    """The soup as it is now, on the CPU."""
    soup, own = soup.finished().to(torch.device("cpu")), capture.normalization
    return replace(
        soup,
        vertices=own.invert(soup.vertices.double()).float(),
        appearance=replace(soup.appearance, near_plane=soup.appearance.near_plane * own.radius),
        notes={"iteration": str(iteration), "method": config.method, "preset": config.preset},
    )
