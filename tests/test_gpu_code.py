"""What is counted in the machine code of GPU kernels."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import gpu_code, gpu_floors
from benchmarks.gpu_code import Kernel
from etsplat.engines.cuda.program import Program, source_root
from tests import proofs

LISTING = """
.text.drawn:
        /*0000*/                   LDC R1, c[0x0][0x28] ;
.L_x_1:
        /*0010*/                   S2R R3, SR_TID.X ;
.L_x_2:
        /*0020*/                   MUFU.LG2 R4, R3 ;
        /*0030*/               @P0 BRA `(.L_x_3) ;
        /*0040*/                   FADD R4, R4, R4 ;
.L_x_3:
        /*0050*/               @P1 BRA `(.L_x_2) ;
        /*0060*/                   IADD3 R3, R3, 0x1, RZ ;
        /*0070*/               @P2 BRA `(.L_x_1) ;
.L_x_4:
        /*0080*/                   FMUL R5, R5, R5 ;
        /*0090*/               @P2 BRA `(.L_x_4) ;
        /*00a0*/                   EXIT ;
"""


def test_the_loop_of_pairs_is_the_innermost_one_with_a_logarithm():
    """Four instructions from the label to the branch back; the loop around it has seven, the last has no logarithm."""
    lines = gpu_code._LINE.findall(LISTING)
    assert sum(bool(text) for _, text in lines) == 11
    assert gpu_code.pair_instructions(lines) == 4
    without = [line for line in lines if "LG2" not in line[1]]
    assert gpu_code.pair_instructions(without) == 0


@pytest.mark.parametrize(
    ("architecture", "threads", "registers", "shared", "expected"),
    [
        ("sm_75", 256, 53, 21_094, 0.75),  # shared memory: three blocks
        ("sm_89", 256, 53, 21_094, 2 / 3),  # four blocks
        ("sm_90", 256, 49, 22_118, 0.5),  # registers, in pieces of 256 a warp: four blocks
        ("sm_90", 128, 112, 1_056, 0.25),
        ("sm_90", 64, 32, 0, 1.0),
    ],
)
def test_occupancy(architecture, threads, registers, shared, expected):
    """By hand, from the tables of the architectures."""
    kernel = Kernel(Program("fill.cu"), "fill", architecture, threads, registers, shared, 0, 1, 0, 0)
    assert kernel.occupancy == pytest.approx(expected)
    assert replace(kernel, shared=0, registers=16).occupancy == 1.0


def test_the_page_has_every_kernel_and_the_counts_of_the_floors():
    """Whoever adds a kernel, or changes the tile loops, makes the page anew."""
    page = (Path(__file__).parent.parent / "docs" / "gpu_kernels.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("|")]
    pairs = {row[1]: row[6] for row in rows if ".cu" in row[0]}
    sources = "".join(path.read_text(encoding="utf-8") for path in (source_root() / "cuda").glob("*.cu"))
    names = re.findall(r'extern "C" __global__ void (?:__launch_bounds__\(\d+\) )?(\w+)\(', sources)
    assert len(names) > 50
    assert pairs.keys() == set(names)
    assert pairs["raster_forward"] == str(gpu_floors.FORWARD_PAIR_INSTRUCTIONS)
    assert pairs["raster_backward"] == str(gpu_floors.BACKWARD_PAIR_INSTRUCTIONS)


def test_the_page_names_the_kernels_that_are_proved():
    """Those that `make prove` expects, and no others."""
    page = (Path(__file__).parent.parent / "docs" / "gpu_kernels.md").read_text(encoding="utf-8")
    for head, names in (("whatever the data", proofs.PROVED), ("Along one way", proofs.ONE_PATH)):
        item = next(item for item in page.split("\n- ") if head in item[:60])
        assert set(re.findall(r"\w+_\w+|fill", item.split(":", 1)[1])) == names
