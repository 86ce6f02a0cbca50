"""A soup that is fitted to photos which show others as well: these are drawn with it, and stay where they are."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import Rasterization, TriangleStatistics
from etsplat.model.model import Backgrounds, Depth
from etsplat.model.triangle_soup import Drawn, TriangleSoup


def _nothing() -> TriangleSoup:
    none = torch.zeros(0)
    return TriangleSoup(none.view(0, 3, 3), none, none.clone(), none.view(0, 1, 3), none.view(0, 0, 3))


@dataclass
class SurroundedSoup(TriangleSoup):
    """N learnable triangles among others. All but pictures is of the learnable ones alone: parameters, count, files.

    Attributes:
        rest: the others, in the same frame, as they are drawn.
        rest_dc: (M, 1, 3) the constant band of the others' colours, learnable; None where it stays as well.
    """

    RATES: ClassVar[Mapping[str, float]] = {**TriangleSoup.RATES, "rest_dc": TriangleSoup.RATES["sh_dc"]}
    BESIDE: ClassVar[tuple[str, ...]] = ("rest_dc",)

    rest: TriangleSoup = field(default_factory=_nothing)
    rest_dc: Float[Tensor, "M 1 3"] | None = None

    @classmethod
    def among(cls, soup: TriangleSoup, rest: TriangleSoup, *, recolored: bool = False) -> "SurroundedSoup":
        """The soup's tensors, not copies, among the rest; which is `recolored` if its plain colours learn too."""
        dc = rest.sh_dc.detach().clone().requires_grad_(True) if recolored else None
        return cls(**soup.parameters(), appearance=soup.appearance, notes=soup.notes, rest=rest, rest_dc=dc)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "SurroundedSoup":
        """Both on another device or in another precision."""
        moved = super().to(device, dtype)
        moved.rest = self.rest.to(device, dtype)
        return moved

    def drawn(self, cameras: Cameras, *, culls: bool) -> Drawn:
        """What is rasterized: the learnable triangles, then the rest."""
        rest = self._around().drawn(cameras, culls=culls)
        own = super().drawn(cameras, culls=culls)
        return Drawn(*(torch.cat(pair, dim=axis) for pair, axis in zip(zip(own, rest, strict=True), AXES, strict=True)))

    def render(
        self,
        cameras: Cameras,
        *,
        backgrounds: Backgrounds | None = None,
        outputs: tuple[str, ...] = ("color",),
        depth_of: Depth = "plane",
    ) -> Rasterization:
        """All triangles, with statistics of the learnable ones."""
        seen = super().render(cameras, backgrounds=backgrounds, outputs=outputs, depth_of=depth_of)
        if seen.statistics is None:
            return seen
        own = {name: values[:, : len(self)] for name, values in vars(seen.statistics).items()}
        return replace(seen, statistics=TriangleStatistics(**own))

    def render_opaque(self, cameras: Cameras, *, supersampling: int = 4) -> Float[Tensor, "B H W 4"]:
        """All triangles."""
        return self.everything().render_opaque(cameras, supersampling=supersampling)

    @torch.no_grad()
    def everything(self) -> TriangleSoup:
        """All triangles as one soup, in new tensors, the learnable ones first; appearances are written into it."""
        own = self.finished()
        values = {name: own.state()[name] for name in TriangleSoup.RATES}
        alone = TriangleSoup(**values, appearance=own.appearance, notes=own.notes)
        return alone.joined(self._around())

    def _around(self) -> TriangleSoup:
        return self.rest if self.rest_dc is None else replace(self.rest, sh_dc=self.rest_dc)


AXES = Drawn(vertices=0, opacities=0, sigma=0, colors=1)
