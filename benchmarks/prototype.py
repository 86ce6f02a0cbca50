"""The throw-away prototype of the rasterizer as a yardstick, where it lies beside the checkout; it is not published."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
SOURCE = ROOT.parent / "shared" / "prototypes" / "cpu_splat.cpp"
BUILD = ROOT / "build" / "bench"
FLAGS = ("-O3", "-std=c++20", "-march=native", "-ffast-math", "-fno-finite-math-only")
TOTAL = re.compile(r"total ([\d.]+) ms")


class Prototype:
    """`program` is None where it cannot be had; `reason` says why."""

    def __init__(self, wanted: bool = True) -> None:
        self.program: Path | None = None
        self.reason = self._build() if wanted else "not asked for"

    def _build(self) -> str:
        compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("c++")
        if not SOURCE.exists():
            return f"{SOURCE.name} is not there"
        if compiler is None:
            return "no C++ compiler"
        BUILD.mkdir(parents=True, exist_ok=True)
        program = BUILD / "cpu_splat"
        command = [compiler, *FLAGS, str(SOURCE), "-o", str(program), "-lpthread"]
        made = subprocess.run(command, capture_output=True, text=True, check=False)
        if made.returncode != 0:
            return f"it does not compile here: {made.stderr.strip().splitlines()[0]}"
        self.program = program
        return ""

    def milliseconds(self, level: int, threads: int) -> list[float]:
        """Forward + backward at sigma 0.5; the first of its four repetitions, which warms up, is left out."""
        command = [str(self.program), str(level), "0.5", str(threads)]
        printed = subprocess.run(command, cwd=BUILD, capture_output=True, text=True, check=True).stdout
        return [float(total) for total in TOTAL.findall(printed)][1:]

    def picture(self) -> np.ndarray:
        """What its last run drew, (1024, 1024, 3) uint8."""
        return np.frombuffer((BUILD / "o.ppm").read_bytes()[-3 * 1024 * 1024 :], np.uint8).reshape(1024, 1024, 3)
