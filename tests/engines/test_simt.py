"""The SIMT shim itself: it computes what a GPU would, and says when a kernel is wrong, be it compiled or as PTX."""

import ctypes

import pytest
import torch

from etsplat.engines.cuda.launch import launch
from etsplat.engines.cuda.program import Program
from helpers.simt import build
from helpers.simt.build import Simt
from helpers.simt.inline import Inline

FILL = Program("fill.cu")


KERNELS = {
    "block_sum": """(const float* in, float* out) {
        __shared__ float part[4];
        float v = in[(blockIdx.x * blockDim.y + threadIdx.y) * blockDim.x + threadIdx.x];
        for (int d = 16; d > 0; d /= 2) v += __shfl_xor_sync(~0u, v, d);
        const int t = threadIdx.y * blockDim.x + threadIdx.x;
        if (t % 32 == 0) part[t / 32] = v;
        __syncthreads();
        if (t == 0) out[blockIdx.x] = part[0] + part[1] + part[2] + part[3];
    }""",
    "warp_operations": """(int* out) {
        const int lane = threadIdx.x;
        int* row = out + 8 * lane;
        row[0] = __shfl_sync(~0u, lane, 3);
        row[1] = __shfl_sync(~0u, lane, 3, 8);
        row[2] = __shfl_up_sync(~0u, lane, 2, 8);
        row[3] = __shfl_down_sync(~0u, lane, 2, 8);
        row[4] = __shfl_xor_sync(~0u, lane, 5);
        row[5] = static_cast<int>(__ballot_sync(~0u, lane % 3 == 0));
        row[6] = lane < 8 ? __all_sync(0xffu, lane < 8) : __any_sync(~0xffu, lane == 40);
        row[7] = __syncthreads_count(lane < 9) + 100 * __syncthreads_or(lane == 4);
        row[7] += 1000 * __syncthreads_and(lane < 31);
    }""",
    "atomics": """(int* cells, int* old) {
        old[threadIdx.x] = atomicAdd(cells, 1);
        atomicMax(cells + 1, static_cast<int>(threadIdx.x));
        atomicMin(cells + 2, -static_cast<int>(threadIdx.x));
        atomicOr(cells + 3, 1 << threadIdx.x);
        atomicCAS(cells + 4, 0, 9);
        atomicExch(cells + 5, 3);
    }""",
    "poison": "(float* out) { __shared__ volatile float s[2]; out[blockIdx.x] = s[1]; s[1] = 5.0f; }",
    "right": "() { __syncthreads(); }",
    "stuck": "() { if (threadIdx.x < 40) __syncthreads(); else __ballot_sync(~0u, 1); }",
    "leaves": "() { if (threadIdx.x != 3) __syncwarp(); }",
    "outside": "() { if (threadIdx.x < 8) __syncwarp(0xf0u); }",
    "differs": "() { if (threadIdx.x % 2) __shfl_sync(~0u, 1, 0); else __ballot_sync(~0u, 1); }",
    "reads_outside": "() { if (threadIdx.x < 16) __shfl_sync(0xffffu, 1, 20); }",
}
SOURCE = "".join(f'extern "C" __global__ void {name}{rest}\n' for name, rest in KERNELS.items())


SOURCES = "sources"
COMPILED = ("compute_75", "compute_90")


@pytest.fixture(params=[SOURCES, *COMPILED])
def run(request, monkeypatch):
    """Launches a kernel from its source, or from what NVRTC makes of it; what went wrong, or None."""
    if request.param != SOURCES:
        if build.sanitized():
            pytest.skip("under AddressSanitizer NVRTC does not find its own library")
        monkeypatch.setattr(Simt, "architecture", request.param)

    def launched(name, grid, block, *tensors, flags=(), seed=0):
        kernels = build.library(SOURCE, flags) if flags else Simt().library(Inline(SOURCE))
        return build.run(kernels, name, grid, block, [ctypes.c_void_p(t.data_ptr()) for t in tensors], seed)

    return launched


@pytest.mark.sanitize
def test_launch_runs_a_kernel_of_the_package(simt):
    """The trivial kernel, through the call that the engine makes, writes every word and none after."""
    words = torch.zeros(1000, dtype=torch.int32)
    launch(FILL, "fill", 4, 256, [words, 7, 990])
    assert simt.launches == ["fill"]
    assert words[:990].eq(7).all()
    assert words[990:].eq(0).all()


@pytest.mark.sanitize
@pytest.mark.parametrize("seed", [0, 5])
def test_block_sum(run, seed, rng):
    """Shuffles, shared memory and barriers, in any order of threads."""
    values, sums = torch.rand(6, 128, generator=rng), torch.zeros(6)
    assert run("block_sum", (6, 1, 1), (16, 8, 1), values, sums, seed=seed) is None
    torch.testing.assert_close(sums, values.sum(1))


@pytest.mark.sanitize
@pytest.mark.parametrize("run", [SOURCES], indirect=True)
def test_switching_by_the_system(run, rng):
    """The same where there is no assembly to switch threads by."""
    values, sums = torch.rand(6, 128, generator=rng), torch.zeros(6)
    assert run("block_sum", (6, 1, 1), (16, 8, 1), values, sums, flags=("-DSIMT_UCONTEXT",)) is None
    torch.testing.assert_close(sums, values.sum(1))


def test_warp_operations(run):
    """Every shuffle, with segments, and the votes give what the programming guide says."""
    out = torch.zeros(32, 8, dtype=torch.int32)
    assert run("warp_operations", (1, 1, 1), (32, 1, 1), out) is None
    lane = torch.arange(32)
    expected = [lane * 0 + 3, lane // 8 * 8 + 3, torch.where(lane % 8 >= 2, lane - 2, lane)]
    expected += [torch.where(lane % 8 < 6, lane + 2, lane), lane ^ 5]
    expected += [lane * 0 + sum(1 << i for i in range(0, 31, 3)), (lane < 8).long(), lane * 0 + 109]
    assert torch.equal(out, torch.stack(expected, dim=1).int())


def test_atomics(run):
    """Each returns the old value and leaves the new one."""
    cells, old = torch.zeros(6, dtype=torch.int32), torch.zeros(20, dtype=torch.int32)
    assert run("atomics", (1, 1, 1), (20, 1, 1), cells, old) is None
    assert cells.tolist() == [20, 19, -19, (1 << 20) - 1, 9, 3]
    assert sorted(old.tolist()) == list(range(20))


def test_shared_memory_starts_poisoned(run):
    """In every block: what the one before left there is not to be relied on."""
    out = torch.zeros(3)
    assert run("poison", (3, 1, 1), (1, 1, 1), out) is None
    assert out.isnan().all()


@pytest.mark.parametrize(
    ("kernel_name", "message"),
    [
        ("stuck", "deadlock in block (0, 0, 0)"),
        ("leaves", "a lane of the mask has ended"),
        ("outside", "the calling lane is not in its mask"),
        ("differs", "meets"),
        ("reads_outside", "reads a lane outside of its mask"),
    ],
)
def test_wrong_kernels_are_reported(run, kernel_name, message):
    """With what happened; the machine works again afterwards."""
    failure = run(kernel_name, (2, 1, 1), (64, 1, 1))
    assert failure is not None
    assert message in failure
    assert run("right", (2, 1, 1), (64, 1, 1)) is None


def test_deadlock_says_who_waits(run):
    """And where, one line for neighbours that wait for the same."""
    failure = run("stuck", (1, 1, 1), (64, 1, 1))
    assert failure is not None
    assert "from thread (0, 0, 0) on: waiting in __syncthreads" in failure
    assert "from thread (40, 0, 0) on: waiting in __ballot_sync, mask ffffffff" in failure


@pytest.mark.parametrize(
    "arguments", [[ctypes.c_int32(0)], [], [ctypes.c_void_p(0)] * 2], ids=["width", "less", "more"]
)
def test_arguments_have_the_sizes_of_the_parameters(arguments):
    """Or nothing is launched: a device would take what lies beside them."""
    for kernels in (build.library(SOURCE), build.ptx_library(Inline(SOURCE), COMPILED[0])):
        failure = build.run(kernels, "poison", (1, 1, 1), (1, 1, 1), arguments)
        assert failure is not None
        assert failure.endswith("the parameters [8]")
