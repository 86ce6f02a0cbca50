"""What a callback raises ends a run wherever it is: services cancel jobs so, and set them limits of time."""

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

import etsplat

PHOTOS = etsplat.photograph(etsplat.demo_object(), 48, 48, elevations=(-30.0, 30.0), azimuths=6, supersampling=1)
CONFIG = etsplat.ReconstructConfig.tiny().changed({"iterations": 4, "start.shape": "hull", "start.hull_faces": 400})


class CancelledError(Exception):
    """Somebody has had enough."""


def test_a_run_says_what_it_does_before_its_first_step_and_can_be_cancelled_there(tmp_path: Path) -> None:
    """The start of an object takes minutes, and nothing was told of it; nothing is left of what was cancelled."""

    def impatient(event: Any, stage: str) -> None:
        if isinstance(event, etsplat.StageEvent) and event.name == stage:
            raise CancelledError

    for stage in ("Carving the visual hull", "Opening hollows", "Untangling the start"):
        with pytest.raises(CancelledError):
            etsplat.reconstruct(PHOTOS, tmp_path / "run", CONFIG, callbacks=[partial(impatient, stage=stage)])
        assert not (tmp_path / "run").exists()
    seen = list[Any]()
    result = etsplat.reconstruct(PHOTOS, tmp_path / "run", CONFIG, callbacks=[seen.append])
    again = etsplat.reconstruct(PHOTOS, tmp_path / "again", CONFIG)
    assert torch.equal(result.mesh.vertices, again.mesh.vertices)
    stages = [event for event in seen if isinstance(event, etsplat.StageEvent)]
    first_step = next(event for event in seen if isinstance(event, etsplat.StepEvent))
    assert seen.index(stages[-1]) < seen.index(first_step)
