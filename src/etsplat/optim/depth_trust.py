"""Whether depth maps are believed, which of them, and as what.

Before their term counts, maps are compared with what is known of the same depths otherwise: with the capture's points
before the first step, or with each other, as the poses have it; or else with the model itself once photos have shaped
it. Maps that contradict that are left out, all or some. Where photos that are kept aside get worse while the term
counts, it counts no more.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.spelling import option
from etsplat.data.loader import View
from etsplat.metrics.depth import DepthAgreement, DepthKind, Pairs, depth_agreement
from etsplat.model.model import Model
from etsplat.optim.schedules import NEVER

NEEDED, NEEDED_OF_ONE = 0.4, 0.2
"""What maps must explain of the depths that are known from elsewhere: the median over the photos, and each."""

NEAR_ONE = 0.05
"""Maps are depths in the capture's units where the known ones are as large, to this part; else in other units."""

WORSE = 0.5
"""By so many dB photos that are kept aside may get worse while the term counts."""

Choice = Literal["auto", "l1", "pearson"]
_KINDS: Mapping[Choice, tuple[DepthKind, ...]] = {"auto": ("l1", "pearson"), "l1": ("l1",), "pearson": ("pearson",)}


class DepthTrust:
    """What a run knows of its depth maps.

    Attributes:
        measured_at: iteration after which maps are compared with the model; `NEVER` where points have spoken.
        kind: as what maps are believed by now; None if they are not, or not yet.
        inverse: whether they are of inverse depths.
        explained: what they explained when they were compared; None before.
        photos: how many maps are believed.
        unit: maps that are believed as depths are multiplied by this: 1, or what was found where it was wrong.
    """

    def __init__(
        self,
        maps: Iterable[int],
        choice: Choice = "auto",
        measured_at: int = NEVER,
        tell: Callable[[str], None] = lambda text: None,
        unit_near: Callable[[float], float | None] = lambda factor: None,
    ) -> None:
        """Believes in nothing yet.

        Args:
            maps: views that have depth maps.
            choice: as what they may be believed.
            measured_at: iteration after which they are compared with the model.
            tell: called with a sentence when something is decided.
            unit_near: finds the factor, near a rough one, with which maps agree with each other; None where none does.
        """
        self._maps, self._kinds, self.measured_at, self._tell = list(maps), _KINDS[choice], measured_at, tell
        self._unit_near, self.unit = unit_near, 1.0
        self.kind: DepthKind | None = None
        self.explained: float | None = None
        self.inverse, self.dropped = False, False
        self._best = -math.inf
        self._used = torch.zeros(max(self._maps, default=0) + 1)

    @property
    def photos(self) -> int:
        """How many maps are believed."""
        return int(self._used.sum()) if self.kind else 0

    @property
    def believed_maps(self) -> list[int]:
        """Views whose maps are believed."""
        return [view for view in self._maps if self.kind and self._used[view]]

    def start(self, like: Tensor) -> None:
        """Goes to the device and precision of a tensor of the model."""
        self._used = self._used.to(like)

    def believed(self, index: Int[Tensor, "1"] | None) -> Float[Tensor, ""]:
        """1 where the map of a view, by its index on the device, is believed; else 0."""
        assert index is not None
        return self._used.index_select(0, index.clamp_max(len(self._used) - 1))[0]

    def judge(self, pairs: Mapping[int, Pairs], elsewhere: str, only: DepthKind | None = None) -> bool:
        """Decides by depths that are known from elsewhere.

        Args:
            pairs: of views with maps.
            elsewhere: what these depths are, for the sentence.
            only: believes in maps as this alone, and says nothing if it does not.

        Returns:
            Whether maps are believed.
        """
        found = depth_agreement([pairs[view] for view in pairs])
        if only is None and "l1" in self._kinds:
            found = self._in_unit(found, pairs)
        kinds: list[DepthKind] = [kind for kind in self._kinds if only is None or kind == only]
        agreeing: list[DepthKind] = [kind for kind in kinds if self._agrees(found, kind)]
        if not agreeing and only is not None:
            return False
        self.kind = kind = agreeing[0] if agreeing else None
        self.explained = max(found.overall(each) for each in agreeing[:1] or kinds)
        self.inverse = kind == "pearson" and found.inverse
        if kind is not None:
            for view, explained in zip(pairs, found.of(kind).tolist(), strict=True):
                self._used[view] = float(math.isnan(explained) or explained >= NEEDED_OF_ONE)
        self._tell(self._sentence(found, elsewhere))
        return kind is not None

    @torch.no_grad()
    def measure(self, model: Model, views: Iterable[View]) -> None:
        """Decides by the model as it is now. Changes nothing else.

        Args:
            model: as photos have shaped it.
            views: of photos with maps.
        """
        pairs: dict[int, Pairs] = {}
        for view in views:
            # Of soft triangles the expected depth lies behind the surface, early in a run by several per cent.
            drawn = model.render(view.camera, outputs=("color", "median_depth")).median_depth
            assert drawn is not None
            assert view.depth is not None
            known = (drawn[0, ..., 0] > 0) & (view.depth[0] > 0)
            pairs[int(view.index)] = drawn[0, ..., 0][known].cpu(), view.depth[0][known].cpu()
        self.judge(pairs, "what the photos have shaped so far")

    def observe(self, watched_psnr: float) -> None:
        """To be called with the PSNR of the photos that are kept aside at every evaluation."""
        if self.kind is None:
            return
        self._best = max(self._best, watched_psnr)
        if watched_psnr < self._best - WORSE:
            self.kind, self.dropped = None, True
            self._tell(
                f"depth maps: the photos kept aside fell from {self._best:.2f} to {watched_psnr:.2f} dB; the maps are "
                "not used from here on"
            )

    def next_measurement(self, iteration: int) -> int:
        """The iteration, this one or later, after whose step maps are compared."""
        return NEVER if self.measured_at < iteration else self.measured_at

    def metrics(self) -> dict[str, object]:
        """For metrics.json: as what the maps were believed at the end, how many, what they explained, in which unit."""
        explained = self.explained if self.explained is not None and math.isfinite(self.explained) else None
        unit = {"depth_factor": self.unit} if self.unit != 1 else {}
        kind = f"inverse {self.kind}" if self.kind and self.inverse else self.kind
        return {"depth_used": kind, "depth_photos": self.photos, "depth_explained": explained, **unit}

    def state(self) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint; empty before maps are compared."""
        if self.explained is None:
            return {}
        code = 0 if self.kind is None else _KINDS["auto"].index(self.kind) + 1
        numbers = [code, self.inverse, self.explained, self.dropped, self._best]
        unit = {} if self.unit == 1 else {"unit": torch.tensor(self.unit, dtype=torch.float64)}
        return {"decided": torch.tensor(numbers, dtype=torch.float64), "used": self._used, **unit}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        self.kind, self.explained, self.unit = None, None, 1.0
        if "decided" not in state:
            return
        code, inverse, explained, dropped, self._best = state["decided"].tolist()
        if "unit" in state:
            self.unit = float(state["unit"])
        self.kind = _KINDS["auto"][int(code) - 1] if code else None
        self.inverse, self.explained, self.dropped = bool(inverse), explained, bool(dropped)
        self._used = state["used"].to(self._used)

    def _in_unit(self, found: DepthAgreement, pairs: Mapping[int, Pairs]) -> DepthAgreement:
        """How maps agree in the unit in which they do with each other, where theirs is another; takes that unit."""
        if not math.isfinite(found.factor) or abs(math.log(found.factor)) <= NEAR_ONE or found.inverse:
            return found
        unit = self._unit_near(found.factor)
        if unit is None:
            return found
        again = depth_agreement([(known, unit * said) for known, said in pairs.values()])
        if not self._agrees(again, "l1"):
            return found
        self.unit = unit
        return again

    def _agrees(self, found: DepthAgreement, kind: DepthKind) -> bool:
        right = kind == "pearson" or abs(math.log(found.factor)) <= NEAR_ONE
        return found.overall(kind) >= NEEDED and right

    def _sentence(self, found: DepthAgreement, elsewhere: str) -> str:
        total, explained = len(self._maps), 100 * max(0.0, found.overall(self.kind or "pearson"))
        unit = ""
        if self.unit != 1:
            unit = f"; {elsewhere} is {self.unit:.4g} times as far away, where maps agree: they are multiplied by it"
        elif math.isfinite(found.factor) and abs(math.log(found.factor)) > NEAR_ONE and not found.inverse:
            away = f"{elsewhere} is {found.factor:.4g} times as far away"
            unit = f"; {away}: correct the unit with {option('depth_unit', ...)}"
        if self.kind is None:
            known = (
                "nothing is known to compare them with"
                if found.overall("pearson") == -math.inf
                else (f"they contradict {elsewhere} ({explained:.0f} % explained, {100 * NEEDED:.0f} % needed)")
            )
            return f"depth maps: not used, {known}{unit}"
        told = {"l1": "as depths", "pearson": "up to scale and shift"}[self.kind]
        what = f"{told}, of inverse depths" if self.inverse else told
        return f"depth maps: {self.photos} of {total} used {what}; {explained:.0f} % of {elsewhere} explained{unit}"
