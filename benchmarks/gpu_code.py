"""What NVRTC makes of the GPU's kernels, counted in the machine code: needs no GPU.

python -m benchmarks.gpu_code                     every kernel, for the architectures of `--architectures`
python -m benchmarks.gpu_code --files 'raster_*'  some of them

Registers, shared memory and stack are what `cuobjdump` reads, instructions what `nvdisasm` shows; both are on PyPI, as
nvidia-cuda-cuobjdump and nvidia-cuda-nvdisasm.
"""

import argparse
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

from rich.console import Console

from benchmarks.gpu_programs import PROGRAMS, block_size
from benchmarks.tables import Table
from etsplat.engines.cuda.compile import compile_without_cache
from etsplat.engines.cuda.program import Program

ARCHITECTURES = ("sm_75", "sm_89", "sm_90")
_REGISTERS = 65536  # of a multiprocessor, handed out in pieces of 256 to a warp
_RESOURCES = re.compile(r"Function (\w+):\s+REG:(\d+) STACK:(\d+) SHARED:(\d+) LOCAL:(\d+)")
_SECTION = re.compile(r"^//-+ \.text\.(\w+) ", re.MULTILINE)
_LINE = re.compile(r"^(?:(\.L_x_\w+):|\s+/\*[0-9a-f]+\*/\s+(.*?)\s*;)", re.MULTILINE)
_BRANCH = re.compile(r"\bBRA\b.*`\((\.L_x_\w+)\)")
_BOUNDS = re.compile(r"__launch_bounds__\((\d+)\)\s+(\w+)\(")


@dataclass(frozen=True)
class Multiprocessor:
    """What a multiprocessor has room for: warps, blocks, and bytes of shared memory for all blocks.

    `reserved` are the bytes of a block that the driver takes and that are not among those of the compiled kernel.
    """

    warps: int
    blocks: int
    shared: int
    reserved: int


MULTIPROCESSORS = {
    "sm_75": Multiprocessor(32, 16, 64 << 10, 0),
    "sm_80": Multiprocessor(64, 32, 164 << 10, 1024),
    "sm_86": Multiprocessor(48, 16, 100 << 10, 1024),
    "sm_89": Multiprocessor(48, 24, 100 << 10, 1024),
    "sm_90": Multiprocessor(64, 32, 228 << 10, 0),
}


@dataclass(frozen=True)
class Kernel:
    """A compiled kernel.

    Attributes:
        threads: of a block.
        shared, stack: bytes of a block and of a thread.
        instructions: of the whole kernel, each counted once.
        pair: instructions of the innermost loop that evaluates the kernel function G, in the tile loops once a (slot,
            sub-tile) pair; 0 where there is none.
        local: loads and stores of local memory.
    """

    program: Program
    name: str
    architecture: str
    threads: int
    registers: int
    shared: int
    stack: int
    instructions: int
    pair: int
    local: int

    @property
    def occupancy(self) -> float:
        """Warps that a multiprocessor holds at once, of those that it has room for."""
        room = MULTIPROCESSORS[self.architecture]
        warps = -(-self.threads // 32)
        per_warp = -(-self.registers * 32 // 256) * 256
        by_registers = _REGISTERS // per_warp // warps
        by_shared = room.shared // max(self.shared + room.reserved, 1)
        return min(room.blocks, room.warps // warps, by_registers, by_shared) * warps / room.warps


def kernels(program: Program, architecture: str) -> list[Kernel]:
    """The kernels of a program, compiled for an architecture such as "sm_90"."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernels.cubin"
        path.write_bytes(compile_without_cache(program, architecture))
        resources = _RESOURCES.findall(_run("cuobjdump", "-res-usage", str(path)))
        code = dict(_sections(_run("nvdisasm", "-c", str(path))))
    result = []
    for name, registers, stack, shared, _ in resources:
        lines = _LINE.findall(code[name])
        instructions = [text for _, text in lines if text and "NOP" not in text]
        local = sum(bool(re.search(r"\b(LDL|STL)\b", text)) for text in instructions)
        numbers = (int(registers), int(shared), int(stack), len(instructions), pair_instructions(lines), local)
        result.append(Kernel(program, name, architecture, kernel_threads(program, name), *numbers))
    return result


def kernel_threads(program: Program, name: str) -> int:
    """Threads of a block of one of the program's kernels."""
    bounds = {name: int(count) for count, name in _BOUNDS.findall(program.source)}
    return bounds.get(name, block_size(program))


def pair_instructions(lines: list[tuple[str, str]]) -> int:
    """Instructions of the innermost loop with a logarithm, from (label, instruction) pairs of which one is empty.

    A loop reaches from a label to the last branch back to it; all between is counted, also what a thread may skip.
    """
    places, loops, count = {}, {}, 0
    counts, logarithms = [], []
    for label, text in lines:
        if label:
            places[label] = count
            continue
        branch = _BRANCH.search(text)
        count += 1
        if "MUFU.LG2" in text:
            logarithms.append(count - 1)
        if branch and branch[1] in places:
            loops[branch[1]] = count
    for label, end in loops.items():
        if any(places[label] <= place < end for place in logarithms):
            counts.append(end - places[label])
    return min(counts, default=0)


def _sections(text: str) -> Iterator[tuple[str, str]]:
    found = list(_SECTION.finditer(text))
    for match, following in zip(found, [*found[1:], None], strict=True):
        yield match[1], text[match.end() : following.start() if following else len(text)]


@cache
def _tool(name: str) -> str:
    """The path of a program of the toolkit, also where PyPI's packages put it."""
    purelib = Path(sysconfig.get_path("purelib"))
    places = [*purelib.glob(f"nvidia/*/bin/{name}"), *(Path(entry) / name for entry in sys.path if entry)]
    found = shutil.which(name) or next((str(path) for path in places if path.is_file()), None)
    if found is None:
        raise SystemExit(f"{name} is missing: pip install nvidia-cuda-cuobjdump nvidia-cuda-nvdisasm")
    return found


def _run(name: str, *arguments: str) -> str:
    return subprocess.run([_tool(name), *arguments], capture_output=True, text=True, check=True).stdout


def label(program: Program) -> str:
    """The file, and the definitions that ask for something."""
    return " ".join([program.file, *(f"{name}={value}" for name, value in program.defines if value)])


def table(chosen: list[Kernel]) -> Table:
    """A row for each."""
    rows = [
        [
            label(kernel.program),
            kernel.name,
            kernel.architecture,
            str(kernel.registers),
            f"{kernel.shared / 1024:.1f}",
            f"{100 * kernel.occupancy:.0f} %",
            str(kernel.instructions),
            str(kernel.pair or ""),
            str(kernel.local or ""),
        ]
        for kernel in chosen
    ]
    columns = ["program", "kernel", "for", "registers", "shared KiB", "occupancy", "instructions", "a pair", "local"]
    return Table("Compiled kernels", columns, rows)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", default="*", help="a pattern of csrc/cuda")
    parser.add_argument("--architectures", nargs="+", choices=list(MULTIPROCESSORS), default=list(ARCHITECTURES))
    options = parser.parse_args(arguments)
    programs = [program for program in PROGRAMS if fnmatch(program.file, options.files)]
    found = [kernel for program in programs for name in options.architectures for kernel in kernels(program, name)]
    Console(width=150).print(table(found).rich())


if __name__ == "__main__":
    main()
