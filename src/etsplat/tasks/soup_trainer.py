"""What fits a soup to photos, as settings say: the start, L_nvs, Adam's rates, densification and pruning."""

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.soup_numbers import DRAWS
from etsplat.data.dataset import Dataset, Normalization
from etsplat.data.shown_width import shown_width
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.soup_init import StartPoints, random_points, start_soup
from etsplat.model.surrounded_soup import SurroundedSoup
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.camera_refinement import CameraRefinement
from etsplat.optim.densification import PruneRules
from etsplat.optim.depth_trust import DepthTrust
from etsplat.optim.exposure import Exposure
from etsplat.optim.hidden_sky import HiddenSky
from etsplat.optim.objective import Objective
from etsplat.optim.schedules import Schedule, Scheduled, exponential_decay, ramp
from etsplat.optim.strategies import DensifyAndPrune
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.terms.soup import Spared
from etsplat.optim.trainer import Trainer
from etsplat.tasks.pixel_limits import random_count, triangle_limit
from etsplat.tasks.running import terms_of
from etsplat.tasks.scene_part import ScenePart, in_frame, sphere_in_frame
from etsplat.tasks.train_config import TrainConfig

LARGE_SPAN = 300.0
"""Above this many units across, Triangle Splatting compares outdoor scenes by squares."""

SETTLED = 0.1
"""What is left, at the end of a run, of the learning rates that settle (`lr_settle`)."""

LEAST_EVERY = 30
"""Steps between edits of a short run, or a tenth of it if that is less: in fewer, triangles that are of use are still
as faint as those that are not, and all would die (research/ablations.md)."""

SLOWEST, FASTEST = 0.2, 5.0
"""Times its rate that the vertices of a triangle move at least, and at most, by its size (`lr_vertices_by_size`)."""

MOST_DROPPED = 0.1
"""The largest share of dropout."""

DEPTH_UNTIL = 0.5
"""Up to this part of a run depth maps count; then photos alone, so that what is wrong with maps costs no picture."""

FINAL_FLOOR, OPAQUE_AT = 0.995, 0.2
FIRST_CEILING, FINAL_CEILING, SHARP_FROM, SHARP_AT = 1.0, 0.05, 0.3, 0.95
HIDDEN = 0.005
"""The opaque finish, as fractions of a run: opacities are squeezed above a floor that soon has its final height, so
that most of the run is spent on an opaque soup, while its edges still give wide gradients. Then sigma is cut at a
ceiling that falls. What is hidden meanwhile is removed (its blend weight stays below the last number), and others
multiply in its place. The thresholds of soft soups take too much away (research/ablations.md)."""


def start_trainer(
    capture: Dataset,
    config: TrainConfig,
    evaluate: Callable[[TriangleSoup], dict[str, float]] | None = None,
    device: torch.device | None = None,
    depths: DepthTrust | None = None,
    part: ScenePart | None = None,
) -> Trainer[TriangleSoup]:
    """The start of a run: triangles at the capture's points, or at random ones, or those of a part.

    Args:
        capture: photos in the frame that is trained in.
        config: settings.
        evaluate: cheap metrics of a soup.
        device: where the soup lives; None for the CPU.
        depths: which depth maps are believed; None where none are used.
        part: of a capture that is a part of a scene, what it has from the whole.
    """
    generator, frame = torch.Generator().manual_seed(config.seed), capture.normalization
    points = _start_points(capture, config, generator, whole=part is None)
    soup = _placed(points, capture, config, generator) if part is None or part.start is None else _start_of(part, frame)
    if part is not None:
        soup = SurroundedSoup.among(soup, in_frame(part.rest, frame), recolored=part.recolors)
    elif config.sky == "sphere":
        soup = soup.joined(Surroundings.of(capture).soup(capture, config.drawing.sh_degree))
    squared = config.scene_type == "outdoor" and not config.normalize and points.span > LARGE_SPAN
    soup = soup.to(device or torch.device("cpu"))
    return make_trainer(soup, capture, config, evaluate, generator, depths, part, squared=squared)


def make_trainer(
    soup: TriangleSoup,
    capture: Dataset,
    config: TrainConfig,
    evaluate: Callable[[TriangleSoup], dict[str, float]] | None = None,
    generator: torch.Generator | None = None,
    depths: DepthTrust | None = None,
    part: ScenePart | None = None,
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
        depths: which depth maps are believed; None where none are used.
        part: as of `start_trainer`.
        squared: photos are compared by squares.
    """
    closed = Surroundings.of(capture) if config.sky == "sphere" and part is None else None
    if part is not None and part.closed is not None:
        closed = sphere_in_frame(part.closed, capture.normalization)
    spared = None if closed is None else closed.to(soup.vertices.device).outermost
    by_direction, epoch = config.drawing.sh_degree > 0, len(capture.train) / config.batch
    exposure = Exposure.of(config.exposure, config.iterations, epoch, by_direction=by_direction)
    return Trainer(
        soup,
        capture,
        _objective(config, len(capture.train), spared, depths, squared=squared),
        _strategy(config, capture, spared),
        schedule=_schedule(config, vertex_unit(soup, capture, config), len(capture.train), soup.parameters()),
        batch=config.batch,
        background=None if config.background == "random" else background_of(config),
        exposure=exposure if part is None else part.exposures(capture),
        depths=depths,
        cameras=CameraRefinement.of(config.refine_cameras, config.iterations, epoch),
        paces=vertex_paces(config),
        evaluate=evaluate,
        seed=generator or config.seed,
    )


def _objective(
    config: TrainConfig, photos: int, spared: Spared | None, depths: DepthTrust | None, *, squared: bool
) -> Objective:
    """L_nvs. Where no view looks, nothing would hold what is spared against the pull to transparency."""

    def late(weight: float) -> Scheduled:
        return lambda iteration: weight if iteration > config.at(config.loss.regularize_from) else 0.0

    def early(weight: float) -> Scheduled:
        return lambda iteration: weight if iteration < config.at(config.densification.end) else 0.0

    def shaping(weight: float) -> Scheduled:
        return lambda iteration: weight if iteration <= DEPTH_UNTIL * config.iterations else 0.0

    terms = terms_of(
        config.loss,
        leaving=[
            "dssim",
            *(["opacity"] if config.finish == "opaque" else []),
            *(["harmonics"] if config.drawing.sh_degree == 0 else []),
            *(["depth"] if depths is None else []),
        ],
        scheduled={
            "harmonics": lambda weight: weight / photos,
            "size": early,
            "depth_normal": late,
            "distortion": late,
            "depth": shaping,
        },
        arguments={"opacity": {"spared": spared}, "depth": {"trust": depths}},
    )
    photometric = Photometric(config.loss.lambda_dssim, "l2" if squared else "l1")
    return Objective(photometric, terms, depth_of="centroid" if depths is None else "plane")


def _strategy(config: TrainConfig, capture: Dataset, spared: Spared | None) -> DensifyAndPrune:
    times = {name: config.at(getattr(config.densification, name)) for name in ("begin", "end", "every")}
    least = min(LEAST_EVERY, config.iterations // 10)
    times |= {"begin": max(times["begin"], 2 * least), "every": max(times["every"], least)}
    rules = {**vars(config.pruning), "screen_size": config.pruning.screen_size or math.inf}
    if config.finish == "opaque":
        rules["importance"] = min(config.pruning.importance, HIDDEN)
    return DensifyAndPrune(
        **{**vars(config.densification), **times},
        last=config.iterations,
        max_triangles=triangle_limit(capture, config),
        prune=PruneRules(**rules),
        spared=spared,
        barren=None if spared is None else HiddenSky(capture, spared),
    )


def vertex_unit(soup: TriangleSoup, capture: Dataset, config: TrainConfig) -> float:
    """What the rate of positions is a fraction of, in units of the frame."""
    return 1.0 if config.optimizer.lr_vertices_unit == "frame" else shown_across(soup, capture)


def surroundings_of_run(capture: Dataset, config: TrainConfig) -> Surroundings | None:
    """Where the sky of a run is, in units of the scene; None where there is none, or nobody can tell."""
    if config.sky == "sphere":
        return Surroundings.of(capture)
    if config.sky == "dome" and capture.points is not None:  # of random points some are beyond it
        return Surroundings.dome(capture.points)
    return None


def shown_across(soup: TriangleSoup, capture: Dataset) -> float:
    """What photos show across at the capture's points, or at the triangles, in units of the frame."""
    points = soup.vertices.detach().mean(dim=1).cpu() if capture.points is None else capture.points
    return shown_width(capture, points) or 1.0


def _schedule(config: TrainConfig, unit: float, photos: int, parameters: Collection[str]) -> Schedule:
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
        "rest_dc": settling(given.lr_sh_dc),
    }
    rates = {name: rates[name] for name in parameters}
    return Schedule(rates, appearance=partial(_appearance, config, photos))


def vertex_paces(config: TrainConfig) -> dict[str, Callable[[Tensor], Tensor]]:
    """How much faster than at their rate vertices move: by the extent of their triangle, relative to the median."""
    power = config.optimizer.lr_vertices_by_size

    def paces(vertices: Float[Tensor, "N 3 3"]) -> Float[Tensor, " N"]:
        extents = (vertices.amax(dim=1) - vertices.amin(dim=1)).norm(dim=1)
        relative = (extents / extents.median()).nan_to_num(1.0)
        return (relative**power).clamp(SLOWEST, FASTEST)

    return {"vertices": paces} if power else {}


def _appearance(config: TrainConfig, photos: int, iteration: int) -> SoupAppearance:
    """How the soup is drawn at an iteration: bands of the colours come one by one; dropout, or the opaque finish."""
    plain = SoupAppearance(
        kernel=config.kernel,
        distance=config.distance,
        sh_degree=min(config.drawing.sh_degree, iteration // config.at(config.schedule.sh_every)),
        cull_small=config.drawing.cull_small,
        cull_large=math.inf if config.drawing.cull_large is None else config.drawing.cull_large,
        freeze_inradius=config.drawing.freeze_inradius and config.distance == "sdf",
        near_plane=config.drawing.near_plane,
        background=background_of(config),
    )
    if config.finish == "none":
        share = min(MOST_DROPPED, (config.drawing.dropout / photos) ** 2)
        return replace(plain, dropout=share, draw=iteration % DRAWS)
    opaque = ramp(iteration, 0, round(OPAQUE_AT * config.iterations))
    sharp = ramp(iteration, round(SHARP_FROM * config.iterations), round(SHARP_AT * config.iterations))
    ceiling = FIRST_CEILING * (FINAL_CEILING / FIRST_CEILING) ** sharp
    return replace(plain, opacity_floor=FINAL_FLOOR * opaque, sigma_ceiling=ceiling)


def _placed(points: StartPoints, capture: Dataset, config: TrainConfig, generator: torch.Generator) -> TriangleSoup:
    return start_soup(
        points,
        generator,
        scale=config.start.scale,
        opacity=config.start.opacity,
        sigma=config.start.sigma,
        sh_degree=config.drawing.sh_degree,
        centers=capture.centers[capture.train],
        limit=config.start.limit,
    )


def _start_of(part: ScenePart, frame: Normalization) -> TriangleSoup:
    assert part.start is not None
    soup = in_frame(part.start, frame)
    return replace(soup, **{name: tensor.clone() for name, tensor in soup.state().items()}).learnable()


def _start_points(capture: Dataset, config: TrainConfig, generator: torch.Generator, *, whole: bool) -> StartPoints:
    """The capture's points, or random ones in a cube that holds what the cameras look at."""
    positions, colors = capture.points, capture.point_colors
    if positions is None:
        points = random_points(random_count(capture, config), capture.viewmats[capture.train], generator)
    else:
        grey = torch.full_like(positions, 0.5)
        points = StartPoints(positions, grey if colors is None else colors)
    return points.with_sky() if config.sky == "dome" and whole else points


def background_of(config: TrainConfig) -> tuple[float, float, float]:
    """Behind the pictures that are measured."""
    grey = 1.0 if config.background == "white" else 0.0
    return grey, grey, grey
