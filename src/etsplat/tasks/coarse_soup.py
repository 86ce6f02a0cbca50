"""Depths of an object by a small soup of triangles: it needs no surface that photos agree on to begin with.

Triangles begin everywhere within the visual hull, and become what photos show: those in a hollow turn transparent,
those at its bottom take its colours. So it sees into what is too deep, or seen at too steep a slant, for a lid to be
pushed in.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.free_space import free_space
from etsplat.data.photos import reduced
from etsplat.data.visual_hull import Distance, outside_hull
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.loop import Event, StageEvent, StepEvent
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.soup_trainer import start_trainer
from etsplat.tasks.train_config import TrainConfig

LONGEST, STEPS = 120, 800
"""Photos are halved until the object is no longer in them; and how often one is looked at."""

INSIDE, CHILDREN = 4000, 2000
"""Triangles that begin within the hull, beside those on it, and how many more there may be."""

_WITHIN, _DRAWN, _DRAWS = 0.01, 20_000, 50
"""How far within; and how many points are drawn at a time, so often at most: thin hulls hold few."""

_GREY = 0.5

_COVERED = 0.9
"""Of a pixel, where its depth is known."""


def seen_through(
    views: Dataset,
    vertices: Float[Tensor, "V 3"],
    config: ReconstructConfig,
    device: torch.device | None = None,
    tell: Callable[[Event], None] | None = None,
) -> Distance:
    """How far points are in front of what a soup shows that is fitted to the training views (`free_space`).

    Args:
        views: of the unit frame, with masks.
        vertices: (V, 3) of their hull.
        config: of the run: its seed, and whether photos are exposed differently.
        device: where the soup is fitted; None for the CPU.
        tell: called with how far it is.
    """
    small = reduced(views, LONGEST)
    points = torch.cat([vertices[::2], _within(views, vertices, config.seed)]).double()
    capture = replace(small, exact_points=points, point_colors=torch.full((len(points), 3), _GREY))
    trainer = start_trainer(capture, _settings(config, len(points)), device=device)

    def hear(event: Event) -> None:
        if tell is not None and isinstance(event, StepEvent):
            tell(StageEvent("Fitting a coarse soup", event.iteration, event.iterations))

    trainer.fit(STEPS, callbacks=[hear], log_every=20)
    soup = trainer.outcome().model.finished()
    return free_space(small, {view: depth_where(soup, small, view, _COVERED) for view in small.train})


def _settings(config: ReconstructConfig, points: int) -> TrainConfig:
    return TrainConfig.of("quick", "object").changed(
        {
            "iterations": STEPS,
            "seed": config.seed,
            "exposure": config.exposure,
            "max_triangles": points + CHILDREN,
            "pixels_per_triangle": None,
            "background": "random",
            "drawing.dropout": 0.0,  # it would cut less clearly
            "drawing.sh_degree": 0,
            "start.limit": None,
        }
    )


def _within(views: Dataset, vertices: Tensor, seed: int) -> Float[Tensor, "N 3"]:
    """Points within the hull, evenly."""
    generator, outside = torch.Generator().manual_seed(seed), outside_hull(views)
    lower, upper = vertices.amin(dim=0), vertices.amax(dim=0)
    found = [torch.zeros(0, 3)]
    for _ in range(_DRAWS):
        drawn = lower + torch.rand(_DRAWN, 3, generator=generator) * (upper - lower)
        found.append(drawn[outside(drawn) < -_WITHIN])
        if sum(map(len, found)) >= INSIDE:
            break
    return torch.cat(found)[:INSIDE]


@torch.no_grad()
def depth_where(soup: TriangleSoup, views: Dataset, view: int, covered: float) -> Float[Tensor, "H W"]:
    """At which half of a pixel is covered, on the CPU; 0 where less than a part of it is at all.

    Args:
        soup: in the frame of the views.
        views: whose camera sees it.
        view: its index.
        covered: that part.
    """
    camera = views.cameras[view].to(soup.vertices.device)
    drawn = soup.render(camera, outputs=("color", "median_depth"))
    assert drawn.median_depth is not None
    return torch.where(drawn.alpha[0, ..., 0] > covered, drawn.median_depth[0, ..., 0], 0.0).cpu()
