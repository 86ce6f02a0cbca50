"""Which engine runs an operation: by the tensors, or `with etsplat.engine(name)`; and where a task runs."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

from etsplat.core.errors import EngineUnavailableError, InputError
from etsplat.engines.cpu.engine import CpuEngine
from etsplat.engines.cuda.engine import CudaEngine
from etsplat.engines.cuda.steps import CudaQueuedSteps
from etsplat.engines.engine import Engine
from etsplat.engines.webgpu.engine import WebGpuEngine

_REFERENCE = Engine()
_BUILT_IN: dict[str, Engine] = {own.name: own for own in (_REFERENCE, CpuEngine(), CudaEngine(), WebGpuEngine())}
_engines = dict(_BUILT_IN)
_chosen: ContextVar[Engine | None] = ContextVar("etsplat.engine", default=None)


def register_engine(engine: Engine) -> None:
    """Make an engine known by its name, in the place of one of yours that had it.

    It is then what `with etsplat.engine(name)` chooses; and if it has a device of its own that no earlier one has, it
    runs what is on such a device in float32.

    Raises:
        ValueError: it is no `Engine`, or has the name of one that is built in.

    Example:
        >>> from etsplat.engines.engine import Engine
        >>> class Doubled(Engine):  # what it does not have itself it has from "reference"
        ...     name = "doubled"
        ...
        ...     @staticmethod
        ...     def photometric_loss(*arguments):
        ...         return 2 * Engine.photometric_loss(*arguments)
        >>> etsplat.register_engine(Doubled())
        >>> with etsplat.engine("doubled"):
        ...     float(etsplat.photometric_loss(torch.zeros(1, 8, 8, 3), torch.ones(1, 8, 8, 3), 0.0))
        2.0
    """
    if not isinstance(engine, Engine):
        raise ValueError(f"engine must be an Engine, got {type(engine).__name__}")
    if engine.name in _BUILT_IN:
        raise ValueError(f"engine must have a name of its own, got {engine.name!r}, which is built in")
    _engines[engine.name] = engine


def engine_names() -> tuple[str, ...]:
    """Of all engines that are registered."""
    return tuple(_engines)


def training_engines() -> tuple[str, ...]:
    """Names of those that have gradients."""
    return tuple(name for name, engine in _engines.items() if engine.differentiates)


@contextmanager
def engine(name: str | None) -> Iterator[None]:
    """Within the block operations run on this engine, as in `with etsplat.engine("reference"):`.

    Blocks can be nested; each thread has its own choice. What was computed within keeps its engine for the backward
    pass, wherever that runs.

    Args:
        name: "reference" (plain PyTorch, any precision), "cpu" or "cuda" (native, float32), "webgpu" (draws on any
            GPU, without gradients), or another one that is registered. None leaves the choice as it is around the
            block: where nobody has chosen, cpu or cuda for float32, by the tensors' device, and reference for
            everything else.

    Raises:
        ValueError: There is no such engine.

    Example:
        >>> with etsplat.engine("reference"):
        ...     loss = etsplat.photometric_loss(torch.zeros(1, 8, 8, 3), torch.ones(1, 8, 8, 3), 0.0)
        >>> float(loss)
        1.0
    """
    token = _chosen.set(_chosen.get() if name is None else _named(name))
    try:
        yield
    finally:
        _chosen.reset(token)


def engine_for(tensor: Tensor) -> Engine:
    """The engine for an operation on `tensor`, whose device and dtype decide where nobody has chosen.

    Raises:
        ValueError: The dtype is neither float32 nor float64, or the chosen engine does not compute with such tensors.
    """
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"tensors must be float32 or float64, got {tensor.dtype}")
    chosen = _chosen.get()
    if chosen is not None:
        chosen.check(tensor)
        return chosen
    own = (e for e in _engines.values() if e.device == tensor.device.type and tensor.dtype == torch.float32)
    return next(own, _REFERENCE)


def queued_steps(tensor: Tensor) -> CudaQueuedSteps:
    """How steps are queued on the engine for `tensor`.

    Raises:
        ValueError: They are not.
    """
    engine = engine_for(tensor)
    if engine.queued is None:
        raise ValueError(f"engine {engine.name} queues no steps")
    return engine.queued


def resolve_device(device: str | None, name: str | None) -> torch.device:
    """Where a task runs.

    Args:
        device: "cpu", "cuda", or None: where the engine computes; if that is None too, on a GPU if there is one that
            an engine can use. Where there is one that it cannot use, a line says why.
        name: of the engine, or None.

    Raises:
        EngineUnavailableError: It needs a GPU, and something is missing; the message says what.
        InputError: `device` and the engine exclude each other.
    """
    chosen = None if name is None else _named(name)
    if chosen is not None and device is not None and not chosen.computes_on(device):
        raise InputError(f"engine: {name} does not compute on device {device}; leave one of them out")
    if device is not None:
        own = (e for e in _engines.values() if e.device == device)
        return next(own, _REFERENCE).home()
    if chosen is not None:
        return chosen.home()
    for candidate in reversed(_engines.values()):
        if candidate.device is not None and torch.get_device_module(candidate.device).is_available():
            try:
                return candidate.home()
            except EngineUnavailableError as error:
                print(f"computing on the CPU: {error}", file=sys.stderr)
    return _REFERENCE.home()


def _named(name: str) -> Engine:
    if name not in _engines:
        raise ValueError(f"engine must be one of {', '.join(_engines)} or None, got {name!r}")
    return _engines[name]
