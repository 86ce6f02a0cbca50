"""The numbers of a queued step, by name: a row of floats that packs and unpacks itself (`optim/step_queue.py`)."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor


class RowLayout:
    """Named groups of numbers, side by side.

    Attributes:
        width: numbers in a row.
    """

    def __init__(self, **counts: int) -> None:
        """Takes how many numbers each group has, in the order in which they lie."""
        self._counts = counts
        self.width = sum(counts.values())

    def pack(self, **groups: Sequence[float]) -> list[float]:
        """A row of the groups.

        Raises:
            ValueError: other groups than there are, or of another size.
        """
        given = {name: len(group) for name, group in groups.items()}
        if given != self._counts:
            raise ValueError(f"groups must be {self._counts}, got {given}")
        return [float(number) for name in self._counts for number in groups[name]]

    def unpack(self, row: Float[Tensor, " W"]) -> dict[str, Tensor]:
        """The groups of a row by name, as views of it: nothing is launched for them."""
        return dict(zip(self._counts, row.split(list(self._counts.values())), strict=True))
