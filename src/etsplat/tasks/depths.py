"""Depth maps of a run: whether they are read, and what they are compared with before they count."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.depth_points import maps_on_maps, points_on_maps
from etsplat.data.frames import LARGEST
from etsplat.metrics.depth import FEWEST
from etsplat.optim.depth_trust import DepthTrust
from etsplat.optim.loop import Event, NoteEvent
from etsplat.optim.schedules import NEVER

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

    early = DepthTrust(maps, setting, NEVER, tell)
    if capture.exact_points is not None:
        pairs = points_on_maps(capture, maps)
        if 2 * sum(len(known) >= FEWEST for known, _ in pairs.values()) >= len(maps):
            early.judge(pairs, "what the capture's points show")
            return early
    if early.judge(maps_on_maps(capture, maps), "what the maps of other photos show", only="l1"):
        return early
    return DepthTrust(maps, setting, compared_at, tell)
