"""The GPU engine's side of `triangle_channels`: csrc/cuda/triangle_channels.cu."""

from typing import Any

from torch import Tensor

from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import struct_class

_PROGRAM = Program("triangle_channels.cu", contract=False)
_THREADS = 128


def run(name: str, problem: tuple[Any, ...], images: tuple[Tensor, ...]) -> None:
    """See `etsplat.engines.native.triangle_channels.Run`."""
    struct = struct_class("cuda/triangle_channels.cu", "ChannelsOf")(*problem)
    launch(_PROGRAM, f"triangle_channels_{name}", blocks(struct.triangles, _THREADS), _THREADS, (struct, *images))
