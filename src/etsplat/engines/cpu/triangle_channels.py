"""The CPU engine's side of `triangle_channels`: csrc/cpu/bind_triangle_channels.cpp."""

from typing import Any

from torch import Tensor

from etsplat import _native

_CALLS = {"forward": _native.triangle_channels, "gradient": _native.triangle_channels_backward}


def run(name: str, problem: tuple[Any, ...], images: tuple[Tensor, ...]) -> None:
    """See `etsplat.engines.native.triangle_channels.Run`."""
    _CALLS[name](*problem, *(tensor.data_ptr() for tensor in images))
