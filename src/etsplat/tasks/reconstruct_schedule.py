"""What changes over a reconstruction: rates, softness, how large pictures are, and how the mesh is drawn at the end."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from etsplat.model.triangle_mesh import MeshAppearance
from etsplat.optim.schedules import NEVER, Schedule, coarse_level, exponential_decay, late_decay
from etsplat.tasks.reconstruct_config import ReconstructConfig

HELD = 0.98
"""At this fraction of a run meshes are untangled too, and then vertices stay, so that nothing folds again. Whether that
spoils pictures is judged when colours have settled."""

_OUTLINES = 0.5
"""Of the iterations that draw the mesh opaque, those behind which it is brought to the photos' outlines."""

_OPAQUE_FALL = 0.05
"""What rates of vertices and colours fall to over the iterations that draw the mesh opaque."""


def held_from(config: ReconstructConfig) -> int:
    """The last iteration that moves vertices, of a run that untangles."""
    return max(1, round(HELD * config.iterations))


def soft_until(config: ReconstructConfig) -> int:
    """The last iteration whose pictures are of soft triangles, if that comes before the last of the run, or NEVER."""
    last = round(config.drawing.opaque_from * config.iterations)
    return last if config.soft and last < config.iterations else NEVER


def outlines_after(config: ReconstructConfig) -> int:
    """The iteration after which vertices are brought to where masks have their outlines, or NEVER.

    Soft pictures have theirs elsewhere; and where cameras are refined, those of the photos are not yet right.
    """
    soft = soft_until(config)
    if not config.refinement.outlines or soft == NEVER or config.refine_cameras != "off":
        return NEVER
    return soft + round(_OUTLINES * (config.iterations - soft))


def while_soft(weight: float, last: int) -> Callable[[int], float]:
    """The weight of a term that looks at what only soft triangles give: 0 behind the last iteration with these."""
    return lambda iteration: weight if iteration <= last else 0.0


def make_schedule(config: ReconstructConfig, appearance: MeshAppearance, *, near: bool) -> Schedule:
    """Of a run.

    Soft triangles find a shape from afar, but leave noise on it, and outlines a quarter of a pixel inside. So at last
    the mesh is drawn as a viewer draws it, opaque with antialiased silhouettes (`opaque_from`). Then pictures say
    nothing of vertices within the outlines; where gradients are small, vertices move little (`Adam.calmed`).

    Args:
        config: settings.
        appearance: how the mesh is drawn at first.
        near: whether it starts near the surface.
    """
    length, rates, pictures = config.iterations, config.optimizer, config.pictures
    annealed, soft = config.soft and rates.sigma_final > 0, soft_until(config)
    held = held_from(config) if config.refinement.untanglings else length
    fall = late_decay if near and config.start.near_fall == "late" else exponential_decay

    def at_last(iteration: int) -> float:
        return late_decay(iteration - soft, length - soft, _OPAQUE_FALL) if iteration > soft else 1.0

    def vertices(iteration: int) -> float:
        if iteration > held:
            return 0.0
        if iteration > soft:
            return rates.lr_opaque * at_last(iteration)
        return rates.lr_vertices * fall(iteration, length, rates.lr_vertices_final)

    def log_sigma(iteration: int) -> float:
        softer = exponential_decay(iteration, length, rates.sigma_final / config.start.sigma)
        return math.log(config.start.sigma * softer)

    opaque = replace(appearance, kernel=None)
    return Schedule(
        rates={
            "vertices": vertices,
            "colors": lambda iteration: rates.lr_colors * at_last(iteration),
            "opacity_logits": while_soft(rates.lr_opacities, soft),
            "log_sigma": 0.0 if annealed else while_soft(rates.lr_sigma, soft),
            "harmonics": while_soft(rates.lr_harmonics, soft),
        },
        values={"log_sigma": log_sigma} if annealed else {},
        appearance=lambda iteration: appearance if iteration <= soft else opaque,
        halvings=partial(coarse_level, iterations=length, levels=pictures.coarse_levels, until=pictures.coarse_until),
        calm_from={} if soft == NEVER else {"vertices": soft + 1},
    )
