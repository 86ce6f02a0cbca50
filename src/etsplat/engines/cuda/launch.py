"""Launching kernels on tensors: ``launch(program, "name", grid, block, args)``.

Arguments are converted by their Python type, so that the call reads like the kernel's parameter list:

    Tensor   pointer to its data (contiguous)      None     null pointer
    int      int                                   bool     bool
    float    float                                 ctypes   as it is (c_int64, Structure for a struct by value)

On a device the kernel goes to torch's current stream of the current device; nothing waits for it. Tests put another
backend in its place (tests/helpers/simt), which runs the same sources on CPU tensors.
"""

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor

from etsplat.engines.cuda.device import Device
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import constant

Dim = int | tuple[int, ...]
BLOCK = constant("cuda/common.h", "kBlock")
"""Threads of a block, where nothing else is said."""
_NOWHERE_ELSE = nullcontext()


_backend: Device | None = None


def backend() -> Device:
    """What runs kernels now.

    Raises:
        EngineUnavailableError: There is no usable GPU, driver, torch or NVRTC; the message says which.
    """
    global _backend
    if _backend is None:
        _backend = Device()
    return _backend


@contextmanager
def use_backend(other: Any) -> Iterator[None]:
    """Within the block kernels run on ``other``, which has what `Device` has."""
    global _backend
    before, _backend = _backend, other
    try:
        yield
    finally:
        _backend = before


def device_type() -> str:
    """Type of the device whose tensors the engine computes on: "cuda", or "cpu" under the tests' backend."""
    return "cuda" if _backend is None else _backend.device_type


def launch(program: Program, name: str, grid: Dim, block: Dim, args: Sequence[Any]) -> None:
    """Start kernel ``name`` of ``program`` on the current stream; no launch if the grid is empty.

    Args:
        program: What the kernel is compiled from.
        name: The kernel's ``extern "C"`` name.
        grid: Number of blocks: x, or up to (x, y, z).
        block: Threads of a block: x, or up to (x, y, z).
        args: The kernel's arguments in order; see above.
    """
    grid, block = _three(grid), _three(block)
    if 0 in grid:
        return
    values = [_argument(arg) for arg in args]
    with on_device_of(next((arg for arg in args if isinstance(arg, Tensor)), None)):
        backend().launch(program, name, grid, block, values)


def launch_each(program: Program, name: str, count: int, args: Sequence[Any], threads: int = BLOCK) -> None:
    """Start a kernel for ``count`` items, one a thread, ``threads`` in a block."""
    launch(program, name, blocks(count, threads), threads, args)


def on_device_of(tensor: Tensor | None) -> AbstractContextManager[Any]:
    """Within the block, launches go to the tensor's device; ``launch`` does so by itself for those that it is given."""
    if tensor is None or not tensor.is_cuda or tensor.device.index == torch.cuda.current_device():
        return _NOWHERE_ELSE
    return torch.cuda.device(tensor.device)


def blocks(count: int, size: int) -> int:
    """Number of blocks of ``size`` that hold ``count`` items."""
    return -(-count // size)


def upload(values: Sequence[float], device: torch.device) -> Tensor:
    """(N,) float32 on ``device``. The copy is queued like a kernel; torch keeps the pinned memory until it is done."""
    return torch.tensor(values, dtype=torch.float32, pin_memory=device.type == "cuda").to(device, non_blocking=True)


def _three(dim: Dim) -> tuple[int, int, int]:
    if isinstance(dim, int):
        return dim, 1, 1
    return (*dim, 1, 1)[:3]  # type: ignore[return-value]


def _argument(value: Any) -> Any:
    convert = _CONVERSIONS.get(type(value))
    if convert is not None:
        return convert(value)
    return _pointer(value) if isinstance(value, Tensor) else value


def _pointer(tensor: Tensor) -> ctypes.c_void_p:
    assert tensor.is_contiguous(), "kernels get contiguous tensors only"
    return ctypes.c_void_p(tensor.data_ptr())


def _int(value: int) -> ctypes.c_int32:
    if not -(2**31) <= value < 2**31:
        raise ValueError(f"{value} does not fit into an int: pass ctypes.c_int64")
    return ctypes.c_int32(value)


_CONVERSIONS: dict[type, Any] = {
    type(None): ctypes.c_void_p,
    Tensor: _pointer,
    bool: ctypes.c_bool,
    int: _int,
    float: ctypes.c_float,
}
