"""Depth maps of a run: whether they are read, and what they are compared with before they count."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from scipy.optimize import minimize_scalar

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.dense_cloud import COMPARED, FEWEST_POINTS, dense_start
from etsplat.data.depth_points import maps_on_maps, points_on_maps, shown_by_map
from etsplat.data.frames import LARGEST
from etsplat.metrics.depth import FEWEST, explained_as_they_are
from etsplat.optim.depth_trust import NEEDED, DepthTrust
from etsplat.optim.loop import Event, NoteEvent
from etsplat.optim.schedules import NEVER

REACH, STEPS, SHARP = 0.15, 13, 0.2
"""A unit is looked for between a rough one times exp(-REACH) and exp(REACH), at so many places and around the best of
them. It counts where maps explain more of each other by SHARP there than at both ends: photos from nearly one place
would agree in any."""

UNIT_PHOTOS = 24
"""So many maps at most are asked for their unit."""

Setting = Literal["auto", "l1", "pearson", "off"]


def wanted_depths(folder: str | Path | None, unit: float | None, setting: Setting) -> bool | Path:
    """What `load_dataset` is told of depth maps.

    Args:
        folder: with depth maps; None for the capture's own.
        unit: of their numbers.
        setting: what they are taken for.

    Raises:
        InputError: maps, or a unit, are given but not used; a unit that is not positive.
    """
    for name, given in (("depths", folder), ("depth_unit", unit)):
        if given is not None and setting == "off":
            raise InputError(f"{name}: has no effect without a depth loss; leave it out, or set that to auto")
    if unit is not None and not 0 < unit <= LARGEST:
        raise InputError(f"depth_unit: is {unit:g}; it must be positive, such as 0.001 for millimetres of metres")
    return False if setting == "off" else True if folder is None else Path(folder)


def trusted_depths(
    capture: Dataset, setting: Setting, compared_at: int, announce: Callable[[Event], None]
) -> DepthTrust | None:
    """What a run starts with: judged by the capture's points where maps see enough of them, or else by each other.

    Args:
        capture: in the frame that is trained in.
        setting: what maps are taken for.
        compared_at: iteration after which they are compared with the model, where points do not say enough.
        announce: told of what is decided.

    Returns:
        None where no training photo has a map, or none is wanted.
    """
    maps = [view for view in capture.train if view in capture.images.with_depth]
    if not maps or setting == "off":
        return None

    def tell(text: str) -> None:
        announce(NoteEvent(text))

    def unit_near(factor: float) -> float | None:
        return unit_of_maps(capture, maps[:: -(-len(maps) // UNIT_PHOTOS)], factor)

    early = DepthTrust(maps, setting, NEVER, tell, unit_near)
    if capture.exact_points is not None:
        pairs = points_on_maps(capture, maps)
        if 2 * sum(len(known) >= FEWEST for known, _ in pairs.values()) >= len(maps):
            early.judge(pairs, "what the capture's points show")
            return early
    if early.judge(maps_on_maps(capture, maps), "what the maps of other photos show", only="l1"):
        return early
    return DepthTrust(maps, setting, compared_at, tell, unit_near)


def with_shown_points(
    capture: Dataset, trust: DepthTrust | None, most: int, announce: Callable[[Event], None]
) -> Dataset:
    """A capture without points, with those that its depth maps show, where they are believed before the run.

    Triangles that begin at random places are a fog for half of a short run, whose depths no map can correct.

    Args:
        capture: in the frame that is trained in.
        trust: from `trusted_depths`.
        most: triangles that there may be; half as many points are taken.
        announce: told of what is found.
    """
    if capture.exact_points is not None or trust is None or trust.kind != "l1":
        return capture
    samples = max(1, math.isqrt(COMPARED // trust.photos))
    shown = torch.cat([shown_by_map(capture, view, trust.unit, samples) for view in trust.believed_maps])
    found = dense_start(shown, None, capture, max(1, most // 2))
    if len(found.positions) < FEWEST_POINTS:
        return capture
    announce(NoteEvent(f"depth maps: {found.note}"))
    return replace(capture, exact_points=found.positions, point_colors=found.colors)


def unit_of_maps(capture: Dataset, maps: Sequence[int], near: float) -> float | None:
    """The factor with which depth maps agree with each other, as the poses have it.

    Args:
        capture: with poses and maps.
        maps: views whose maps are compared.
        near: about what it is.

    Returns:
        None where they agree with none near that, or with any.
    """

    def explained(log: float) -> float:
        found = explained_as_they_are(list(maps_on_maps(capture, maps, near * math.exp(log)).values()))
        return float(found.nanmedian().nan_to_num(-math.inf))

    step = 2 * REACH / (STEPS - 1)
    values = {place: explained(place * step) for place in range(-(STEPS // 2), STEPS // 2 + 1)}
    best = max(values, key=values.__getitem__)
    if values[best] < max(NEEDED, SHARP + values[-(STEPS // 2)], SHARP + values[STEPS // 2]):
        return None
    bounds = ((best - 1) * step, (best + 1) * step)
    found = minimize_scalar(lambda log: -explained(log), bounds=bounds, method="bounded", options={"xatol": step / 100})
    return near * math.exp(float(found.x))
