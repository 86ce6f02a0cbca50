"""A scene in blocks: a coarse soup of the whole, a run for each block among that, then one for the sky among these.

Only one run is in memory at a time. The coarse soup is made of photos at half their size, of few triangles. A block
starts from its own points; the coarse soup around it, and all of its sky, is drawn with it and does not learn. In the
result each triangle is of the run of that block in which its middle lies. The sky is what photos of all blocks share:
it learns last, from all photos, among what the blocks have become, whose plain colours learn with it: so what is on
either side of a border agrees, and with the sky.
"""

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.core.workers import workers
from etsplat.data.blocks import Grid, chosen_shape, cut, parse_blocks, parts_of
from etsplat.data.dataset import Dataset
from etsplat.data.where_up import up_of
from etsplat.io.memory import available_memory
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import FOCAL_NOTE, TriangleSoup
from etsplat.optim.loop import DivergedError, Event, NoteEvent, Progress, StageEvent, StepEvent
from etsplat.optim.schedules import limited_iterations
from etsplat.tasks.pixel_limits import triangle_limit
from etsplat.tasks.running import Job
from etsplat.tasks.scene_part import ScenePart, in_frame, recolored
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.soup_trainer import background_of
from etsplat.tasks.sources import views_digest
from etsplat.tasks.train_config import TrainConfig
from etsplat.tasks.train_memory import bytes_around, bytes_of_values, check_memory, in_words, memory_of

FOLDER, COARSE, SKY = "blocks", "coarse", "sky"
"""In the run's folder: the runs of the blocks, and those of the coarse soup and of the sky among them."""

COARSE_TRIANGLES, COARSE_STEPS = 0.5, 0.5
"""Of the coarse soup of the whole, as parts of those of a block. The sky at the end has as few triangles, and as many
steps as a block."""

SKY_RATE = 10.0
"""So much faster the corners of the sky move when it learns alone: a photo shows little of it, so that each of its few,
large triangles learns in few steps (measured: research/results.md, "Blocks")."""

Fit = Callable[[Job[TrainConfig], Dataset, ScenePart | None], tuple[TriangleSoup, dict[str, Any]]]
"""An ordinary run of a capture, or of a part of one: its soup in the capture's own units, and its metrics."""


@dataclass(frozen=True)
class _Done:
    """A run that is done.

    Attributes:
        soup: what it made.
        about: it in metrics.json, but for how much of the soup is in the result.
    """

    soup: TriangleSoup
    about: dict[str, Any]

    def giving(self, soup: TriangleSoup) -> dict[str, Any]:
        """For metrics.json, with what of it is in the result."""
        return {**self.about, "triangles": len(soup)}


@dataclass(frozen=True)
class _Whole:
    """What the coarse run says of the whole.

    Attributes:
        soup: its triangles.
        closed: the sphere that the sky is on; None without a sky.
        exposure: by names of photos.
    """

    soup: TriangleSoup
    closed: Surroundings | None
    exposure: dict[str, torch.Tensor]

    def on_sky(self, soup: TriangleSoup) -> torch.Tensor:
        """(N,) which triangles of a soup are of the sky."""
        nothing = torch.zeros(len(soup), dtype=torch.bool)
        return nothing if self.closed is None else self.closed.outermost(soup.vertices.detach())


def check_blocks(blocks: str, config: TrainConfig, *, watched: bool) -> None:
    """Refuses, before anything is read, what cannot be done in blocks.

    Raises:
        InputError: `blocks` is no shape; something else that is asked for belongs to a run of a whole scene.
    """
    parse_blocks(blocks)
    if config.refine_cameras != "off":
        whole = f"a run without {option('blocks')}"
        raise InputError(f"refine_cameras: cannot be done in blocks; refine the cameras in {whole}")
    if workers().count > 1:
        raise InputError("blocks: several workers cannot do that yet; start one process, without torchrun")
    if watched:
        raise InputError("view: cannot be done in blocks; etsplat view shows what is there of the run meanwhile")


def shape_of(blocks: str, capture: Dataset, config: TrainConfig) -> tuple[int, int]:
    """Columns and rows; (1, 1) where "auto" finds that one is enough.

    Raises:
        InputError: the capture has no points.
    """
    up = up_of(capture)
    return parse_blocks(blocks) or chosen_shape(capture, up, config.max_triangles)


def train_blocks(
    job: Job[TrainConfig], own: Dataset, shape: tuple[int, int], paths: dict[str, str | None], fit: Fit
) -> tuple[TriangleSoup, dict[str, Any]]:
    """All runs, one after the other, and what they make together, in the job's folder. Those that are done stay.

    Args:
        job: of the whole.
        own: its capture, in its own units; its photos are not kept.
        shape: columns and rows.
        paths: where inputs were read from, for the record.
        fit: makes a run.

    Returns:
        The soup, in the capture's own units, and its metrics.

    Raises:
        InputError: there are too many blocks for the scene, or too many triangles for the memory; as `Job`.
    """
    config = job.config
    grid = cut(own, shape, up_of(own))
    parts = parts_of(own, grid)
    coarse, each = _settings(own, config, len(grid))
    thin = _thinned(own, coarse.max_triangles)
    for note in (*own.notes, *_check(thin, parts, coarse, each, job.device, asset=config.asset)):
        job.announce(NoteEvent(note))
    last = [] if config.sky == "none" else [(own, _of_sky(each, coarse))]
    all_runs = [(own, coarse), *((part, each) for part in parts), *last]
    steps = sum(_steps(views, settings) for views, settings in all_runs)
    hashes = {"fingerprint": own.fingerprint(), "blocks": "x".join(map(str, shape))}
    job.identify(hashes, paths, steps, views=views_digest(own))
    with job.writing():
        done = _run(job, COARSE, coarse, thin.halved(), None, fit)
        runs, whole = [done.giving(done.soup)], _whole(own, done.soup, job.run.path / FOLDER / COARSE)
        soup = whole.soup
        soup.save(job.run.soup_path)  # so that `etsplat view` has something to follow
        for block, capture in enumerate(parts):
            job.announce(NoteEvent(f"block {grid.name(block)}, {block + 1} of {len(grid)}: {_about(capture)}"))
            done = _run(job, grid.name(block), each, capture, _part(own, grid, block, whole), fit)
            its_own = done.soup.kept((_owners(own, grid, done.soup) == block) & ~whole.on_sky(done.soup))
            runs.append(done.giving(its_own))
            soup = _joined([soup.kept((_owners(own, grid, soup) != block) | whole.on_sky(soup)), its_own], whole)
            soup.save(job.run.soup_path)
            del done, its_own  # the next run needs the room
        on_sky = whole.on_sky(soup)
        ground, sky = soup.kept(~on_sky), soup.kept(on_sky)
        del soup
        if len(sky) > 0:
            ground, sky, about = _learned_sky(job, _of_sky(each, coarse), thin, whole, ground, sky, fit)
            runs += about
        soup = _joined([ground, sky], whole)
        soup.save(job.run.soup_path)
        return soup, _conclude(job, own, soup, runs, config)


def _joined(soups: Sequence[TriangleSoup], whole: _Whole) -> TriangleSoup:
    together = {name: torch.cat([soup.state()[name] for soup in soups]) for name in whole.soup.state()}
    return replace(whole.soup, **together)


def _learned_sky(
    job: Job[TrainConfig],
    config: TrainConfig,
    own: Dataset,
    whole: _Whole,
    ground: TriangleSoup,
    sky: TriangleSoup,
    fit: Fit,
) -> tuple[TriangleSoup, TriangleSoup, list[dict[str, Any]]]:
    """The ground in new colours, and the sky, by all photos; and that run for metrics.json.

    Args:
        job: of the whole.
        config: settings of the run.
        own: the capture.
        whole: the coarse soup.
        ground: what all blocks have become.
        sky: of the coarse run; some.
        fit: makes a run.
    """
    part = ScenePart(own.frame, ground, sky, whole.closed, whole.exposure, recolors=True)
    middles = own.normalization.apply(sky.vertices.double().mean(dim=1))
    capture = replace(own, exact_points=middles, point_colors=sky.display_colors())
    job.announce(NoteEvent(f"the sky, among all blocks: {_about(capture)}"))
    try:
        done = _run(job, SKY, config, capture, part, fit)
    except DivergedError as error:  # all of it is hidden, say; what the blocks have become is a result without it
        job.announce(NoteEvent(f"the sky stays as the coarse run left it: {error}"))
        return ground, sky, []
    return recolored(ground, job.run.path / FOLDER / SKY), done.soup, [done.giving(done.soup)]


def _run(
    job: Job[TrainConfig], name: str, config: TrainConfig, capture: Dataset, part: ScenePart | None, fit: Fit
) -> _Done:
    """A run in a folder of its own, which goes on where it was."""
    folder = job.run.path / FOLDER / name

    def tell(event: Event) -> None:
        if isinstance(event, StepEvent):
            job.announce(StageEvent(f"Optimizing {name}", event.iteration, event.iterations))
        elif isinstance(event, NoteEvent):
            job.announce(NoteEvent(f"{name}: {event.text}"))

    own = Job(config, folder, [tell], resume=is_run(folder), overwrite=False)
    soup, metrics = fit(own, capture, part)
    gc.collect()  # a trainer and what looks at it hold each other; the next run needs the room
    told = {key: metrics[key] for key in ("iterations", "seconds", "psnr")}
    return _Done(soup, {"name": name, "photos": len(capture.train), **told})


def _settings(own: Dataset, config: TrainConfig, blocks: int) -> tuple[TrainConfig, TrainConfig]:
    """Of the coarse run and of each block's. Pixels limit triangles as they do in a run of the whole."""
    by_pixels = triangle_limit(own, replace(config, max_triangles=10**8))
    most = min(config.max_triangles, -(-by_pixels // blocks))
    each = replace(config, max_triangles=most, pixels_per_triangle=None, asset=False, watch=config.watch)
    steps = max(1, round(COARSE_STEPS * config.iterations))
    few = max(1, round(COARSE_TRIANGLES * most))
    return replace(each, iterations=steps, max_triangles=few), each


def _of_sky(each: TrainConfig, coarse: TrainConfig) -> TrainConfig:
    """Settings of the last run. Depth maps say nothing of the sky."""
    loss = each.loss if each.loss.depth == "off" else replace(each.loss, lambda_depth=0.0)
    faster = replace(each.optimizer, lr_vertices=SKY_RATE * each.optimizer.lr_vertices)
    return replace(each, max_triangles=coarse.max_triangles, loss=loss, optimizer=faster)


def _check(
    thin: Dataset,
    parts: Sequence[Dataset],
    coarse: TrainConfig,
    each: TrainConfig,
    device: torch.device,
    *,
    asset: bool,
) -> list[str]:
    """What the owner of the runs should know. Raises InputError where there is too little memory for one of them."""
    degree = each.drawing.sh_degree
    beside = bytes_around(coarse.max_triangles, degree)
    needed = [check_memory(part, each, each.max_triangles, device, beside) for part in parts]
    most, all_blocks = max(needed, key=lambda memory: memory.total), len(parts) * each.max_triangles
    result = 2 * all_blocks * bytes_of_values(degree)
    if coarse.sky != "none":
        last = _of_sky(each, coarse)
        ground = bytes_around(all_blocks, degree, recolored=True)
        sky = memory_of(thin, last, last.max_triangles, device, ground)
        result = max(result, sky.total - sky.kept)  # its photos are streamed, or there already
    if result > (free := available_memory()):
        raise InputError(
            f"max_triangles: all blocks may have {all_blocks:,} triangles, which need "
            f"{in_words(result)} at the end, and {in_words(free)} are free; set it to less"
        )
    photos = [len(part.train) for part in parts]
    return [
        f"{len(parts)} blocks of {min(photos)} to {max(photos)} training photos; the largest: {most}",
        f"at the end, all blocks: at most {in_words(result)}",
        *(["no opaque mesh is made of blocks; etsplat export makes one of the soup"] if asset else []),
    ]


def _steps(capture: Dataset, config: TrainConfig) -> int:
    return limited_iterations(config.iterations, config.schedule.max_epochs, len(capture.train), config.batch)


def _about(capture: Dataset) -> str:
    points = 0 if capture.exact_points is None else len(capture.exact_points)
    return f"{len(capture.train)} photos to train on, {len(capture.test)} to test, {points:,} points"


def _thinned(own: Dataset, triangles: int) -> Dataset:
    """With no more points than half of the triangles, evenly chosen."""
    points, colors = own.exact_points, own.point_colors
    assert points is not None
    every = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    kept = every[: max(1, triangles // 2)].sort().values
    return replace(own, exact_points=points[kept], point_colors=None if colors is None else colors[kept], notes=())


def _owners(own: Dataset, grid: Grid, soup: TriangleSoup) -> torch.Tensor:
    """(N,) in which block the middle of each triangle lies."""
    return grid.block_of(own.normalization.apply(soup.vertices.detach().double().mean(dim=1)))


def _whole(own: Dataset, soup: TriangleSoup, folder: Path) -> _Whole:
    """What the coarse run in a folder says of a capture."""
    notes = {**soup.notes, FOCAL_NOTE: f"{float(own.Ks[own.train, 0, 0].mean()):.9g}"}  # its photos were smaller
    found = RunDirectory(folder).read_exposure().get("matrices", {})
    exposure = {name: torch.tensor(matrix) for name, matrix in found.items()}
    closed = Surroundings.of_note(soup.notes.get(Surroundings.NOTE, ""))
    return _Whole(replace(soup, notes=notes), closed, exposure)


def _part(own: Dataset, grid: Grid, block: int, whole: _Whole) -> ScenePart:
    middles = own.normalization.apply(whole.soup.vertices.detach().double().mean(dim=1))
    rest = ~grid.around(block, middles) | whole.on_sky(whole.soup)
    return ScenePart(own.frame, whole.soup.kept(rest), None, whole.closed, whole.exposure)


def _conclude(
    job: Job[TrainConfig], own: Dataset, soup: TriangleSoup, runs: list[dict[str, Any]], config: TrainConfig
) -> dict[str, Any]:
    """Measures and writes what all runs made together."""
    if exposure := RunDirectory(job.run.path / FOLDER / COARSE).read_exposure():
        job.run.write_exposure(exposure)
    if own.georeference is not None:
        own.georeference.write(job.run.path)
    scorer = Scorer(own, job.device, background=background_of(config))
    scores = scorer.full(in_frame(soup, own.normalization).to(job.device), job.run.test)
    done = Progress(sum(run["iterations"] for run in runs), sum(run["seconds"] for run in runs))
    job.run.truncate_history(0)  # of the same run, resumed when it was done
    job.run.append_history(
        {"iteration": done.iteration, "seconds": done.seconds, **soup.describe(), "psnr": scores["psnr"]}
    )
    found = {
        **scores,
        "psnr_opaque_loss": None if scores["psnr"] is None else scores["psnr"] - scores["psnr_opaque"],
        **soup.describe(),
        "blocks": runs,
        "exposure_learned": bool(exposure),
        "width": own.images.sizes[0][0],
        "height": own.images.sizes[0][1],
        "train_views": len(own.train),
        "scene_type": config.scene_type,
        "finish": config.finish,
    }
    return job.finish(done, found, soup.vertices)
