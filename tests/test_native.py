"""What native calls take, and how they are described."""

import numpy as np
import pytest
import torch

from etsplat import _native

pytestmark = pytest.mark.sanitize


def photometric(**changed: object) -> float:
    arguments = {"color": torch.zeros(1, 4, 4, 3), "target": torch.ones(1, 4, 4, 3)}
    options = {"backgrounds": None, "mask": None, "gradient": None, "squared": True, "dssim_weight": 0.0}
    return _native.photometric(**{**arguments, **options, **changed})


@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8])
def test_a_call_reads_dtype_and_sizes_from_the_tensors(dtype):
    target = torch.zeros(2, 5, 7, 3, dtype=dtype)
    target[:, 0, 0] = 1
    unit = 1.0 if dtype == torch.float32 else 255.0
    assert photometric(color=torch.zeros(2, 5, 7, 3), target=target) == pytest.approx(1 / (35 * unit**2))


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


def test_either_of_two_dtypes_is_named():
    with pytest.raises(TypeError, match=r"^target must be a contiguous uint8 or float32 tensor .*, got torch.int64"):
        photometric(target=torch.zeros(1, 4, 4, 3, dtype=torch.int64))


def test_calls_take_their_arguments_by_name_only():
    with pytest.raises(TypeError, match="incompatible function arguments"):
        _native.slot_stride(3, 0, _native.DistortionDepth.NONE)


def test_none_is_refused_where_a_tensor_is_needed():
    with pytest.raises(TypeError, match="color: NoneType"):
        photometric(color=None)
