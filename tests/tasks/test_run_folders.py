"""The folder of a run: while it is written, and when it is written again."""

from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from etsplat.core.errors import InputError
from etsplat.data.demo_object import demo_object
from etsplat.data.demo_scene import demo_scene
from etsplat.io.run_directory import RunDirectory
from etsplat.optim.loop import CheckpointEvent
from etsplat.report import write_report
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig

FEW = {"iterations": 3, "output.log_every": 1, "output.checkpoint_every": 1}
Task = Callable[..., Any]


@pytest.fixture(scope="module", params=["train", "reconstruct"])
def task(request: pytest.FixtureRequest) -> Task:
    if request.param == "train":
        return partial(train, demo_scene(32, 24), config=TrainConfig.tiny().changed({**FEW, "max_triangles": 5000}))
    return partial(reconstruct, demo_object(), config=ReconstructConfig.tiny().changed(FEW))


def test_a_living_run_is_left_alone_but_can_be_read(task: Task, tmp_path: Path) -> None:
    """Neither gone on with nor replaced while it is written; afterwards both."""
    out, refused = tmp_path / "run", []

    def another(event: object) -> None:
        if isinstance(event, CheckpointEvent) and event.iteration == 2:
            for how in ("resume", "overwrite"):
                with pytest.raises(InputError, match=r"run: process \d+ on .* is writing this run"):
                    task(out, **{how: True})
                refused.append(how)
            assert len(RunDirectory(out).read_history()) == 2
            if RunDirectory(out).soup_path.exists():
                open_run(out)

    task(out, callbacks=[another])
    assert refused == ["resume", "overwrite"]
    assert [path.name for path in out.glob(".*")] == []
    assert len((out / "history.jsonl").read_text().splitlines()) == 3
    for how in ("resume", "overwrite"):
        task(out, **{how: True})


def test_a_run_that_is_made_again_has_the_same_bytes_but_for_its_times(
    task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a clock that goes alike in both every byte of every file."""
    for name in ("first", "second"):
        monkeypatch.setattr("time.perf_counter", partial(next, count()))
        task(tmp_path / name)
        write_report(tmp_path / name)
    first, second = (
        {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()}
        for out in (tmp_path / "first", tmp_path / "second")
    )
    assert first.keys() == second.keys()
    assert len(first) > 10
    assert [str(name) for name in first if first[name] != second[name]] == []
