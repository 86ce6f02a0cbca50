"""How a triangle soup is drawn, in training and afterwards."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

from jaxtyping import Float
from torch import Tensor

from etsplat.core.harmonics import MAX_DEGREE
from etsplat.core.kernels import DISTANCES
from etsplat.core.soup_numbers import SoupNumbers
from etsplat.core.validation import check_choice
from etsplat.io.json_text import parse_json
from etsplat.model.model import Appearance

SMALLEST_INRADIUS = 1.0
"""Triangle Splatting draws no triangle whose inscribed circle on the image is smaller, in pixels."""

OPAQUE_FROM = 0.5
"""Where a soup is drawn opaque, fainter triangles are left out."""


@dataclass(frozen=True)
class SoupAppearance(Appearance):
    """How the numbers of a soup become pictures.

    Attributes:
        kernel: "elastic", "bilateral" or "single_sided".
        distance: "barycentric" or "sdf".
        sh_degree: highest band of the colours that is used; None for all that the soup has.
        cull_small: leave out triangles with an inradius below one pixel, as Triangle Splatting does.
        cull_large: leave out triangles with a vertex farther from their middle than this times the image's longer side.
            Beside the camera triangles are stretched without bound, and would cover images that they are not in.
        freeze_inradius: with distance "sdf", hold the inradius constant in the backward pass, as Triangle Splatting.
        near_plane: triangles with a vertex at this depth or nearer are invisible.
        background: display colour behind them where nobody names another.
        opacity_floor: opacities are squeezed into [floor, 1].
        sigma_ceiling: softness is cut here.
        dropout: so large a share of the triangles is left out by chance in steps of a training, and only there.
        draw: the number of the draw that says which; of the iteration.
        on_device_numbers: (4,) the four above in device memory, in their place, within a queued step.

    Raises:
        ValueError: there is no such distance. Kernels are looked for where one draws: they may be registered by then.

    Example:
        >>> etsplat.SoupAppearance(kernel="bilateral", background=(1.0, 1.0, 1.0)).distance
        'barycentric'
    """

    kernel: str = "elastic"
    distance: str = "barycentric"
    sh_degree: int | None = None
    cull_small: bool = False
    cull_large: float = float("inf")
    freeze_inradius: bool = False
    near_plane: float = 0.01
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    opacity_floor: float = 0.0
    sigma_ceiling: float = float("inf")
    dropout: float = 0.0
    draw: int = 0
    on_device_numbers: Float[Tensor, "4"] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        check_choice("distance", self.distance, DISTANCES)

    @property
    def numbers(self) -> SoupNumbers:
        """What may change at every step."""
        return SoupNumbers(self.opacity_floor, self.sigma_ceiling, self.dropout, float(self.draw))

    def to_json(self) -> str:
        """For files; what is of steps alone is not in it, nor is what is infinite, as JSON has no such numbers."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name in _SOUND}
        return json.dumps({name: value for name, value in values.items() if value != float("inf")})

    @staticmethod
    def from_json(text: str) -> "SoupAppearance":
        """Of `to_json`; names that this version does not know are left out.

        Raises:
            ValueError: it is not JSON, or a value is none that can be drawn with.
        """
        document = parse_json(text)
        if not isinstance(document, dict):
            raise ValueError("appearance is not a JSON object")
        values = {name: value for name, value in document.items() if name in _SOUND}
        for name, value in values.items():
            if not _SOUND[name](value):
                raise ValueError(f"appearance has {name} = {value!r:.40}")
        if "background" in values:
            values["background"] = tuple(map(float, values["background"]))
        return SoupAppearance(**values)

    @property
    def structure(self) -> "SoupAppearance":
        """The same without its numbers."""
        return replace(self.whole, opacity_floor=0.0, sigma_ceiling=float("inf"), on_device_numbers=None)

    @property
    def whole(self) -> "SoupAppearance":
        """The same with all triangles."""
        return replace(self, dropout=0.0, draw=0)

    def on_device(self, numbers: Float[Tensor, "4"]) -> "SoupAppearance":
        """The same with its numbers read from device memory."""
        return replace(self, on_device_numbers=numbers)


def _number(low: float, high: float) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def _flag(value: Any) -> bool:
    return isinstance(value, bool)


def _color(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_number(-_LARGEST, _LARGEST), value))


_LARGEST = 1e30
_SOUND: dict[str, Callable[[Any], bool]] = {
    "kernel": lambda value: isinstance(value, str),
    "distance": lambda value: value in DISTANCES,
    "sh_degree": lambda value: value is None or (isinstance(value, int) and 0 <= value <= MAX_DEGREE),
    "cull_small": _flag,
    "cull_large": _number(1e-30, _LARGEST),
    "freeze_inradius": _flag,
    "near_plane": _number(1e-30, _LARGEST),
    "background": _color,
    "opacity_floor": _number(0, 1),
    "sigma_ceiling": _number(1e-30, _LARGEST),
}
"""Which values of a file can be drawn with."""
