"""Which engine runs an operation: ``reference`` (plain PyTorch, any dtype) or ``cpu`` (native, float32)."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from etsplat import _native

ENGINES = ("reference", "cpu")


def resolve_engine(engine: str | None, tensor: Tensor) -> str:
    """The engine for an operation on ``tensor``.

    Args:
        engine: "reference", "cpu", or None for the fastest that computes in the tensor's precision: cpu for float32,
            reference for float64.
        tensor: Decides by its device and dtype.

    Raises:
        ValueError: Unknown engine, a device or dtype that the engine does not compute with.
    """
    if engine is not None and engine not in ENGINES:
        raise ValueError(f"engine must be one of {', '.join(ENGINES)} or None, got {engine!r}")
    if tensor.device.type == "cuda" and engine is None:
        raise ValueError("the GPU engine is not part of this release: move the tensors to the CPU with .cpu()")
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"tensors must be float32 or float64, got {tensor.dtype}")
    if engine is None:
        return "cpu" if tensor.dtype == torch.float32 and tensor.device.type == "cpu" else "reference"
    if engine == "cpu" and tensor.device.type != "cpu":
        raise ValueError(f"engine cpu needs tensors on the CPU, got {tensor.device}")
    if engine == "cpu" and tensor.dtype != torch.float32:
        raise ValueError(f"engine cpu computes in float32, got {tensor.dtype}: use engine='reference' or .float()")
    return engine


def num_threads() -> int:
    """Number of threads the native engine uses."""
    return _native.num_threads()


def set_num_threads(count: int) -> None:
    """Set the number of threads of the native engine; 0 means every core this process may use.

    Results do not depend on it, to the bit.

    Raises:
        ValueError: ``count`` is negative.
    """
    if count < 0:
        raise ValueError(f"count must be 0 (all cores) or positive, got {count}")
    _native.set_num_threads(count)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Within the block torch computes on one thread, and leaves the others to the native engine.

    For loops of small torch operations between native calls: the threads of torch's OpenMP go on spinning for
    milliseconds after each operation, on the cores where the native threads then wait. A training step of 30 ms took
    80 ms that way.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
