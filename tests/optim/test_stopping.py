"""Runs that end early: by `Trainer.stop`, or by what a callback raises."""

import copy
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch

import etsplat

PHOTOS = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0,), azimuths=3, supersampling=1)


def a_trainer() -> etsplat.Trainer[etsplat.TriangleMesh]:
    mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
    return etsplat.Trainer(mesh, PHOTOS, etsplat.Objective(etsplat.Photometric()))


def finished() -> torch.Tensor:
    trainer = a_trainer()
    trainer.fit(9)
    return trainer.model.vertices


@pytest.mark.parametrize("folder", [None, "run"])
def test_a_callback_stops_a_run_which_can_be_gone_on_with(folder: str | None, tmp_path: Path) -> None:
    """After the very iteration that it was told of; with the bits of a run that was not stopped."""
    run = None if folder is None else tmp_path / folder
    trainer, events = a_trainer(), list[Any]()

    def patient(event: Any) -> None:
        events.append(event)
        if isinstance(event, etsplat.StepEvent) and event.iteration == 4:
            trainer.stop()

    assert trainer.fit(9, callbacks=[patient], log_every=2, run=run).iteration == 4
    assert isinstance(events[-1], etsplat.DoneEvent)
    assert [e.iteration for e in events if isinstance(e, etsplat.CheckpointEvent)] == ([] if run is None else [4])
    for follower in [trainer] if run is None else [trainer, a_trainer()]:
        assert follower.fit(9, run=run).iteration == 9
        assert follower.model.vertices.equal(finished())


def test_what_a_callback_raises_ends_a_run_which_can_be_gone_on_with() -> None:
    trainer = a_trainer()

    def broken(event: Any) -> None:
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="the disk is full"):
        trainer.fit(9, callbacks=[broken], log_every=2)
    assert trainer.progress.iteration == 2
    trainer.fit(9)
    assert trainer.model.vertices.equal(finished())


def test_a_trainer_is_not_pickled_but_says_what_to_do_and_is_copied() -> None:
    """It ended with the name of a function within it."""
    trainer = a_trainer()
    trainer.fit(4)
    with pytest.raises(TypeError, match=r"a Trainer cannot be pickled.*fit\(n, run=FOLDER"):
        pickle.dumps(trainer)
    twin = copy.deepcopy(trainer)
    trainer.fit(6)
    twin.fit(9)
    assert trainer.progress.iteration == 6
    assert twin.model.vertices.equal(finished())
