"""Kernels as CPU programs: each compiled with simt.h into a shared library, run on CPU tensors by ctypes."""

import ctypes
import hashlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from etsplat.engines.cuda.device import pointers_to
from etsplat.engines.cuda.program import Program
from helpers.simt.calls import Recording

HERE = Path(__file__).resolve().parent
FOLDER = HERE.parent.parent.parent / "build" / "simt"
_KERNEL = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\(')
FLAGS = ["-std=c++20", "-O1", "-g1", "-fPIC", "-shared", "-ffp-contract=off", "-fno-gnu-unique", "-fvisibility=hidden"]
FLAGS += ["-Wall", "-Wextra", "-Wno-unknown-pragmas", "-Wno-unused-function", "-Wno-unused-parameter"]
# always_inline into sanitized or unoptimised code takes minutes
SANITIZE = ["-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-DETSPLAT_SANITIZE"]


class Simt:
    """In the place of ``etsplat.engines.cuda.device.Device``: runs kernels in this process, on CPU tensors."""

    device_type = "cpu"

    def __init__(self, order_seed: int = 0) -> None:
        self.order_seed = order_seed
        self.launches: list[str] = []
        self._recording: Recording | None = None

    @property
    def capturing(self) -> bool:
        return self._recording is not None

    def memory_pool(self) -> None:
        """Recordings keep what they use."""

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
        run = getattr(library(program.source), f"simt_launch_{name}")
        run.restype = ctypes.c_char_p
        failure = run((ctypes.c_uint * 3)(*grid), (ctypes.c_uint * 3)(*block), pointers_to(values), self.order_seed)
        if failure is not None:
            raise RuntimeError(f"{name} ({program}): {failure.decode()}")


def sanitized() -> bool:
    """Whether this process has AddressSanitizer loaded, as ``make sanitize`` runs it."""
    return "libasan" in os.environ.get("LD_PRELOAD", "")


@cache
def library(source: str, extra_flags: tuple[str, ...] = ()) -> ctypes.CDLL:
    """The shared library of a CUDA source, from build/simt if it is there."""
    exports = "".join(f"SIMT_EXPORT({name})\n" for name in _KERNEL.findall(source))
    text = f'#include "simt.h"\n{source}\n#line 1 "exports"\n{exports}'
    flags = (*FLAGS, *(SANITIZE if sanitized() else []), *extra_flags, f"-I{HERE}")
    path = FOLDER / f"{_digest(text, *flags)}.so"
    if not path.is_file():
        _compile(text, "kernel.cpp", [f"-I{_precompiled_shim(flags)}", *flags], path)
    return ctypes.CDLL(str(path))


@cache
def _precompiled_shim(flags: tuple[str, ...]) -> Path:
    """A folder in which g++ finds simt.h compiled: half of the time that a kernel would take."""
    folder = FOLDER / f"{_digest(*flags)}.shim"
    if not (folder / "simt.h.gch").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _compile('#include "simt.h"\n', "shim.h", list(flags), folder / "simt.h.gch")
    return folder


def _digest(*parts: str) -> str:
    shim = ((HERE / name).read_text() for name in ("simt.h", "intrinsics.h"))
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
