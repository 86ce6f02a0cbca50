"""Which triangles of a soup are handed on, and why the others are not: the sky, a crop, and what no photo shows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.core.spelling import either, option
from etsplat.data.dataset import Dataset
from etsplat.data.looked_at import frames_around, looked_at, out_of_every_frame
from etsplat.geometry.isolation import standing_alone
from etsplat.geometry.regions import Region
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.tasks.opened_runs import SoupRun, training_cameras

Crop = Region | Literal["auto"]
"""What a soup is cropped to, in its capture's own units and axes; "auto" is what the photos look at."""

SHOWN_WEIGHT = 0.02
"""A photo shows a triangle that has this blend weight in one of its pixels; drawn opaque, that is nearest in one."""

FEWEST, SPARSE = 2, 16
"""Cleaning keeps what so many photos show of what is soft; of fewer photos than `SPARSE`, and of what is drawn opaque,
what a single one shows: it may be smaller than a pixel."""

Reason = Literal["faint", "sky", "crop", "frame", "unseen", "alone"]

REASONS: Mapping[Reason, str] = {
    "faint": "too faint",
    "sky": "of the sky",
    "crop": "outside of the crop",
    "frame": "out of every photo's frame",
    "unseen": "shown by too few photos",
    "alone": "standing alone",
}
"""Why triangles are left out, in words, in the order in which it is asked."""


@dataclass(frozen=True)
class Selection:
    """What of a soup's N triangles is kept.

    Attributes:
        kept: (N,) which, on the soup's device.
        sky: (N,) which are sky, kept or not.
        surroundings: the sphere that the sky is on; None if none is known.
        crop: the region that was cropped to, or None.
        removed: how many are left out, each for the first reason that holds; no entry where there are none.
    """

    kept: Bool[Tensor, " N"]
    sky: Bool[Tensor, " N"]
    surroundings: Surroundings | None
    crop: Region | None
    removed: Mapping[Reason, int]

    def of(self, soup: TriangleSoup) -> TriangleSoup:
        """What is kept of the soup that was chosen from."""
        return soup if bool(self.kept.all()) else soup.kept(self.kept)


def select(
    run: SoupRun,
    *,
    crop: Crop | None = None,
    clean: bool = False,
    sky: bool = True,
    min_opacity: float = 0.0,
    opaque: bool = False,
) -> Selection:
    """Choose triangles.

    Args:
        run: the soup; with its capture, to clean it and to crop it to what the photos look at.
        crop: leave out triangles whose centroid is outside.
        clean: leave out what no training photo has in its frame, what too few of them show, and then small groups that
            stand alone, of which most photos that frame them show nothing. The sky stays as it is.
        sky: keep the sky.
        min_opacity: leave out what is fainter, as it is drawn.
        opaque: what is kept will be drawn opaque; else as soft as it is. What photos show is found likewise.

    Raises:
        InputError: the capture is needed and not known; nothing is left.
    """
    soup, surroundings = run.soup, surroundings_of(run)
    vertices = soup.vertices.detach()
    on_sky = torch.zeros(len(soup), dtype=torch.bool, device=run.device)
    if surroundings is not None:
        on_sky = surroundings.to(run.device).outermost(vertices)
    region = crop_region(run, on_sky) if crop == "auto" else crop
    choice = _Choice(len(soup), run.device)
    choice.leave_out("faint", soup.drawn_opacities.detach() < min_opacity)
    drawn = choice.kept
    if not sky:
        choice.leave_out("sky", on_sky)
    if region is not None:
        choice.leave_out("crop", ~region.holds(vertices.mean(dim=1)))
    if clean:
        _clean(choice, soup, run.needed_capture(), on_sky, drawn if opaque else None)
    removed: dict[Reason, int] = {reason: count for reason, count in choice.removed.items() if count}
    if not bool(choice.kept.any()):
        raise InputError(f"{run.path}: {_nothing_left(run, removed)}")
    return Selection(choice.kept, on_sky, surroundings, region, removed)


def in_words(removed: Mapping[Reason, int]) -> str:
    """What was left out, for people; empty if nothing was."""
    return ", ".join(f"{count:,} {REASONS[reason]}" for reason, count in removed.items())


def surroundings_of(run: SoupRun) -> Surroundings | None:
    """The sphere on which the sky of a soup is, in the capture's own units; None if it has none, or none is known.

    It is in the notes of soups that were trained. Of others it is that which `sky=sphere` would have made, if the
    capture has points: without any, cameras alone do not say how far away the scene is.
    """
    if (note := run.soup.notes.get(Surroundings.NOTE)) is not None:
        return Surroundings.of_note(note)
    if run.capture is None or run.capture.points is None:
        return None
    return Surroundings.of(run.capture)


def crop_region(run: SoupRun, sky: Bool[Tensor, " N"]) -> Region:
    """The sphere around what the training photos look at: of the capture's points, or of what is opaque, not sky.

    Raises:
        InputError: the capture is not known, or nothing is opaque.
    """
    capture = run.needed_capture()
    points = capture.exact_points
    if points is None:
        points = run.soup.vertices.detach()[run.soup.seen_opaque & ~sky].mean(dim=1).cpu()
    if not len(points):
        crop = option("crop", "auto")
        raise InputError(f"{run.path}: nothing in it is opaque, so {crop} finds no place; name a region")
    return looked_at(capture, points)


@torch.no_grad()
def times_shown(
    soup: TriangleSoup, cameras: list[Cameras], opaque: Bool[Tensor, " N"] | None = None
) -> Int[Tensor, " N"]:
    """How many cameras show each triangle, on its device.

    Args:
        soup: of N triangles.
        cameras: single ones.
        opaque: which triangles are drawn, opaque; None: all of them, as soft as they are.
    """
    count = torch.zeros(len(soup), dtype=torch.int64, device=soup.vertices.device)
    near = soup.appearance.near_plane
    for camera in (camera.to(count.device) for camera in cameras):
        if opaque is None:
            seen = soup.render(camera, outputs=("statistics",)).statistics
            assert seen is not None
            count += seen.max_weight[0] >= SHOWN_WEIGHT
            continue
        nearest = rasterize_opaque(soup.vertices.detach()[opaque], cameras=camera, near_plane=near).triangle
        assert nearest is not None
        pixels = torch.bincount(nearest[nearest >= 0].long(), minlength=int(opaque.sum()))
        count[opaque] += (pixels > 0).long()
    return count


class _Choice:
    """What is kept up to now, and how many each reason took."""

    def __init__(self, count: int, device: torch.device) -> None:
        self.kept = torch.ones(count, dtype=torch.bool, device=device)
        self.removed: dict[Reason, int] = {}

    def leave_out(self, reason: Reason, rows: Bool[Tensor, " N"]) -> None:
        self.removed[reason] = int((self.kept & rows).sum())
        self.kept = self.kept & ~rows


def _clean(
    choice: _Choice,
    soup: TriangleSoup,
    capture: Dataset,
    sky: Bool[Tensor, " N"],
    opaque: Bool[Tensor, " N"] | None,
) -> None:
    vertices = soup.vertices.detach()
    choice.leave_out("frame", ~sky & out_of_every_frame(capture, vertices, soup.appearance.near_plane))
    shown = times_shown(soup, training_cameras(capture), opaque)
    fewest = FEWEST if opaque is None and len(capture.train) >= SPARSE else 1
    choice.leave_out("unseen", ~sky & (shown < fewest))
    rows = (choice.kept & ~sky).nonzero()[:, 0]
    rows = rows[standing_alone(vertices[rows]).to(rows.device)]
    framed = frames_around(capture, vertices[rows].mean(dim=1).cpu()).to(rows.device)
    alone = torch.zeros_like(sky)
    alone[rows[2 * shown[rows] < framed]] = True  # what most photos show is there, if it is a bird in the air
    choice.leave_out("alone", alone)


def faint_remedy(run: SoupRun) -> str:
    """What to do where most of a soup is left out as too faint."""
    lower = f"lower {option('min_opacity')}"
    if run.opaque is not None:
        soft = (option("alpha", True), option("colors", "keep"), option("triangles", "soup"))
        return f"{lower}, or take the run's opaque mesh (without {', '.join(soft)})"
    if run.in_blocks:
        return f"{lower}, or train with {option('finish', 'opaque')}; no opaque mesh is made of blocks"
    return f"{lower}, or take the opaque mesh (train {either('--asset', 'with asset=True')})"


def _nothing_left(run: SoupRun, removed: Mapping[Reason, int]) -> str:
    remedy = f"leave out {option('clean')}"
    if "crop" in removed:
        remedy = f"choose another {option('crop')}, in the units and axes of the capture"
    elif list(removed) == ["faint"]:
        return f"no triangle is opaque enough; {faint_remedy(run)}"
    if not removed:
        return "has no triangles"
    return f"nothing is left of it ({in_words(removed)}); {remedy}"
