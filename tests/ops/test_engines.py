"""Which engine and which device are chosen, and what is said where there is none."""

import pytest
import torch

from etsplat.core.errors import EngineUnavailableError, InputError
from etsplat.cuda import device as cuda_device_module
from etsplat.ops.engines import resolve_device, resolve_engine
from helpers.simt.build import Simt

CPU = torch.device("cpu")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_engine_follows_the_precision(dtype):
    """On the CPU: native for float32, the reference for float64."""
    assert resolve_engine(None, torch.zeros(1, dtype=dtype)) == ("cpu" if dtype == torch.float32 else "reference")


def test_engine_cuda_wants_float32_on_a_gpu(simt: Simt):
    """Where the shim stands for the GPU, CPU tensors are on it; without, they are not."""
    assert resolve_engine("cuda", torch.zeros(1)) == "cuda"
    with pytest.raises(ValueError, match="engine cuda computes in float32"):
        resolve_engine("cuda", torch.zeros(1, dtype=torch.float64))


def test_engine_cuda_refuses_tensors_on_the_cpu():
    with pytest.raises(ValueError, match="engine cuda needs tensors on a GPU, got cpu"):
        resolve_engine("cuda", torch.zeros(1))


def test_device_and_engine_must_not_contradict_each_other():
    """One line that names both."""
    for device, engine in (("cpu", "cuda"), ("cuda", "cpu")):
        with pytest.raises(InputError, match=f"engine: {engine} does not compute on device {device}"):
            resolve_device(device, engine)


def test_a_device_is_chosen_where_none_is_named(simt: Simt):
    """The engine decides; an engine of the CPU stays there."""
    assert resolve_device("cpu", None) == CPU
    assert resolve_device(None, "reference") == CPU
    assert resolve_device(None, "cuda") == CPU  # the shim's tensors are there


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_tasks_run_on_the_cpu_unless_asked_otherwise():
    """No GPU is no reason to fail, but asking for one is answered with what is missing."""
    assert resolve_device(None, None) == CPU
    for device, engine in (("cuda", None), (None, "cuda")):
        with pytest.raises(EngineUnavailableError, match="compute on the CPU"):
            resolve_device(device, engine)


def test_a_gpu_that_cannot_be_used_is_named_with_the_reason(monkeypatch, capsys):
    """With a torch that is too old, say, tasks run on the CPU, and a line says why."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda_device_module.torch, "__version__", "2.9.1+cu128")
    assert resolve_device(None, None) == CPU
    assert "computing on the CPU: the GPU engine needs torch 2.11 or newer, found 2.9.1" in capsys.readouterr().err
