"""Which engine runs an operation: ``reference`` (plain PyTorch), ``cpu`` or ``cuda`` (native, float32)."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.errors import EngineUnavailableError, InputError
from etsplat.cuda.launch import backend, device_type

ENGINES = ("reference", "cpu", "cuda")


def resolve_engine(engine: str | None, tensor: Tensor) -> str:
    """The engine for an operation on ``tensor``.

    Args:
        engine: "reference", "cpu", "cuda", or None for the fastest that computes in the tensor's precision on its
            device: cpu or cuda for float32, reference for float64.
        tensor: Decides by its device and dtype.

    Raises:
        ValueError: Unknown engine, a device or dtype that the engine does not compute with.
    """
    if engine is not None and engine not in ENGINES:
        raise ValueError(f"engine must be one of {', '.join(ENGINES)} or None, got {engine!r}")
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"tensors must be float32 or float64, got {tensor.dtype}")
    if engine is None:
        native = tensor.dtype == torch.float32 and tensor.device.type in ("cpu", "cuda")
        return tensor.device.type if native else "reference"
    if engine == "reference":
        return engine
    device, name = ("cpu", "the CPU") if engine == "cpu" else (device_type(), "a GPU")
    if tensor.device.type != device:
        raise ValueError(f"engine {engine} needs tensors on {name}, got {tensor.device}")
    if tensor.dtype != torch.float32:
        raise ValueError(f"engine {engine} computes in float32, got {tensor.dtype}: use engine='reference' or .float()")
    return engine


def resolve_device(device: str | None, engine: str | None) -> torch.device:
    """Where a task runs.

    Args:
        device: "cpu", "cuda", or None: where `engine` computes; if that is None too, on a GPU if there is one that
            engine cuda can use. Where there is one that it cannot use, a line says why.
        engine: as of `resolve_engine`.

    Raises:
        EngineUnavailableError: It needs a GPU, and something is missing; the message says what.
        InputError: `device` and `engine` exclude each other.
    """
    if {device, engine} == {"cpu", "cuda"}:
        raise InputError(f"engine: {engine} does not compute on device {device}; leave one of them out")
    if device == "cpu" or (device is None and engine in ("cpu", "reference")):
        return torch.device("cpu")
    if device is None and engine is None:
        if not torch.cuda.is_available():
            return torch.device("cpu")
        try:
            backend()
        except EngineUnavailableError as error:
            print(f"computing on the CPU: {error}", file=sys.stderr)
            return torch.device("cpu")
    backend()
    return torch.device(device_type())


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
