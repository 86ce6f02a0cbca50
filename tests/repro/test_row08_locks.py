"""A run folder has one writer."""

from dataclasses import replace

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.demo_scene import demo_scene
from etsplat.optim.loop import CheckpointEvent
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig

SHORT = TrainConfig.tiny().changed(
    {"iterations": 3, "max_triangles": 200, "output.log_every": 1, "output.checkpoint_every": 1}
)


@pytest.mark.parametrize("how", ["resume", "overwrite"])
@pytest.mark.xfail(strict=True, raises=pytest.fail.Exception, reason="row 8: no lock on a run folder")
def test_a_living_run_is_left_alone(tmp_path, how):
    scene = demo_scene(32, 24)
    assert scene.exact_points is not None
    assert scene.point_colors is not None
    keep = torch.arange(0, 4000, 40)
    scene = replace(scene, exact_points=scene.exact_points[keep], point_colors=scene.point_colors[keep])

    def another(event: object) -> None:
        if isinstance(event, CheckpointEvent) and event.iteration == 2:
            with pytest.raises(InputError):
                train(scene, tmp_path / "run", SHORT, **{how: True})

    train(scene, tmp_path / "run", SHORT, callbacks=[another])
