"""Hulls with hollows, opened: lids pushed in, cut out between walls, or cut where a coarse soup sees through them."""

from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from etsplat.data.agreement import Looked, looked_at, mean_agreement
from etsplat.data.dataset import Dataset
from etsplat.data.false_handles import without_false_handles
from etsplat.data.hollows import Opened, open_hollows
from etsplat.data.lids import without_lids
from etsplat.data.photos import photos_of
from etsplat.data.plain_sides import with_flat_sides
from etsplat.data.same_colors import differing_share, surface_sameness
from etsplat.data.visual_hull import Distance, visual_hull
from etsplat.data.walls import between_plain_walls, between_walls
from etsplat.geometry.topology import MeshTopology
from etsplat.optim.loop import Event, NoteEvent, StageEvent
from etsplat.tasks.coarse_soup import seen_through
from etsplat.tasks.judgement import CONTRADICTED
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.starting_hull import Hull, most_faces, uncovered

_SURELY, _BETTER, _LACKED = 0.8, 0.01, 0.25
"""Mean correlation on walls under lids that were not pushed in, at least: it is 0.85 and more on those of vessels, 0.72
at most elsewhere. And by how much more photos agree on a hull cut out between them than on one with its lids pushed
in; where colours tell, as a part of what the sameness of that lacks of 1."""

_MARGINS = (0.05, 0.03, 0.08)
"""How far in front of what a coarse soup shows a hull is cut, in units of the object's radius; in turn, until photos
contradict it no more. Nearer takes away what is thin, farther leaves more of a lid to be pushed in."""

_OPEN = 0.01
"""Of what is open, as a cube without its bottom, photos contradict more by chance than `CONTRADICTED`: it is seen from
two sides. A soup that is asked all the same makes the walls of a hollow of its one sheet. Nor is one asked where walls
that photos surely agree on leave less than that."""

_CLEARLY, _RIMS = 0.7, 0.003
"""A cut hull is taken where photos contradict at most so many times as much of it, and if it leaves at most this part
of the silhouettes uncovered beside what the hull does: a little of a thin rim, which grows again."""

Cut = Literal["walls", "soup", False]
"""What a hull was cut open by: walls of one thickness, what a coarse soup shows, or nothing, though photos contradict
it."""


def open_hull(
    views: Dataset,
    vertices: Tensor,
    faces: Tensor,
    most: int,
    tell: Callable[[Event], None],
    stage: str = "Opening hollows",
) -> Opened:
    """A hull without false handles, its lids removed or pushed in, with so many faces at most if it has not more."""
    tell(StageEvent(stage, 0, 3))
    surface = without_false_handles(views, vertices, faces)
    tell(StageEvent(stage, 1, 3))
    lidless = without_lids(views, *surface)
    tell(StageEvent(stage, 2, 3))
    found = open_hollows(views, *lidless, most=most)
    return found._replace(lidded=surface, sheet=len(lidless[1]) < len(surface[1]))


def cut_open(
    views: Dataset,
    hull: Hull,
    opened: Opened,
    config: ReconstructConfig,
    device: torch.device | None,
    tell: Callable[[Event], None],
) -> tuple[Opened, Cut | None]:
    """A hull with hollows, cut out between walls, or where a coarse soup sees through it.

    Walls that photos surely agree on before lids are pushed in are tried first, whatever photos say of these. Others,
    and a soup, are asked where photos contradict the hull, and taken if they contradict it clearly less; instead of
    walls a soup is taken if they do not agree less on it, besides. At last one is asked where photos show other colours
    at each place, as on a plain lid, if none was before, and taken if they do so on clearly less.

    Args:
        views: of the unit frame.
        hull: as it was carved.
        opened: the same from `open_hull`.
        config: settings.
        device: of the soup; None for the CPU.
        tell: called before what takes long.

    Returns:
        The hull, and by what it was cut open; None where it was not, and photos do not contradict it.
    """
    cutter = _Cutter(views, hull, opened, config, tell)
    best, by = _where_contradicted(cutter, opened, device, tell)
    share = cutter.asked(differing_share, best)
    if by in ("soup", False) or share <= _OPEN or not _is_closed(best):  # one was asked, or sees sheets
        return best, by
    part = f"{100 * share:.1f} %"
    tell(NoteEvent(f"photos show other colours on {part} of the visual hull: a coarse soup is asked what is free"))
    left, soup = cutter.seen_through(device, partial(cutter.asked, differing_share))
    if left <= _CLEARLY * share and cutter.agree_no_less(surface_sameness, soup, best):
        return soup, "soup"
    return best, by


def _where_contradicted(
    cutter: "_Cutter", opened: Opened, device: torch.device | None, tell: Callable[[Event], None]
) -> tuple[Opened, Cut | None]:
    """Cut between walls that photos surely agree on, and where photos contradict what is left."""
    best, by, bound = opened, None, CONTRADICTED if _is_closed(opened) else _OPEN
    if (sure := cutter.surely_walled()) is not None:
        best, by, bound = sure, "walls", _OPEN
    if best.contradicted <= bound:
        return best, by
    if by is None:
        best = _clearer(cutter.walled(), opened)
        by = "walls" if best is not opened else False
    if best.contradicted > CONTRADICTED:
        part = f"{100 * best.contradicted:.1f} % of its surface"
        tell(NoteEvent(f"photos contradict the visual hull on {part}: a coarse soup is asked what is free"))
        soup = _clearer(cutter.seen_through(device, lambda cut: cut.contradicted)[1], best)
        if soup is not best and (by != "walls" or cutter.agree_no_less(mean_agreement, soup, best)):
            best, by = soup, "soup"
    return best, by


class _Cutter:
    """Cuts a hull open, where it has no more faces then than a run may have, and covers the silhouettes."""

    def __init__(
        self,
        views: Dataset,
        hull: Hull,
        opened: Opened,
        config: ReconstructConfig,
        tell: Callable[[Event], None],
    ) -> None:
        self._views, self._hull, self._opened, self._config, self._tell = views, hull, opened, config, tell
        self._photos = photos_of(views)

    def cut(self, free: Distance, wanted: int) -> Opened:
        """Without what is free, with about so many faces; the hull as it was where that does not do."""
        self._tell(StageEvent(stage := "Cutting the hull open", 0, 0))
        radius, most = self._config.start.radius, self._config.max_faces
        surface = visual_hull(self._views, wanted, radius=radius, thin=self._hull.thin, free=free)
        if len(surface[1]) == 0:
            return self._opened
        found = open_hull(self._views, *surface, most, self._tell, stage)
        covers = uncovered(self._photos, found.vertices, found.faces) <= self._hull.uncovered + _RIMS
        return found if covers and len(found.faces) <= most else self._opened

    def surely_walled(self) -> Opened | None:
        """Cut out between walls that photos surely agree on, under lids that are not pushed in; None if that is worse.

        By texture, if no lid was removed: both sides of a sheet look alike. Else by colours.
        """
        vertices, faces = self._opened.lidded or self._opened[:2]
        hull = with_flat_sides(self._views, vertices, faces), faces
        if self._opened.sheet:
            return self._plain_walls(hull, [], hull)
        pushed = self._opened.vertices[: len(vertices)]
        moved = (pushed != vertices).any(dim=1, keepdim=True)
        elsewhere = [torch.where(moved, pushed, hull[0])] if bool(moved.any()) else []
        textured, least = partial(between_walls, agreed=_SURELY), self.asked(mean_agreement, self._opened) + _BETTER
        found = self._better(hull, elsewhere, textured, mean_agreement, least)
        return found or self._plain_walls(hull, elsewhere, self._opened[:2])

    def _plain_walls(
        self, hull: tuple[Tensor, Tensor], elsewhere: list[Tensor], before: tuple[Tensor, Tensor]
    ) -> Opened | None:
        same = self.asked(surface_sameness, before)
        return self._better(hull, elsewhere, between_plain_walls, surface_sameness, same + _LACKED * (1 - same))

    def _better(
        self,
        hull: tuple[Tensor, Tensor],
        elsewhere: list[Tensor],
        walls: Callable[..., Distance | None],
        agreed: Callable[[Looked], float],
        least: float,
    ) -> Opened | None:
        """Cut out between walls, if photos agree on that by so much at least, and do not contradict it more.

        What was pushed in elsewhere stays so, or not, since that is wrong at times.
        """
        for pushed in (*elsewhere, None):
            found = self._between(walls, *hull, pushed=pushed)
            if found is self._opened:
                return None
            right = found.contradicted <= max(_OPEN, self._opened.contradicted)
            if right and self.asked(agreed, found) >= least:
                return found
        return None

    def agree_no_less(self, agreed: Callable[[Looked], float], cut: Opened, before: Opened) -> bool:
        """Whether photos agree on the first as much as on the other."""
        return self.asked(agreed, cut) >= self.asked(agreed, before)

    def asked(self, agreed: Callable[[Looked], float], surface: Opened | tuple[Tensor, Tensor]) -> float:
        """What photos say of a surface; 0 where there are none."""
        looked = looked_at(self._views, *surface[:2])
        return 0.0 if looked is None else agreed(looked)

    def walled(self) -> Opened:
        """Cut out between walls that photos agree on, under what lids that were pushed in leave."""
        vertices, faces = self._opened[:2]
        return self._between(between_walls, with_flat_sides(self._views, vertices, faces), faces)

    def _between(self, walls: Callable[..., Distance | None], *hull: Tensor, pushed: Tensor | None = None) -> Opened:
        self._tell(StageEvent("Looking for walls", 0, 0))
        free = walls(self._views, *hull, pushed=pushed)
        return self._opened if free is None else self.cut(free, min(2 * self._hull.wanted, most_faces(self._config)))

    def seen_through(self, device: torch.device | None, wrong: Callable[[Opened], float]) -> tuple[float, Opened]:
        """Cut where a coarse soup sees through it, by the margin at which least of it is wrong, and how much is."""
        ahead = seen_through(self._views, self._hull.vertices, self._config, device, self._tell)
        tries = list[tuple[float, Opened]]()
        for margin in _MARGINS:
            cut = self.cut(lambda points, margin=margin: ahead(points) - margin, self._hull.wanted)
            tries.append((wrong(cut), cut))
            if tries[-1][0] <= CONTRADICTED:
                break
        return min(tries, key=lambda each: each[0])


def _is_closed(surface: Opened) -> bool:
    return MeshTopology.from_faces(surface.faces, len(surface.vertices)).is_closed()


def _clearer(cut: Opened, before: Opened) -> Opened:
    """The first, if photos contradict it clearly less."""
    return cut if cut.contradicted <= _CLEARLY * before.contradicted else before
