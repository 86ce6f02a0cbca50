"""What native calls take, and how they are described."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from etsplat import _native
from helpers.stubs import native_stub

STUB = Path(__file__).resolve().parent.parent / "src" / "etsplat" / "_native.pyi"


def photometric(**changed: object) -> float:
    arguments = {"color": torch.zeros(1, 4, 4, 3), "target": torch.ones(1, 4, 4, 3)}
    options = {"backgrounds": None, "mask": None, "gradient": None, "squared": True, "dssim_weight": 0.0}
    return _native.photometric(**{**arguments, **options, **changed})


@pytest.mark.sanitize
@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8])
def test_a_call_reads_dtype_and_sizes_from_the_tensors(dtype):
    target = torch.zeros(2, 5, 7, 3, dtype=dtype)
    target[:, 0, 0] = 1
    unit = 1.0 if dtype == torch.float32 else 255.0
    assert photometric(color=torch.zeros(2, 5, 7, 3), target=target) == pytest.approx(1 / (35 * unit**2))


@pytest.mark.sanitize
@pytest.mark.parametrize(
    ("wrong", "got"),
    [
        (torch.zeros(1, 4, 4, 3, dtype=torch.float64), "torch.float64 of shape"),
        (torch.zeros(1, 4, 3, 4).transpose(2, 3), "on cpu, not contiguous"),
        (torch.zeros(4, 4, 3), r"\[4, 4, 3\]"),
        (torch.zeros(1, 1, 4, 4, 3), r"\[1, 1, 4, 4, 3\]"),
        (torch.zeros(1, 4, 4, 3, device="meta"), "on meta"),
        (torch.zeros(1, 4, 4, 3).to_sparse(), "torch.float32 of shape"),
        (np.zeros((1, 4, 4, 3), np.float32), "numpy.ndarray"),
    ],
    ids=["dtype", "strides", "too few axes", "too many axes", "device", "layout", "numpy"],
)
def test_what_native_code_cannot_read_is_refused_by_the_name_of_its_argument(wrong, got):
    for name in ("color", "gradient"):
        with pytest.raises(
            TypeError, match=f"^{name} must be a contiguous float32 tensor on the CPU with 4 axes, got .*{got}"
        ):
            photometric(**{name: wrong})


@pytest.mark.sanitize
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc/cpuinfo is Linux's")
def test_instruction_sets_are_those_of_the_processor():
    """As Linux tells them, which asks it in other ways."""
    has = set(Path("/proc/cpuinfo").read_text().split())
    needed = {
        "avx512": {"avx512f", "avx512dq", "avx512bw", "avx512vl", "avx2", "fma"},
        "avx2": {"avx2", "fma"},
        "neon": {"asimd"},
        "plain": set(),
    }
    assert _native.available_instruction_sets() == [name for name, flags in needed.items() if flags <= has]


@pytest.mark.sanitize
def test_either_of_two_dtypes_is_named():
    with pytest.raises(TypeError, match=r"^target must be a contiguous uint8 or float32 tensor .*, got torch.int64"):
        photometric(target=torch.zeros(1, 4, 4, 3, dtype=torch.int64))


@pytest.mark.sanitize
def test_calls_take_their_arguments_by_name_only():
    with pytest.raises(TypeError, match="incompatible function arguments"):
        _native.slot_stride(3, 0, _native.DistortionDepth.NONE)


@pytest.mark.sanitize
def test_none_is_refused_where_a_tensor_is_needed():
    with pytest.raises(TypeError, match="color: NoneType"):
        photometric(color=None)


def test_the_description_for_type_checkers_is_that_of_the_module():
    """`make stubs` writes it."""
    assert STUB.read_text(encoding="utf-8") == native_stub()


@pytest.mark.sanitize
def test_lists_of_tensors_are_read_one_by_one():
    """Each element has its own sizes, and is named where it does not fit."""
    parameters = [torch.ones(3), torch.ones(2, 5), torch.ones(())]
    zeros = [[torch.zeros_like(parameter) for parameter in parameters] for _ in range(2)]
    gradients = [torch.ones_like(parameter) for parameter in parameters]
    rest = {"learning_rates": [0.5] * 3, "decays": [0.0] * 3, "beta1": 0.9, "beta2": 0.99, "eps": 0.0, "step": 1}
    state = {"firsts": zeros[0], "seconds": zeros[1], "paces": [None] * 3}
    _native.adam_step(parameters=parameters, gradients=gradients, **state, **rest)
    for parameter in parameters:
        torch.testing.assert_close(parameter, torch.full_like(parameter, 0.5))
    with pytest.raises(TypeError, match=r"^gradients must be a contiguous float32 tensor .*, got torch.float64"):
        _native.adam_step(parameters=parameters, gradients=[g.double() for g in gradients], **state, **rest)


@pytest.mark.sanitize
def test_a_group_of_arguments_keeps_its_tensors():
    """They are read when the call is made, which may be after the last name for them is gone."""
    color = torch.zeros(1, 16, 16, 3)
    held = sys.getrefcount(color)
    gradients = _native.RasterGradients(
        grad_color=color,
        **dict.fromkeys(("grad_alpha", "grad_distortion", "vertices")),
        **dict.fromkeys(("flat_colors", "corner_colors", "opacities", "sigmas", "viewmats", "Ks", "backgrounds")),
    )
    assert sys.getrefcount(color) == held + 1
    del gradients
    assert sys.getrefcount(color) == held


def test_every_path_draws_the_same_without_torch() -> None:
    """By the program that also tries modules of other machines, under emulators."""
    program = Path(__file__).parent / "helpers" / "without_torch.py"
    shown = subprocess.run([sys.executable, str(program)], capture_output=True, text=True, check=True).stdout
    apart = dict(re.findall(r"^(\w+): differs by (\S+) of the largest value$", shown, re.MULTILINE))
    assert list(apart) == _native.available_instruction_sets()
    assert all(float(difference) < 1e-5 for difference in apart.values()), shown
