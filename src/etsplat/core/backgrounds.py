"""Colours behind pictures: one for all views, or one for each."""

from typing import TypeVar

import torch
from torch import Tensor

Given = TypeVar("Given", bound=Tensor | None)


def for_each_view(backgrounds: Given, views: int) -> Given | Tensor:
    """(B, C), a row for each of so many views, where (C,) is given for all of them; anything else as it is.

    Example:
        >>> from etsplat.core.backgrounds import for_each_view
        >>> for_each_view(torch.ones(3), views=2).shape
        torch.Size([2, 3])
    """
    if isinstance(backgrounds, Tensor) and backgrounds.ndim == 1 and backgrounds.layout == torch.strided:
        return backgrounds.expand(views, -1)
    return backgrounds
