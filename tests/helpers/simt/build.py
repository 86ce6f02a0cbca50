"""Kernels as CPU programs: each compiled with simt.h into a shared library, run on CPU tensors by ctypes.

What is compiled is their source or the PTX that NVRTC makes of it.
"""

import ctypes
import hashlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch

from etsplat.engines.cuda.compile import compile_without_cache, program_key
from etsplat.engines.cuda.device import pointers_to
from etsplat.engines.cuda.program import Program
from helpers.simt import ptx
from helpers.simt.calls import Recording

HERE = Path(__file__).resolve().parent
FOLDER = HERE.parent.parent.parent / "build" / "simt"
_KERNEL = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\(')
FLAGS = ["-std=c++20", "-O1", "-g1", "-fPIC", "-shared", "-ffp-contract=off", "-fno-gnu-unique", "-fvisibility=hidden"]
FLAGS += ["-Wall", "-Wextra", "-Wno-unknown-pragmas", "-Wno-unused-function", "-Wno-unused-parameter"]
# always_inline into sanitized or unoptimised code takes minutes
# Of PTX. Where it has no instruction for it, fmaf is a call of libm, which is as exact.
PTX_FLAGS = ["-fno-strict-aliasing", "-Wno-unused-label", "-Wno-unused-variable", "-Wno-unused-but-set-variable"]
PTX_FLAGS += ["-mfma"] if torch.backends.cpu.get_cpu_capability().startswith("AVX") else []
SANITIZE = ["-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-DETSPLAT_SANITIZE"]
# One instance of what is shared by all libraries (races.h) is what -fno-gnu-unique would prevent.
RACES = ["-fsanitize=thread", "--param=tsan-distinguish-volatile=1", "-fgnu-unique", "-DETSPLAT_SANITIZE"]


class Simt:
    """In the place of ``etsplat.engines.cuda.device.Device``: runs kernels in this process, on CPU tensors."""

    device_type = "cpu"
    architecture: str | None = None
    """Of the PTX that is run, such as "compute_75"; None for the sources (``pytest --ptx`` sets it for all)."""

    def __init__(self, order_seed: int = 0) -> None:
        self.order_seed = order_seed
        self.launches: list[str] = []
        self._recording: Recording | None = None

    @property
    def capturing(self) -> bool:
        return self._recording is not None

    def memory_pool(self) -> None:
        """Recordings keep what they use."""

    def warm_up(self, body: Callable[[], None]) -> None:
        """As any call."""
        body()

    def capture(self, body: Callable[[], None], pool: None) -> Callable[[], None]:
        """Records the launches and the operations of torch, on the memory that they had, while the body runs."""
        with Recording() as self._recording:
            try:
                body()
            finally:
                recording, self._recording = self._recording, None
        return recording.replay

    def launch(
        self,
        program: Program,
        name: str,
        grid: tuple[int, int, int],
        block: tuple[int, int, int],
        values: Sequence[Any],
    ) -> None:
        if self._recording is not None:
            kept = [type(value).from_buffer_copy(value) for value in values]
            self._recording.steps.append(lambda: self.launch(program, name, grid, block, kept))
        self.launches.append(name)
        failure = run(self.library(program), name, grid, block, values, self.order_seed)
        if failure is not None:
            raise RuntimeError(f"{name} ({program}): {failure}")

    def library(self, program: Program) -> ctypes.CDLL:
        """What holds the program's kernels."""
        return library(program.source) if self.architecture is None else ptx_library(program, self.architecture)


def run(
    kernels: ctypes.CDLL, name: str, grid: Sequence[int], block: Sequence[int], values: Sequence[Any], seed: int = 0
) -> str | None:
    """Launches a kernel; what went wrong, or None."""
    given = [ctypes.sizeof(value) for value in values]
    expected = list(takewhile(bool, (ctypes.c_uint * (len(values) + 1)).in_dll(kernels, f"simt_parameters_{name}")))
    if given != expected:
        return f"the arguments have {given} bytes, the parameters {expected}"
    launch = getattr(kernels, f"simt_launch_{name}")
    launch.restype = ctypes.c_char_p
    failure = launch((ctypes.c_uint * 3)(*grid), (ctypes.c_uint * 3)(*block), pointers_to(values), seed)
    return None if failure is None else failure.decode()


def sanitized() -> bool:
    """Whether this process has AddressSanitizer loaded, as ``make sanitize`` runs it."""
    return "libasan" in os.environ.get("LD_PRELOAD", "")


def watched() -> bool:
    """Whether this process has ThreadSanitizer loaded, as ``make races`` runs it."""
    return "libtsan" in os.environ.get("LD_PRELOAD", "")


class Races:
    """The reports of ThreadSanitizer in this process, which it writes to the path in its options."""

    def __init__(self) -> None:
        path = re.search(r"log_path=(\S+)", os.environ["TSAN_OPTIONS"])
        assert path, "TSAN_OPTIONS has no log_path"
        self._file = Path(f"{path[1]}.{os.getpid()}")
        self._read = 0
        self.new()

    def new(self) -> list[str]:
        """Those since this was asked last, a line each: what raced."""
        text = self._file.read_text(errors="replace") if self._file.exists() else ""
        new, self._read = text[self._read :], len(text)
        return re.findall(r"^SUMMARY: ThreadSanitizer: (.*)$", new, re.MULTILINE)


@cache
def library(source: str, extra_flags: tuple[str, ...] = ()) -> ctypes.CDLL:
    """The shared library of a CUDA source, from build/simt if it is there."""
    exports = "".join(f"SIMT_EXPORT({name})\n" for name in _KERNEL.findall(source))
    text = f'#include "simt.h"\n{source}\n#line 1 "exports"\n{exports}'
    flags = (*FLAGS, *(SANITIZE if sanitized() else RACES if watched() else []), *extra_flags, f"-I{HERE}")
    path = FOLDER / f"{_digest(text, *flags)}.so"
    if not path.is_file():
        _compile(text, "kernel.cpp", [f"-I{_precompiled_shim(flags)}", *flags], path)
    return ctypes.CDLL(str(path))


@cache
def ptx_library(program: Program, architecture: str) -> ctypes.CDLL:
    """The same of the PTX for a virtual architecture."""
    flags = (*FLAGS, *PTX_FLAGS, f"-I{HERE}")
    path = FOLDER / f"{_digest(program_key(program, architecture), *flags)}.so"
    if not path.is_file():
        text = ptx.translate(compile_without_cache(program, architecture).decode())
        _compile(text, "kernel.cpp", [f"-I{_precompiled_shim(flags)}", *flags], path)
    return ctypes.CDLL(str(path))


@cache
def host_library(source: str, name: str) -> Path:
    """C++ that needs no shim, compiled to a library that other libraries know by this name."""
    path = FOLDER / f"{_digest(source, name)}.so"
    if not path.is_file():
        _compile(source, "library.cpp", ["-std=c++20", "-fPIC", "-shared", f"-Wl,-soname,{name}"], path)
    return path


@cache
def _precompiled_shim(flags: tuple[str, ...]) -> Path:
    """A folder in which g++ finds simt.h compiled: half of the time that a kernel would take."""
    folder = FOLDER / f"{_digest(*flags)}.shim"
    if not (folder / "simt.h.gch").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _compile('#include "simt.h"\n', "shim.h", list(flags), folder / "simt.h.gch")
    return folder


def _digest(*parts: str) -> str:
    shim = ((HERE / name).read_text() for name in ("simt.h", "intrinsics.h", "races.h", "ptx.h", "ptx.py"))
    return hashlib.sha256("\0".join([*parts, *shim, _compiler()]).encode()).hexdigest()[:24]


def _compile(text: str, name: str, flags: list[str], path: Path) -> None:
    """Beside the place where it belongs, then moved there: processes may do the same at once."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=FOLDER) as folder:
        (Path(folder) / name).write_text(text)
        command = [_compiler(), *flags, "-o", f"{folder}/compiled", f"{folder}/{name}"]
        environment = {key: value for key, value in os.environ.items() if key != "LD_PRELOAD"}
        result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        if result.returncode != 0:
            raise RuntimeError(result.stderr)
        if result.stderr:
            print(result.stderr, file=sys.stderr)
        os.replace(f"{folder}/compiled", path)


def _compiler() -> str:
    return os.environ.get("CXX", "g++")
