"""A driver without a GPU: cuda-bindings finds these functions under the driver's name; launches run on the shim.

What a driver checks is checked: handles, the context of the calling thread, sizes of grids and blocks, and what must
not be done while a stream is captured. Streams and graphs of torch, which has none on the CPU, stand beside it and tell
it of captures.
"""

import ctypes
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import takewhile
from typing import Any

import pytest
import torch

from etsplat.engines.cuda import device as device_module
from etsplat.engines.cuda.program import Program
from helpers.simt.build import HERE, Simt, host_library
from helpers.simt.calls import Recording

SUCCESS, INVALID_VALUE, OUT_OF_MEMORY, INVALID_CONTEXT, INVALID_HANDLE = 0, 1, 2, 201, 400
UNSUPPORTED_PTX, ILLEGAL_ADDRESS, CAPTURE_UNSUPPORTED, CAPTURE_IMPLICIT = 222, 700, 900, 906
_POINTER, _INT, _UINT, _STRING = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint, ctypes.c_char_p
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "cuDriverGetVersion": (ctypes.POINTER(_INT),),
    "cuDevicePrimaryCtxRetain": (ctypes.POINTER(_POINTER), _INT),
    "cuCtxSetCurrent": (_POINTER,),
    "cuModuleLoadData": (ctypes.POINTER(_POINTER), _STRING),
    "cuModuleGetFunction": (ctypes.POINTER(_POINTER), _POINTER, _STRING),
    "cuLaunchKernel": (_POINTER, *[_UINT] * 7, _POINTER, ctypes.POINTER(_POINTER), _POINTER),
}


class Driver:
    """What the driver knows, and what was called: `calls` counts by name, `events` has launches and waits in order."""

    def __init__(self) -> None:
        self.version = 13000
        self.calls: Counter[str] = Counter()
        self.events: list[str] = []
        self.recording: Recording | None = None
        self.captured_stream: int | None = None
        self.images: dict[bytes, Program] = {}
        """Programs by what is loaded for them."""
        self.problems: list[str] = []
        """What the shim says of kernels."""
        self._failures: dict[str, int] = {}
        self._contexts = threading.local()
        self._objects: dict[int, Any] = {}
        self._simt = Simt()

    def fail(self, function: str, status: int) -> None:
        """Every call of the function returns this, until it is 0."""
        self._failures[function] = status

    def call(self, function: str, *arguments: Any) -> int:
        """What a function of the driver returns."""
        self.calls[function] += 1
        return self._failures.get(function) or getattr(self, f"_{function}")(*arguments)

    def _handle(self, value: Any) -> int:
        handle = 0x1000 + 16 * len(self._objects)
        self._objects[handle] = value
        return handle

    def _cuDriverGetVersion(self, version: Any) -> int:  # noqa: N802
        version[0] = self.version
        return SUCCESS

    def _cuDevicePrimaryCtxRetain(self, context: Any, device: int) -> int:  # noqa: N802
        context[0] = self._handle(f"context of {device}")
        return SUCCESS

    def _cuCtxSetCurrent(self, context: int | None) -> int:  # noqa: N802
        if not str(self._objects.get(context or 0)).startswith("context"):
            return INVALID_CONTEXT
        self._contexts.current = context
        return SUCCESS

    def _cuModuleLoadData(self, module: Any, image: bytes) -> int:  # noqa: N802
        if getattr(self._contexts, "current", None) is None:
            return INVALID_CONTEXT
        if self.captured_stream is not None:
            return CAPTURE_UNSUPPORTED
        if image not in self.images:
            return INVALID_VALUE
        module[0] = self._handle(self.images[image])
        return SUCCESS

    def _cuModuleGetFunction(self, function: Any, module: int, name: bytes) -> int:  # noqa: N802
        program = self._objects.get(module)
        if not isinstance(program, Program):
            return INVALID_HANDLE
        function[0] = self._handle((program, name.decode()))
        return SUCCESS

    def _cuLaunchKernel(self, function: int, *rest: Any) -> int:  # noqa: N802
        *sizes, shared, stream, arguments, _ = rest
        grid, block = sizes[:3], sizes[3:]
        if getattr(self._contexts, "current", None) is None:
            return INVALID_CONTEXT
        if not isinstance(self._objects.get(function), tuple):
            return INVALID_HANDLE
        if 0 in sizes or max(*grid[1:], 0) > 65535 or block[0] * block[1] * block[2] > 1024 or shared:
            return INVALID_VALUE
        if self.captured_stream is not None and not stream:
            return CAPTURE_IMPLICIT
        program, name = self._objects[function]
        kernels = self._simt.library(program)
        parameters = (ctypes.c_uint * 64).in_dll(kernels, f"simt_parameters_{name}")
        # Whoever launches may change the arguments afterwards: a graph keeps what they were.
        kept = [
            ctypes.create_string_buffer(ctypes.string_at(arguments[i], size))
            for i, size in enumerate(takewhile(bool, parameters))
        ]
        self.events.append(f"{name} on {stream or 0}")

        def launch() -> None:
            pointers = (ctypes.c_void_p * len(kept))(*map(ctypes.addressof, kept))
            start = getattr(kernels, f"simt_launch_{name}")
            start.restype = ctypes.c_char_p
            failure = start((ctypes.c_uint * 3)(*grid), (ctypes.c_uint * 3)(*block), pointers, 0)
            if failure is not None:
                self.problems.append(f"{name}: {failure.decode()}")

        launch()
        if self.recording is not None and stream == self.captured_stream:
            self.recording.steps.append(launch)
        return SUCCESS


_active: Driver | None = None


@cache
def _loaded() -> list[Any]:
    """The library, and what it points to: as long as the process lives, as cuda-bindings looks functions up once."""

    def function(name: str) -> Any:
        def answer(*arguments: Any) -> int:
            return _active.call(name, *arguments) if _active else 100  # CUDA_ERROR_NO_DEVICE

        return ctypes.CFUNCTYPE(_INT, *_SIGNATURES[name])(answer)

    functions = {name.encode(): function(name) for name in _SIGNATURES}

    @ctypes.CFUNCTYPE(_POINTER, _STRING)
    def resolve(symbol: bytes) -> int | None:
        found = functions.get(symbol)
        return None if found is None else ctypes.cast(found, _POINTER).value

    path = host_library((HERE / "libcuda.cpp").read_text(), "libcuda.so.1")
    library = ctypes.CDLL(str(path), ctypes.RTLD_GLOBAL)
    _POINTER.in_dll(library, "resolve").value = ctypes.cast(resolve, _POINTER).value
    return [library, functions, resolve]


class Streams:
    """torch's streams and graphs, as far as the engine uses them; the names of `torch.cuda`, in its place."""

    capability = 9, 0

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._current = self._made = Stream(driver, 0)
        self._streams = 0
        self.graphs: list[Graph] = []

    def patch(self, patch: pytest.MonkeyPatch) -> None:
        """Put these in the place of torch's."""
        names = ("current_device", "current_stream", "get_device_capability", "stream", "Stream", "CUDAGraph")
        for name in (*names, "graph_pool_handle", "is_current_stream_capturing", "empty_cache", "synchronize"):
            patch.setattr(torch.cuda, name, getattr(self, name))

    def current_device(self) -> int:
        return 0

    def current_stream(self, device: Any = None) -> "Stream":
        return self._current

    def get_device_capability(self, device: Any = None) -> tuple[int, int]:
        return self.capability

    def Stream(self, device: Any = None) -> "Stream":  # noqa: N802
        self._streams += 1
        return Stream(self._driver, self._streams)

    @contextmanager
    def stream(self, stream: "Stream") -> Iterator[None]:
        before, self._current = self._current, stream
        try:
            yield
        finally:
            self._current = before

    def CUDAGraph(self) -> "Graph":  # noqa: N802
        self.graphs.append(Graph(self._driver, self))
        return self.graphs[-1]

    def graph_pool_handle(self) -> tuple[int, int]:
        return 0, 1

    def is_current_stream_capturing(self) -> bool:
        return self._driver.captured_stream == self._current.cuda_stream != 0

    def empty_cache(self) -> None:
        self._driver.events.append("caches emptied")

    def synchronize(self, device: Any = None) -> None:
        self._driver.events.append("waited")


class Stream:
    """A stream's handle; who waits for whom goes to the events."""

    def __init__(self, driver: Driver, number: int) -> None:
        self._driver = driver
        self.cuda_stream = number

    def wait_stream(self, other: "Stream") -> None:
        self._driver.events.append(f"{self.cuda_stream} waits for {other.cuda_stream}")


class Graph:
    """Records what is queued. As torch of the CPU cannot but do it at once, the first replay has been made already."""

    def __init__(self, driver: Driver, streams: Streams) -> None:
        self._driver, self._streams = driver, streams
        self._recording = Recording()
        self.replays = 0

    def capture_begin(self, pool: Any = None, capture_error_mode: str = "global") -> None:
        stream = self._streams.current_stream().cuda_stream
        if stream == 0 or self._driver.captured_stream is not None:
            raise RuntimeError("a capture wants a stream of its own")
        self._driver.events.append(f"capture of {stream} begins")
        self._driver.captured_stream, self._driver.recording = stream, self._recording
        self._recording.__enter__()

    def capture_end(self) -> None:
        self._recording.__exit__(None, None, None)
        self._driver.events.append(f"capture of {self._driver.captured_stream} ends")
        self._driver.captured_stream = self._driver.recording = None

    def replay(self) -> None:
        self.replays += 1
        if self.replays > 1:
            self._recording.replay()


@contextmanager
def device_without_gpu(driver: Driver, streams: Streams) -> Iterator[device_module.Device]:
    """The backend that runs kernels on GPUs, on this driver; its tensors are the CPU's."""
    global _active

    def compiled(program: Program, architecture: str) -> bytes:
        image = f"{program} {program.contract} {hash(program.source)} {architecture}".encode()
        driver.images[image] = program
        return image

    _loaded()
    _active = driver
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(device_module, "compile_program", compiled)
            patch.setattr(device_module.Device, "device_type", "cpu")
            streams.patch(patch)
            with pytest.MonkeyPatch.context() as present:
                present.setattr(torch, "__version__", "2.13.0+cu130")
                present.setattr(torch.version, "cuda", "13.0")
                present.setattr(torch.cuda, "is_available", lambda: True)
                backend = device_module.Device()
            yield backend
    finally:
        _active = None
