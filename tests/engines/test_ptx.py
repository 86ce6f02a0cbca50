"""PTX run on the CPU: what its instructions compute, and what is said where it is wrong or not understood."""

import ctypes
import math

import pytest
import torch

from etsplat.engines.cuda.compile import compile_without_cache
from etsplat.engines.cuda.launch import launch, use_backend
from etsplat.engines.cuda.program import Program
from helpers.simt import build, ptx
from helpers.simt.build import Simt
from helpers.simt.inline import Inline

OLDEST = "compute_75"
INSTRUCTIONS = """
extern "C" __global__ void integers(const int* in, long long* out) {
    const int a = in[0], b = in[1], shift = in[2];
    const unsigned u = a;
    out[0] = a + b;
    out[1] = a * b;
    out[2] = static_cast<long long>(a) * b;
    out[3] = __mulhi(a, b);
    out[4] = __umul64hi(~0ull, u);
    out[5] = u >> (shift & 31);
    out[6] = a >> (shift & 31);
    out[7] = __popc(u);
    out[8] = __clz(a);
    out[9] = __ffs(a);
    out[10] = __brev(u);
    unsigned bytes;
    asm("prmt.b32 %0, %1, %2, 0x9650;" : "=r"(bytes) : "r"(u), "r"(b));
    out[11] = bytes;
    out[12] = __funnelshift_l(u, b, shift);
    out[13] = abs(a) % 1000 - a / 7;
    out[14] = static_cast<signed char>(a);
    out[15] = max(min(a, b), shift);
}
extern "C" __global__ void conversions(const double* in, long long* out) {
    const double x = in[threadIdx.x];
    long long* row = out + 6 * threadIdx.x;
    row[0] = static_cast<int>(x);
    row[1] = static_cast<long long>(x);
    row[2] = static_cast<int>(static_cast<float>(x));
    row[3] = static_cast<long long>(static_cast<float>(x));
    row[4] = __double2uint_rz(x);
    row[5] = static_cast<long long>(floorf(static_cast<float>(x)));
}
extern "C" __global__ void comparisons(const float* in, int* out) {
    const float a = in[0], b = in[1];
    out[0] = (a < b) | (a <= b) << 1 | (a == b) << 2 | (a != b) << 3 | (a > b) << 4 | (a >= b) << 5;
    out[1] = !(a < b) | !(a <= b) << 1 | !(a > b) << 2 | !(a >= b) << 3;
    out[2] = fminf(a, b) == b;
    out[3] = fmaxf(a, b) == b;
}
extern "C" __global__ void contracted(const float* in, float* out) { out[0] = in[0] * in[1] + in[2]; }
"""


def compiled(source: str, contract: bool = True) -> ctypes.CDLL:
    return build.ptx_library(Inline(source, contract), OLDEST)


def run(kernels: ctypes.CDLL, name: str, *tensors: torch.Tensor, threads: int = 1) -> str | None:
    return build.run(kernels, name, (1, 1, 1), (threads, 1, 1), [ctypes.c_void_p(t.data_ptr()) for t in tensors])


def wrapped(value: int) -> int:
    """As an int of 32 bits."""
    return (value + 2**31) % 2**32 - 2**31


@pytest.mark.parametrize(("a", "b", "shift"), [(123456789, 987654321, 5), (-123456789, 2**31 - 1, 31), (-8, 3, 0)])
def test_integers(a, b, shift):
    """Products, shifts and bits of numbers of either sign are Python's, wrapped."""
    out, u = torch.zeros(16, dtype=torch.int64), a % 2**32
    assert run(compiled(INSTRUCTIONS), "integers", torch.tensor([a, b, shift], dtype=torch.int32), out) is None
    eight = u.to_bytes(4, "little") + b.to_bytes(4, "little")
    sign = 255 * (eight[1] >> 7)  # selector 9
    quotient = math.trunc(a / 7)
    expected = [wrapped(a + b), wrapped(a * b), a * b, (a * b) >> 32, u - 1, u >> shift, a >> shift, u.bit_count()]
    expected += [32 - u.bit_length(), (u & -u).bit_length(), wrapped(int(f"{u:032b}"[::-1], 2)) % 2**32]
    expected += [int.from_bytes(bytes([eight[0], eight[5], eight[6], sign]), "little")]
    expected += [(((b << 32 | u) << shift) >> 32) % 2**32, abs(a) % 1000 - quotient, (u % 256 + 128) % 256 - 128]
    assert out.tolist() == [*expected, max(min(a, b), shift)]


def test_conversions_clamp_as_a_device_does():
    """To the nearest integer that there is; of NaN 0, or the highest bit where either side has 64 bits."""
    values = torch.tensor([2.75, -2.75, 1e30, -1e30, math.inf, math.nan], dtype=torch.float64)
    out = torch.zeros((6, 6), dtype=torch.int64)
    assert run(compiled(INSTRUCTIONS), "conversions", values, out, threads=6) is None
    low, high, lowest, highest, all_ones = -(2**31), 2**31 - 1, -(2**63), 2**63 - 1, 2**32 - 1
    assert out.tolist() == [
        [2, 2, 2, 2, 2, 2],
        [-2, -2, -2, -2, 0, -3],
        [high, highest, high, highest, all_ones, highest],
        [low, lowest, low, lowest, 0, lowest],
        [high, highest, high, highest, all_ones, highest],
        [low, lowest, 0, lowest, 2**31, lowest],
    ]


@pytest.mark.parametrize(("a", "b"), [(1.0, 2.0), (2.0, 1.0), (1.0, 1.0), (math.nan, 1.0)])
def test_comparisons_with_what_is_no_number(a, b):
    """Are false, but for that it differs; the smaller and the larger of it and a number are the number."""
    out = torch.zeros(4, dtype=torch.int32)
    assert run(compiled(INSTRUCTIONS), "comparisons", torch.tensor([a, b]), out) is None
    plain = [a < b, a <= b, a == b, a != b, a > b, a >= b]
    negated = [not a < b, not a <= b, not a > b, not a >= b]
    nan = math.isnan(a)
    bits = [sum(truth << i for i, truth in enumerate(row)) for row in (plain, negated)]
    assert out.tolist() == [*bits, nan or b <= a, nan or b >= a]


@pytest.mark.parametrize("contract", [True, False])
def test_what_is_contracted_is_rounded_once(contract):
    """A product with an addition, where the program allows it: the source shim always rounds twice."""
    a, b = torch.tensor(1 + 2.0**-13), torch.tensor(1 - 2.0**-13)
    out = torch.zeros(1)
    assert run(compiled(INSTRUCTIONS, contract), "contracted", torch.stack([a, b, torch.tensor(-1.0)]), out) is None
    assert float(out) == (-(2.0**-26) if contract else 0.0)


BESIDE = """
extern "C" __global__ void beside(const int* in, int* out) {
    __shared__ int cells[8];
    cells[threadIdx.x] = 10 * threadIdx.x;
    __syncthreads();
    if (threadIdx.x == 0) *out = (cells + 4)[*in];
}
"""


def test_an_address_in_shared_memory_has_32_bits():
    """The register may be below the array, and the number beside it lead back."""
    before, out = torch.tensor([-2], dtype=torch.int32), torch.zeros(1, dtype=torch.int32)
    assert run(compiled(BESIDE), "beside", before, out, threads=8) is None
    assert int(out) == 20


WRONG = """
extern "C" __global__ void misaligned(float* out) { *reinterpret_cast<float4*>(out + 1) = make_float4(1, 2, 3, 4); }
extern "C" __global__ void past_shared(int* out) {
    __shared__ int cells[8];
    cells[threadIdx.x] = 1;
    __syncthreads();
    out[0] = cells[out[0]];
}
extern "C" __global__ void past_local(int* out) {
    int cells[8];
    for (int i = 0; i < 8; ++i) cells[i] = out[i];
    out[0] = cells[out[8]];
}
extern "C" __global__ void __launch_bounds__(64) bounded(int* out) { out[0] = 1; }
"""


@pytest.mark.parametrize(
    ("name", "threads", "message"),
    [
        ("misaligned", 1, "an access of 16 bytes at an address that they do not divide in block (0, 0, 0)"),
        ("past_shared", 8, "an access outside of 32 bytes of shared memory in block (0, 0, 0)"),
        ("past_local", 1, "an access outside of 32 bytes of parameters or local memory in block (0, 0, 0)"),
        ("bounded", 65, "more threads in a block than the kernel is compiled for"),
    ],
)
def test_what_a_device_refuses_is_reported(name, threads, message):
    cells = torch.tensor([8, *[0] * 7, 9, *[0] * 7], dtype=torch.int32)
    failure = run(compiled(WRONG), name, cells, threads=threads)
    assert failure is not None
    assert failure.startswith(message)
    assert run(compiled(WRONG), "bounded", cells) is None


def test_kernels_of_the_package_run_as_compiled(monkeypatch):
    """Through the call that the engine makes."""
    words = torch.zeros(1000, dtype=torch.int32)
    with use_backend(Simt()), monkeypatch.context() as patch:
        patch.setattr(Simt, "architecture", OLDEST)
        launch(Program("fill.cu"), "fill", 4, 256, [words, 7, 990])
    assert words[:990].eq(7).all()
    assert words[990:].eq(0).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("st.global.u32", "st.global.cg.u32", "cg of a load or store is not known"),
        ("mad.lo.s32", "mad.lo.cc.s32", "mad.lo.cc.s32 is not known"),
        ("mad.lo.s32", "sad.s32", "sad.s32 is not known"),
        (".visible .entry", ".visible .func", "no kernel"),
        ("%ctaid.x", "%clock", "%clock is not known"),
    ],
)
def test_what_is_not_known_is_an_error(old, new, message):
    """Instead of a guess."""
    text = compile_without_cache(Program("fill.cu"), OLDEST).decode()
    assert "simt_launch" not in text
    assert "PTX_EXPORT(fill" in ptx.translate(text)
    assert old in text
    with pytest.raises(ptx.PtxError, match=message):
        ptx.translate(text.replace(old, new))
