"""A GPU by WebGPU: the adapter, programs made of the shaders beside this file, buffers, and work that is sent to it."""

import contextlib
import importlib
import math
import re
import threading
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from etsplat.core.errors import EngineUnavailableError, InputError

INSTALL = "pip install 'etsplat[webgpu]'"
_SHADERS = Path(__file__).parent / "shaders"
_BINDING = re.compile(r"@binding\((\d+)\) var<[^>]*> (\w+)")
_MOST_GROUPS = 65535  # along an axis, everywhere
_LEAST = 256  # bytes of a buffer: an element of any array


class Program(NamedTuple):
    """A shader: files of `shaders/` one after the other, below the definitions that specialise it."""

    files: tuple[str, ...]
    constants: tuple[tuple[str, str], ...] = ()

    @property
    def source(self) -> str:
        """Its text."""
        defined = "".join(f"const {name} = {value};\n" for name, value in self.constants)
        return defined + "".join((_SHADERS / f"{name}.wgsl").read_text(encoding="utf-8") for name in self.files)


class Step(NamedTuple):
    """One entry of a program, over so many workgroups, on buffers by the names that its shader has for them."""

    program: Program
    entry: str
    groups: tuple[int, int]
    buffers: dict[str, Any]


class WebGpu:
    """The adapter that the system takes for its fastest; used by one thread at a time, which holds `lock`.

    Attributes:
        name: of the adapter, its driver and the programming interface below, in words.
        most_bytes: that a shader can be given in one buffer.
    """

    def __init__(self) -> None:
        """Opens it.

        Raises:
            EngineUnavailableError: wgpu is not installed, or finds no adapter.
        """
        try:
            wgpu = importlib.import_module("wgpu")
        except ImportError as error:
            raise EngineUnavailableError(f"engine webgpu needs wgpu (Python 3.11 or newer): {INSTALL}") from error
        adapter = _adapter(wgpu)
        info = adapter.info
        self.name = ", ".join(part for part in (info["device"], info["description"], info["backend_type"]) if part)
        wanted = ("max-storage-buffer-binding-size", "max-buffer-size")
        limits = {name: adapter.limits[name] for name in wanted}
        self.most_bytes = min(limits.values())
        self.lock = threading.Lock()
        self._usage = wgpu.BufferUsage
        self._device = adapter.request_device_sync(required_limits=limits)
        self._buffers: dict[str, Any] = {}
        self._modules: dict[Program, tuple[Any, dict[str, int]]] = {}
        self._pipelines: dict[tuple[Program, str], Any] = {}

    @property
    def held_bytes(self) -> int:
        """Of all buffers."""
        return sum(buffer.size for buffer in self._buffers.values())

    def room(self, name: str, size: int) -> Any:
        """A buffer of at least so many bytes, kept from one picture to the next; what is in it is anything.

        Raises:
            InputError: it is larger than the adapter takes.
        """
        buffer = self._buffers.get(name)
        if buffer is not None and buffer.size >= size:
            return buffer
        if size > self.most_bytes:
            raise InputError(
                f"engine webgpu: this picture needs {size:,} bytes in one buffer and {self.name} takes "
                f"{self.most_bytes:,}; draw fewer triangles or a smaller picture, or use engine cpu"
            )
        usage = self._usage.STORAGE | self._usage.COPY_DST | self._usage.COPY_SRC | self._usage.UNIFORM
        size = max(_LEAST, 4 * math.ceil(size / 4))
        self._buffers[name] = buffer = self._device.create_buffer(size=size, usage=usage)
        return buffer

    def filled(self, name: str, values: "np.ndarray[Any, Any] | bytes") -> Any:
        """A buffer that begins with these values."""
        size = len(values) if isinstance(values, bytes) else values.nbytes
        buffer = self.room(name, size)
        if size:
            self._device.queue.write_buffer(buffer, 0, values)
        return buffer

    def read(self, buffer: Any, kind: Any, count: int, offset: int = 0) -> "np.ndarray[Any, Any]":
        """So many numbers of a buffer from a byte on, once the work before is done."""
        size = np.dtype(kind).itemsize * count
        if size == 0:
            return np.empty(0, kind)
        return np.frombuffer(self._device.queue.read_buffer(buffer, offset, size), kind)

    def run(self, steps: list[Step], zeroed: dict[str, int] | None = None) -> None:
        """Send steps to the device, one after the other; the first bytes of buffers by name are zeroed before."""
        encoder = self._device.create_command_encoder()
        for name, size in (zeroed or {}).items():
            encoder.clear_buffer(self._buffers[name], 0, 4 * math.ceil(size / 4))
        work = encoder.begin_compute_pass()
        for step in steps:
            pipeline = self._pipeline(step.program, step.entry)
            bindings = self._modules[step.program][1]
            entries = [
                {"binding": bindings[name], "resource": _resource(given)} for name, given in step.buffers.items()
            ]
            layout = pipeline.get_bind_group_layout(0)
            work.set_pipeline(pipeline)
            work.set_bind_group(0, self._device.create_bind_group(layout=layout, entries=entries))
            work.dispatch_workgroups(*step.groups)
        work.end()
        self._device.queue.submit([encoder.finish()])

    def _pipeline(self, program: Program, entry: str) -> Any:
        if program not in self._modules:
            source = program.source
            names = {name: int(number) for number, name in _BINDING.findall(source)}
            self._modules[program] = self._device.create_shader_module(code=source), names
        key = (program, entry)
        if key not in self._pipelines:
            compute = {"module": self._modules[program][0], "entry_point": entry}
            self._pipelines[key] = self._device.create_compute_pipeline(layout="auto", compute=compute)
        return self._pipelines[key]


class Part(NamedTuple):
    """Some bytes of a buffer."""

    buffer: Any
    offset: int
    size: int


def _resource(given: Any) -> dict[str, Any]:
    if isinstance(given, Part):
        return given._asdict()
    return {"buffer": given, "offset": 0, "size": given.size}


def spread(groups: int) -> tuple[int, int]:
    """At least so many workgroups, over two axes where one does not hold them; shaders number them by `linear`."""
    rows = max(1, math.ceil(groups / _MOST_GROUPS))
    return math.ceil(groups / rows), rows


@cache
def gpu() -> WebGpu:
    """The one of this process.

    Raises:
        EngineUnavailableError: There is none.
    """
    return WebGpu()


def _adapter(wgpu: Any) -> Any:
    extras = importlib.import_module("wgpu.backends.wgpu_native.extras")
    with contextlib.suppress(RuntimeError):  # who has used wgpu in this process before has chosen
        extras.set_instance_extras(backends=["Primary"])
    try:
        return wgpu.gpu.request_adapter_sync(power_preference="high-performance")
    except RuntimeError as error:
        raise EngineUnavailableError(
            "engine webgpu found no GPU with Vulkan, Metal or DirectX 12; install its driver, or use engine cpu"
        ) from error
