"""The backend that runs kernels on NVIDIA GPUs, by the driver's own interface (cuda-bindings)."""

import ctypes
import gc
import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import torch

from etsplat.core.errors import EngineUnavailableError
from etsplat.engines.cuda.compile import (
    INSTALL,
    OLDER_INSTALL,
    compile_program,
    import_nvrtc,
    nvrtc_version,
    target_architecture,
)
from etsplat.engines.cuda.program import Program

OLDEST_TORCH = (2, 11)
_EARLIER = "of this kernel or of an earlier one: CUDA_LAUNCH_BLOCKING=1 shows of which"
_HINTS = {
    "CUDA_ERROR_UNSUPPORTED_PTX_VERSION": "the driver is older than NVRTC, and the GPU newer: update the driver",
    "CUDA_ERROR_NO_BINARY_FOR_GPU": "NVRTC does not know this GPU: update it",
    "CUDA_ERROR_ILLEGAL_ADDRESS": _EARLIER,
    "CUDA_ERROR_MISALIGNED_ADDRESS": _EARLIER,
    "CUDA_ERROR_LAUNCH_FAILED": _EARLIER,
}


class Device:
    """Launches on torch's current stream of its current device; compiles and loads at first use, per device."""

    device_type = "cuda"

    def __init__(self) -> None:
        check_torch()
        self._driver = _import_driver()
        check_driver(self._driver)
        self._architectures: dict[int, str] = {}
        self._capture_streams: dict[int, torch.cuda.Stream] = {}
        self._contexts: dict[int, Any] = {}
        self._modules: dict[tuple[int, Program], Any] = {}
        self._functions: dict[tuple[int, Program, str], Any] = {}

    def launch(
        self,
        program: Program,
        name: str,
        grid: tuple[int, int, int],
        block: tuple[int, int, int],
        values: Sequence[Any],
    ) -> None:
        """Run kernel ``name``; ``values`` are its arguments as ctypes values, which may change afterwards.

        Raises:
            torch.OutOfMemoryError: The GPU has no room for the kernel.
            RuntimeError: The driver refuses, or an earlier kernel failed.
        """
        device = torch.cuda.current_device()
        function = self._functions.get((device, program, name))
        if function is None:
            function = self._function(device, program, name)
        stream = torch.cuda.current_stream(device).cuda_stream
        driver, pointers = self._driver, pointers_to(values)
        arguments = (function, *grid, *block, 0, stream, ctypes.addressof(pointers), 0)
        (status,) = driver.cuLaunchKernel(*arguments)
        if status == driver.CUresult.CUDA_ERROR_INVALID_CONTEXT:
            self._enter_context(device)
            (status,) = driver.cuLaunchKernel(*arguments)
        if status != driver.CUresult.CUDA_SUCCESS:
            raise _failure(status, f"launch of {name} ({program})")

    def capture(self, body: Callable[[], None], pool: Any) -> Callable[[], None]:
        """Do what ``body`` queues, once, and return what does it again without calling it: a CUDA graph.

        ``pool`` is from ``memory_pool``; see ``etsplat.engines.cuda.steps.Repeated``.
        """
        try:
            graph = self._captured(body, pool)
        except torch.OutOfMemoryError:
            graph = None
        if graph is None:  # what torch keeps of memory that is free cannot be given back within a capture
            torch.cuda.empty_cache()
            graph = self._captured(body, pool)
        graph.replay()
        return graph.replay

    def warm_up(self, body: Callable[[], None]) -> None:
        """Do what ``body`` queues on the stream of captures: what is made once for a stream is made for theirs."""
        with self._capture_stream():
            body()

    def memory_pool(self) -> Any:
        """Memory that captures can share."""
        return torch.cuda.graph_pool_handle()

    @property
    def capturing(self) -> bool:
        """Whether a capture is under way, also by others: nothing can be read back then."""
        return torch.cuda.is_current_stream_capturing()

    def _captured(self, body: Callable[[], None], pool: Any) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        with self._capture_stream(), _no_collection():
            # Threads that bring photos may allocate meanwhile.
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                body()
            except BaseException:
                with suppress(RuntimeError):  # which would hide the first
                    graph.capture_end()
                raise
            graph.capture_end()
        return graph

    @contextmanager
    def _capture_stream(self) -> Iterator[None]:
        """Within, work goes to the stream of captures: after what was queued before, and before what comes next."""
        device = torch.cuda.current_device()
        if device not in self._capture_streams:
            self._capture_streams[device] = torch.cuda.Stream(device)
        own, current = self._capture_streams[device], torch.cuda.current_stream(device)
        own.wait_stream(current)
        try:
            with torch.cuda.stream(own):
                yield
        finally:
            current.wait_stream(own)

    def _enter_context(self, device: int) -> None:
        """Make torch's context current in this thread: in those of autograd it may not be so yet."""
        if device not in self._contexts:
            self._contexts[device] = self._checked(self._driver.cuDevicePrimaryCtxRetain(device), "context")
        (status,) = self._driver.cuCtxSetCurrent(self._contexts[device])
        if status != self._driver.CUresult.CUDA_SUCCESS:
            raise _failure(status, f"context of device {device}")

    def _function(self, device: int, program: Program, name: str) -> Any:
        self._enter_context(device)
        module = self._modules.get((device, program))
        if module is None:
            if device not in self._architectures:
                self._architectures[device] = target_architecture(*torch.cuda.get_device_capability(device))
            code = compile_program(program, self._architectures[device])
            module = self._checked(self._driver.cuModuleLoadData(code), program)
            self._modules[device, program] = module
        function = self._checked(self._driver.cuModuleGetFunction(module, name.encode()), program)
        self._functions[device, program, name] = function
        return function

    def _checked(self, result: tuple[Any, ...], what: Program | str) -> Any:
        status, value = result
        if status != self._driver.CUresult.CUDA_SUCCESS:
            raise _failure(status, str(what))
        return value


@contextmanager
def _no_collection() -> Iterator[None]:
    """Within, garbage stays: to destroy a graph that is among it would make a capture of this thread invalid."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _failure(status: Any, what: str) -> RuntimeError:
    """The error of a call of the driver."""
    if status.name == "CUDA_ERROR_OUT_OF_MEMORY":
        return torch.OutOfMemoryError(f"{what}: the GPU has no memory left")
    hint = _HINTS.get(status.name)
    return RuntimeError(f"{what}: {status.name}" + (f" ({hint})" if hint else ""))


def pointers_to(values: Sequence[Any]) -> Any:
    """What drivers want of arguments: a ctypes array of pointers to them."""
    return (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))


def check_torch() -> None:
    """Raise ``EngineUnavailableError`` unless this torch can use a GPU."""
    version = torch.__version__
    if tuple(int(part) for part in version.split("+")[0].split(".")[:2]) < OLDEST_TORCH:
        raise EngineUnavailableError(
            f"the GPU engine needs torch {'.'.join(map(str, OLDEST_TORCH))} or newer, found {version}: upgrade torch, "
            "or compute on the CPU"
        )
    if torch.version.cuda is None:
        raise EngineUnavailableError(
            f"torch {version} is built without CUDA: install a CUDA build of torch (https://pytorch.org), "
            "or compute on the CPU"
        )
    if not torch.cuda.is_available():
        raise EngineUnavailableError(
            f"torch {version} finds no usable GPU: check that nvidia-smi works and that its driver supports CUDA "
            f"{torch.version.cuda}, or compute on the CPU"
        )


def _import_driver() -> Any:
    try:
        return importlib.import_module("cuda.bindings.driver")
    except ImportError as error:
        raise EngineUnavailableError(f"the GPU engine needs cuda-bindings, which is missing: {INSTALL}") from error


def check_driver(driver: Any) -> None:
    """Raise ``EngineUnavailableError`` if the driver cannot run what NVRTC compiles."""
    status, number = driver.cuDriverGetVersion()
    if status != driver.CUresult.CUDA_SUCCESS:
        raise EngineUnavailableError(f"the NVIDIA driver does not answer ({status.name}): reinstall it")
    major, minor = nvrtc_version(import_nvrtc())
    if number // 1000 < major:
        raise EngineUnavailableError(
            f"the NVIDIA driver supports CUDA {number // 1000}.{number % 1000 // 10} and the kernels are compiled by "
            f"NVRTC {major}.{minor}: update the driver, or install torch for the older CUDA and {OLDER_INSTALL}"
        )
