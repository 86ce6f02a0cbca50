import sys

import pytest

from etsplat.cli.tensorboard import TensorboardWriter
from etsplat.core.errors import InputError
from etsplat.optim.loop import DoneEvent, StepEvent


def event(iteration, loss, **metrics):
    return StepEvent(iteration, 40, 1.0, loss, {"triangles": 7.0}, metrics)


def test_what_was_written_is_read_back_and_a_resumed_run_replaces_what_it_repeats(tmp_path):
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    killed = TensorboardWriter(tmp_path)
    for iteration in (10, 20, 30):
        killed(event(iteration, 1.0))
    resumed = TensorboardWriter(tmp_path)
    for iteration in (30, 40):
        resumed(event(iteration, 0.5, psnr=20.0 + iteration))
    resumed(DoneEvent(40, 1.0))
    read = accumulators.EventAccumulator(str(tmp_path / "tensorboard"))
    read.Reload()
    assert [(scalar.step, scalar.value) for scalar in read.Scalars("loss")] == [(10, 1), (20, 1), (30, 0.5), (40, 0.5)]
    assert [scalar.value for scalar in read.Scalars("psnr")] == [50, 60]
    assert read.Scalars("triangles")[-1].value == 7


def test_without_tensorboard_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(InputError, match=r"etsplat\[tensorboard\]"):
        TensorboardWriter(tmp_path)
