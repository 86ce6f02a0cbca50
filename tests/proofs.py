"""Prove that kernels as compiled have no races, in any order of their threads: PYTHONPATH=tests python -m tests.proofs

By sentryward (PyPI), which follows the PTX of each thread of one launch and asks whether two accesses that no barrier
orders may meet. It knows no branch or loop that depends on data, so what it can prove are the plain kernels. Those are
named here, and one that is no longer proved, or that is proved now, is an error. So is a control, a kernel with a
mistake in it, that goes unnoticed.
"""

import argparse
import json
import re
import subprocess
import sys
import sysconfig
import tempfile
from collections import Counter
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from benchmarks.gpu_code import kernel_threads
from benchmarks.gpu_programs import PROGRAMS
from etsplat.engines.cuda.compile import compile_without_cache
from etsplat.engines.cuda.program import Program
from helpers.simt.inline import Inline

PROVED = {
    *("antialias_points", "area_backward", "area_mean", "area_sums", "fill", "mesh_combine", "normal_backward"),
    *("normal_mean", "normal_sums", "opaque_resolve", "opaque_shade", "photometric_loss", "soup_activate"),
    "texture_halve",
}
"""Whatever the data."""

ONE_PATH = {"antialias_finish", "pick_finish", "soup_activate_backward", "soup_statistics", "texture_by_uv"}
"""Along one way through the branches that depend on data."""

ONE_BLOCK = {"area_mean", "normal_mean", "photometric_loss"}
"""All others are launched with two."""

ARCHITECTURE = "compute_90"
_SIZE = 100  # of whatever a kernel asks for: numbers of triangles and pixels, and pointers that may be null
_SECONDS, _MIB = 20, 2500
_ENTRY = re.compile(r"\.visible \.entry (\w+)\(")


@dataclass(frozen=True)
class Kernel:
    """A kernel of a program, and what a launch of it looks like."""

    program: Program
    name: str

    @property
    def launch(self) -> dict[str, Any]:
        """In the words of sentryward."""
        threads, blocks = kernel_threads(self.program, self.name), 1 if self.name in ONE_BLOCK else 2
        dims = {"grid_dim": [blocks, 1, 1], "block_dim": [threads, 1, 1], "cluster_dim": [1, 1, 1]}
        return {**dims, "dynamic_shared_bytes": 0}


CONTROLS = {
    "a barrier deleted": ("triangle_area.cu", "area_sums", "__syncthreads();\n    double total", "double total"),
    "one place for all blocks": ("triangle_area.cu", "area_sums", "sums[blockIdx.x] = sum", "sums[0] = sum"),
}
"""File, kernel, and the text that another takes the place of."""


def ask(ptx: Path, kernel: Kernel, *, one_path: bool = False) -> dict[str, Any]:
    """What sentryward says of a kernel; whatever number it asks for is `_SIZE`."""
    arguments: list[dict[str, Any]] = []
    assumed = {"representative_branches": one_path, "bounded_computation_loops": one_path}
    config = {"schema": "spverify.kernel-input/v1", "entry": kernel.name, "launch": kernel.launch}
    config |= {"arguments": arguments, "assumptions": assumed}
    config |= {key: [] for key in ("tma_descriptors", "declarations", "shape_arrays")}
    given = ptx.with_suffix(".json")
    while True:
        given.write_text(json.dumps(config), encoding="utf-8")
        limits = ("--timeout", str(_SECONDS), "--memory-limit-mib", str(_MIB))
        command = (Path(sysconfig.get_path("scripts")) / "sentryward", ptx, "--input", given, *limits)
        answer = json.loads(subprocess.run(command, capture_output=True, text=True, check=False).stdout)
        asked = answer.get("details", {}).get("required_parameters", [])
        known = {(argument["parameter"], argument["offset"]) for argument in arguments}
        new = [each for each in asked if (each["parameter"], each["offset"]) not in known]
        if not new:
            return answer
        for each in new:
            number = {"type": f"u{8 * each['bytes']}", "value": _SIZE}
            arguments.append({"parameter": each["parameter"], "offset": each["offset"], **number})


def reason(answer: dict[str, Any]) -> str:
    """Why nothing is proved."""
    codes = [each["code"] for each in answer.get("diagnostics", [])]
    return codes[0] if codes else answer["result"]


def found(kernel: Kernel, ptx: Path) -> tuple[str, str]:
    """What is known: "proved", "one path", "a race", or "not proved"; and why it is no more."""
    answer = ask(ptx, kernel)
    if answer["result"] in ("potential_race", "not_wellsynced", "invalid_lifecycle"):
        return "a race", reason(answer)
    if answer["result"] == "race_free":
        return "proved", ""
    if ask(ptx, kernel, one_path=True)["result"] == "race_free":
        return "one path", reason(answer)
    return "not proved", reason(answer)


def expected(name: str) -> str:
    """What `found` is to say of a kernel."""
    return "proved" if name in PROVED else "one path" if name in ONE_PATH else "not proved"


def failed_controls(folder: Path) -> int:
    """How many mistakes are not found."""
    failures = 0
    for name, (file, kernel, old, new) in CONTROLS.items():
        source = next(program.source for program in PROGRAMS if program.file == file)
        assert source.count(old) == 1, f"{file} has not once: {old}"
        ptx = folder / "control.ptx"
        ptx.write_bytes(compile_without_cache(Inline(source.replace(old, new), contract=False), ARCHITECTURE))
        verdict, why = found(Kernel(next(p for p in PROGRAMS if p.file == file), kernel), ptx)
        print(f"control, {name}: {verdict} {why}")
        failures += verdict != "a race"
    return failures


def main(arguments: list[str] | None = None) -> int:
    """The exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernels", default="*", help="a pattern of their names")
    pattern = parser.parse_args(arguments).kernels
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        wrong, counts = failed_controls(folder), Counter[str]()
        for program in PROGRAMS:
            ptx = folder / "program.ptx"
            ptx.write_bytes(compile_without_cache(program, ARCHITECTURE))
            for name in filter(lambda name: fnmatch(name, pattern), _ENTRY.findall(ptx.read_text(encoding="utf-8"))):
                verdict, why = found(Kernel(program, name), ptx)
                counts[verdict] += 1
                unexpected = verdict != expected(name)
                wrong += unexpected
                print(f"{name}: {verdict} {why}{f', expected: {expected(name)}' if unexpected else ''}", flush=True)
    print(", ".join(f"{verdict}: {count}" for verdict, count in counts.items()))
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
