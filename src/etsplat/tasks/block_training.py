"""A scene in blocks: a coarse soup of the whole, then a run for each block among that, then all of them as one.

Only one run is in memory at a time. The coarse soup is made of photos at half their size, of few triangles. A block
starts from its own points, and from the sky of the coarse soup that lies in its direction; the rest of the coarse soup
is drawn with it and does not learn. In the result each triangle is of the run of that block in which its middle lies.
"""

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from etsplat.core.errors import InputError
from etsplat.core.workers import workers
from etsplat.data.blocks import Grid, chosen_shape, cut, parse_blocks, parts_of
from etsplat.data.dataset import Dataset
from etsplat.io.memory import available_memory
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import FOCAL_NOTE, TriangleSoup
from etsplat.optim.loop import Event, NoteEvent, Progress, StageEvent, StepEvent
from etsplat.optim.schedules import limited_iterations
from etsplat.tasks.running import Job
from etsplat.tasks.scene_part import ScenePart, in_frame
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.soup_trainer import background_of
from etsplat.tasks.sources import world_up
from etsplat.tasks.train_checks import triangle_limit
from etsplat.tasks.train_config import TrainConfig
from etsplat.tasks.train_memory import bytes_of_values, check_memory, in_words

FOLDER, COARSE = "blocks", "coarse"
"""In the run's folder: the runs of the blocks, and that of the coarse soup among them."""

COARSE_TRIANGLES, COARSE_STEPS = 0.5, 0.5
"""Of the coarse soup of the whole, as parts of those of a block."""

Fit = Callable[[Job[TrainConfig], Dataset, ScenePart | None], tuple[TriangleSoup, dict[str, Any]]]
"""An ordinary run of a capture, or of a part of one: its soup in the capture's own units, and its metrics."""


@dataclass(frozen=True)
class _Done:
    """A run that is done."""

    name: str
    photos: int
    soup: TriangleSoup
    metrics: dict[str, Any]


def check_blocks(blocks: str, config: TrainConfig, *, watched: bool) -> None:
    """Refuses, before anything is read, what cannot be done in blocks.

    Raises:
        InputError: `blocks` is no shape; something else that is asked for belongs to a run of a whole scene.
    """
    parse_blocks(blocks)
    if config.refine_cameras != "off":
        raise InputError("refine_cameras: cannot be done in blocks; refine the cameras in a run without --blocks")
    if workers().count > 1:
        raise InputError("blocks: several workers cannot do that yet; start one process, without torchrun")
    if watched:
        raise InputError("view: cannot be done in blocks; etsplat view shows what is there of the run meanwhile")


def shape_of(blocks: str, capture: Dataset, config: TrainConfig) -> tuple[int, int]:
    """Columns and rows; (1, 1) where "auto" finds that one is enough.

    Raises:
        InputError: the capture has no points.
    """
    up = world_up(capture.viewmats)
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
    grid = cut(own, shape, world_up(own.viewmats))
    parts = parts_of(own, grid)
    coarse, each = _settings(own, config, len(grid))
    for note in (*own.notes, *_check(parts, coarse, each, job.device, asset=config.asset)):
        job.announce(NoteEvent(note))
    steps = sum(_steps(views, settings) for views, settings in [(own, coarse), *((part, each) for part in parts)])
    job.identify({"fingerprint": own.fingerprint(), "blocks": "x".join(map(str, shape))}, paths, steps)
    with job.writing():
        runs = [_run(job, COARSE, coarse, _thinned(own, coarse.max_triangles).halved(), None, fit)]
        whole = runs[0].soup
        notes = {**whole.notes, FOCAL_NOTE: f"{float(own.Ks[own.train, 0, 0].mean()):.9g}"}
        whole.save(job.run.soup_path)  # so that `etsplat view` has something to follow
        exposure = _exposures(job.run.path / FOLDER / COARSE)
        soups: dict[int, TriangleSoup] = {}
        for block, capture in enumerate(parts):
            job.announce(NoteEvent(f"block {grid.name(block)}, {block + 1} of {len(grid)}: {_about(capture)}"))
            part = _part(own, grid, block, whole, exposure)
            done = _run(job, grid.name(block), each, capture, part, fit)
            runs.append(replace(done, soup=done.soup.kept(_owners(own, grid, done.soup) == block)))
            soups[block] = runs[-1].soup
            merged(own, grid, whole, soups, notes).save(job.run.soup_path)
        soup = merged(own, grid, whole, soups, notes)
        return soup, _conclude(job, own, soup, runs, config)


def merged(
    own: Dataset, grid: Grid, whole: TriangleSoup, soups: dict[int, TriangleSoup], notes: dict[str, str]
) -> TriangleSoup:
    """The blocks that are done, each with what lies in its cell, and the coarse soup in the place of the others.

    Args:
        own: the capture.
        grid: its cut.
        whole: the coarse soup.
        soups: by block; of these, all is taken.
        notes: of the result.
    """
    missing = torch.tensor([block not in soups for block in range(len(grid))])
    kept = [whole.kept(missing[_owners(own, grid, whole)]), *(soups[block] for block in sorted(soups))]
    together = {name: torch.cat([soup.state()[name] for soup in kept]) for name in whole.state()}
    return TriangleSoup(**together, appearance=whole.appearance, notes=notes)


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
    done = _Done(name, len(capture.train), *fit(own, capture, part))
    gc.collect()  # a trainer and what looks at it hold each other; the next run needs the room
    return done


def _settings(own: Dataset, config: TrainConfig, blocks: int) -> tuple[TrainConfig, TrainConfig]:
    """Of the coarse run and of each block's. Pixels limit triangles as they do in a run of the whole."""
    by_pixels = triangle_limit(own, replace(config, max_triangles=10**8))
    most = min(config.max_triangles, -(-by_pixels // blocks))
    each = replace(config, max_triangles=most, pixels_per_triangle=None, asset=False, watch=config.watch)
    steps = max(1, round(COARSE_STEPS * config.iterations))
    few = max(1, round(COARSE_TRIANGLES * most))
    return replace(each, iterations=steps, max_triangles=few), each


def _check(
    parts: Sequence[Dataset], coarse: TrainConfig, each: TrainConfig, device: torch.device, *, asset: bool
) -> list[str]:
    """What the owner of the runs should know. Raises InputError where there is too little memory for one of them."""
    needed = [check_memory(part, each, each.max_triangles, device, coarse.max_triangles) for part in parts]
    most = max(needed, key=lambda memory: memory.total)
    result = 2 * len(parts) * each.max_triangles * bytes_of_values(each.drawing.sh_degree)
    if result > (free := available_memory()):
        raise InputError(
            f"max_triangles: all blocks may have {len(parts) * each.max_triangles:,} triangles, which need "
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


def _part(own: Dataset, grid: Grid, block: int, whole: TriangleSoup, exposure: dict[str, torch.Tensor]) -> ScenePart:
    middles = own.normalization.apply(whole.vertices.detach().double().mean(dim=1))
    near = grid.around(block, middles)
    closed = Surroundings.of_note(whole.notes.get(Surroundings.NOTE, ""))
    on_sky = torch.zeros_like(near) if closed is None else closed.outermost(whole.vertices.detach())
    sky = whole.kept(near & on_sky) if bool((near & on_sky).any()) else None
    return ScenePart(own.frame, whole.kept(~near), sky, closed, exposure)


def _exposures(folder: Path) -> dict[str, torch.Tensor]:
    found = RunDirectory(folder).read_exposure().get("matrices", {})
    return {name: torch.tensor(matrix) for name, matrix in found.items()}


def _conclude(
    job: Job[TrainConfig], own: Dataset, soup: TriangleSoup, runs: Sequence[_Done], config: TrainConfig
) -> dict[str, Any]:
    """Measures and writes what all runs made together."""
    if exposure := RunDirectory(job.run.path / FOLDER / COARSE).read_exposure():
        job.run.write_exposure(exposure)
    if own.georeference is not None:
        own.georeference.write(job.run.path)
    scorer = Scorer(own, job.device, background=background_of(config))
    scores = scorer.full(in_frame(soup, own.normalization).to(job.device), job.run.test)
    done = Progress(sum(run.metrics["iterations"] for run in runs), sum(run.metrics["seconds"] for run in runs))
    job.run.truncate_history(0)  # of the same run, resumed when it was done
    job.run.append_history(
        {"iteration": done.iteration, "seconds": done.seconds, **soup.describe(), "psnr": scores["psnr"]}
    )
    found = {
        **scores,
        "psnr_opaque_loss": None if scores["psnr"] is None else scores["psnr"] - scores["psnr_opaque"],
        **soup.describe(),
        "blocks": [
            {
                "name": run.name,
                "photos": run.photos,
                "triangles": len(run.soup),
                **{key: run.metrics[key] for key in ("iterations", "seconds", "psnr")},
            }
            for run in runs
        ],
        "exposure_learned": bool(exposure),
        "width": own.images.sizes[0][0],
        "height": own.images.sizes[0][1],
        "train_views": len(own.train),
        "scene_type": config.scene_type,
        "finish": config.finish,
    }
    return job.finish(done, found, soup.vertices)
