"""The race detector for kernels: what it must find, and what is none. `make races` runs it over tests of kernels."""

import ctypes

import pytest
import torch

from etsplat.engines.cuda.sort import RadixSort
from helpers.simt import build
from helpers.simt.build import Races, Simt

KERNELS = {
    "blocks_write": "(int* cells) { cells[0] = blockIdx.x; }",
    "read_beside_atomics": "(int* cells) { if (cells[0] < 5) atomicAdd(cells, 1); }",
    "relaxed_read_beside_atomics": "(int* cells) { if (*(volatile int*)cells < 5) atomicAdd(cells, 1); }",
    "no_barrier": """(int* cells) {
        __shared__ int shared[64];
        shared[threadIdx.x] = threadIdx.x;
        cells[64 * blockIdx.x + threadIdx.x] = shared[63 - threadIdx.x];
    }""",
    "barrier": """(int* cells) {
        __shared__ int shared[64];
        shared[threadIdx.x] = threadIdx.x;
        __syncthreads();
        cells[64 * blockIdx.x + threadIdx.x] = shared[63 - threadIdx.x];
    }""",
    "shuffle_for_barrier": """(int* cells) {
        cells[64 * blockIdx.x + threadIdx.x] = threadIdx.x;
        __shfl_sync(~0u, 1, 0);
        if (threadIdx.x == 0) cells[64 * blockIdx.x] = cells[64 * blockIdx.x + 1];
    }""",
    "warp_barrier": """(int* cells) {
        cells[64 * blockIdx.x + threadIdx.x] = threadIdx.x;
        __syncwarp();
        if (threadIdx.x == 0) cells[64 * blockIdx.x] = cells[64 * blockIdx.x + 1];
    }""",
}
SOURCE = "".join(f'extern "C" __global__ void {name}{rest}\n' for name, rest in KERNELS.items())
RACING = ("blocks_write", "read_beside_atomics", "no_barrier", "shuffle_for_barrier")


@pytest.fixture
def races(reported: Races | None) -> Races:
    """What is reported from here on."""
    if reported is None:
        pytest.skip("make races watches for races")
    reported.new()
    return reported


def run(name: str, cells: torch.Tensor) -> None:
    pointer = ctypes.c_void_p(cells.data_ptr())
    assert build.run(build.library(SOURCE), name, (2, 1, 1), (64, 1, 1), [pointer]) is None


@pytest.mark.parametrize("name", KERNELS)
def test_races_are_those_that_there_are(races, name):
    """Between threads and between blocks: only barriers order memory, and only within a block."""
    run(name, torch.zeros(128, dtype=torch.int32))
    assert bool(races.new()) == (name in RACING)


def test_launches_follow_each_other(races):
    """What one has written the next may change."""
    cells = torch.zeros(128, dtype=torch.int32)
    for _ in range(3):
        run("barrier", cells)
    assert races.new() == []


def test_a_barrier_that_is_deleted_is_missed(races, simt, monkeypatch, rng):
    """Without the one in rank_in_warp the sort is right, as threads take turns here, and a race is reported."""
    barrier = "        __syncwarp();\n"
    monkeypatch.setattr(Simt, "library", lambda self, program: build.library(without(program.source, barrier)))
    keys, zeros = torch.randint(0, 2**9, (9000,), generator=rng).int(), RadixSort(9000, 9).zeros
    buffers = [keys.clone(), *(torch.zeros_like(keys) for _ in range(3))]
    result, _ = RadixSort(9000, 9).run(
        (buffers[0], buffers[1]), (buffers[2], buffers[3]), 9000, torch.zeros(zeros, dtype=torch.int32)
    )
    assert torch.equal(result, keys.sort()[0])
    assert races.new()


def without(source: str, line: str) -> str:
    assert source.count(line) == 1
    return source.replace(line, "")
