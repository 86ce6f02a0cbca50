"""Kernels as CPU programs: each compiled with simt.h into a shared library, run on CPU tensors by ctypes."""

import ctypes
import hashlib
import os
import re
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from etsplat.cuda.program import Program

HERE = Path(__file__).resolve().parent
FOLDER = HERE.parent.parent / "build" / "simt"
_KERNEL = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\(')
FLAGS = ["-std=c++20", "-O1", "-g1", "-fPIC", "-shared", "-ffp-contract=off", "-fno-gnu-unique", "-fvisibility=hidden"]
FLAGS += ["-Wall", "-Wextra", "-Wno-unknown-pragmas", "-Wno-unused-function", "-Wno-unused-parameter"]
# always_inline into sanitized or unoptimised code takes minutes
SANITIZE = ["-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-DETSPLAT_SANITIZE"]


class Simt:
    """The backend (``etsplat.cuda.launch.Backend``) that runs kernels in this process, on CPU tensors."""

    device_type = "cpu"

    def __init__(self, order_seed: int = 0) -> None:
        self.order_seed = order_seed
        self.launches: list[str] = []

    def launch(
        self,
        program: Program,
        name: str,
        grid: tuple[int, int, int],
        block: tuple[int, int, int],
        parameters: Any,
    ) -> None:
        self.launches.append(name)
        run = getattr(library(program.source), f"simt_launch_{name}")
        run.restype = ctypes.c_char_p
        failure = run((ctypes.c_uint * 3)(*grid), (ctypes.c_uint * 3)(*block), parameters, self.order_seed)
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
    flags = [*FLAGS, *(SANITIZE if sanitized() else []), *extra_flags, f"-I{HERE}"]
    compiler = os.environ.get("CXX", "g++")
    shim = "".join((HERE / name).read_text() for name in ("simt.h", "intrinsics.h"))
    digest = hashlib.sha256("\0".join([text, shim, compiler, *flags]).encode()).hexdigest()[:24]
    path = FOLDER / f"{digest}.so"
    if not path.is_file():
        FOLDER.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=FOLDER) as folder:
            (Path(folder) / "kernel.cpp").write_text(text)
            command = [compiler, *flags, "-o", f"{folder}/kernel.so", f"{folder}/kernel.cpp"]
            environment = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
            result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
            if result.returncode != 0:
                raise RuntimeError(result.stderr)
            if result.stderr:
                print(result.stderr, file=sys.stderr)
            os.replace(f"{folder}/kernel.so", path)
    return ctypes.CDLL(str(path))
