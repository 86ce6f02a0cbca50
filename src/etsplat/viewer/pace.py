"""How large pictures may be so that moving stays fluent."""

import math

SMALLEST = 96
"""Pixels of the width below which a picture shows nothing."""


class Pace:
    """Chooses the width of pictures while the camera moves, from how long the last ones took.

    Time grows about in proportion to the number of pixels on top of what every picture costs; the choice goes halfway
    to what that predicts, so that it settles instead of swinging.
    """

    def __init__(self, full_width: int, seconds: float) -> None:
        self.full_width = full_width
        self._seconds = seconds
        self._width = float(min(full_width, 320))

    @property
    def width(self) -> int:
        """Of the next picture while moving."""
        return max(SMALLEST, min(self.full_width, round(self._width)))

    def took(self, seconds: float) -> None:
        """Learn from a picture of `width` pixels across."""
        wanted = self.width * math.sqrt(self._seconds / max(seconds, 1e-4))
        self._width = max(SMALLEST, min(self.full_width, math.sqrt(self._width * wanted)))
