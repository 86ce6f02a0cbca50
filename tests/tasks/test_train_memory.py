"""What a run says of its memory: counted from its tensors, linear, and refused where it is not there."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import LazyPictures, Picture
from etsplat.tasks import train_memory
from etsplat.tasks.soup_trainer import start_trainer
from etsplat.tasks.train import train
from etsplat.tasks.train_checks import check_train
from etsplat.tasks.train_config import TrainConfig
from etsplat.tasks.train_memory import (
    PACE,
    PASSING,
    PLANNED,
    STATISTICS,
    bytes_around,
    bytes_of_values,
    bytes_per_triangle,
    check_memory,
    memory_of,
)
from helpers.captures import small_demo_scene

CPU = torch.device("cpu")
SHORT = TrainConfig.tiny().changed({"iterations": 2, "max_triangles": 600})


@pytest.fixture(scope="module")
def capture() -> Dataset:
    return small_demo_scene()


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_bytes_of_a_triangle_are_those_of_a_runs_tensors(capture: Dataset, degree: int) -> None:
    """Values, gradients, two moments, statistics, and the best state by the watched photos, one row for each; beside
    them, in an edit, the new values without the gradients, and a moment of the largest tensor."""
    config = SHORT.changed({"drawing.sh_degree": degree})
    for watched in (False, True):
        trainer = start_trainer(capture.watching(8) if watched else capture, config)
        trainer.fit(2)
        rows = [t for t in trainer.state().values() if t.ndim and len(t) == trainer.count]
        lasting = sum(t.numel() * t.element_size() for t in rows)
        values = sum(t.numel() * t.element_size() for t in trainer.model.state().values())
        assert lasting == (4 if watched else 3) * values + (STATISTICS + PACE) * trainer.count
        largest = max(t.numel() * t.element_size() for t in trainer.model.state().values())
        counted = bytes_per_triangle(degree, watched=watched) * trainer.count
        assert counted >= lasting + values
        assert counted >= lasting + values + largest + PLANNED * trainer.count
        assert counted <= 2 * (lasting + values)


def test_memory_has_room_for_the_views_that_an_opaque_mesh_is_fitted_to(capture: Dataset) -> None:
    """Of few photos; of many there are none, nor where no such mesh is made of a soft soup."""
    few, long = capture.of_views(capture.train[:4]), SHORT.changed({"asset": True, "iterations": 100})
    soft = memory_of(few, long, 600, CPU)
    assert soft.soft == 2 * 4 * 64 * 48  # a third of 100 steps shows six views five times
    assert "24 KiB for views of the soup" in str(soft)
    for other in ({"asset": False}, {"finish": "opaque"}, {"iterations": 60}):
        none = memory_of(few, long.changed(other), 600, CPU)
        assert soft.total - none.total == soft.soft
        assert "views of the soup" not in str(none)


def test_memory_is_linear_in_triangles_and_photos(capture: Dataset) -> None:
    few, many = (memory_of(capture, SHORT, most, CPU) for most in (10**7, 2 * 10**7))
    assert many.total - few.total == 10**7 * few.per_triangle
    assert few.kept == sum(3 * width * height for width, height in capture.images.sizes)
    assert "10,000,000 triangles" in str(few)
    assert "for each of 42 photos" in str(few)


def test_triangles_around_a_run_count_and_more_where_they_are_recolored(capture: Dataset) -> None:
    """Their values, corners in the frame of the run, what comes and goes; of plain colours that learn five copies."""
    others = (0, bytes_around(1000, 1), bytes_around(1000, 1, recolored=True))
    alone, among, recolored = (memory_of(capture, SHORT, 600, CPU, around) for around in others)
    assert among.total - alone.total == 1000 * (bytes_of_values(1) + 36 + PASSING)
    assert recolored.total - among.total == 1000 * 5 * 12


def test_a_run_says_beforehand_what_it_needs(capture: Dataset) -> None:
    needed = memory_of(capture, SHORT, 600, CPU)
    assert any(str(needed) in note for note in check_train(capture, SHORT, 2, CPU))


def test_too_many_triangles_for_the_memory_are_refused(
    capture: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is written, and the message says what would fit; that does."""
    monkeypatch.setattr(train_memory, "available_memory", lambda: 1 << 30)
    config = replace(SHORT, max_triangles=10_000_000, pixels_per_triangle=None)
    with pytest.raises(
        InputError,
        match=r"max_triangles: 10,000,000.*set it to \d+ or less.*with width=, or divide the scene with blocks=$",
    ) as refused:
        train(capture, tmp_path / "run", config)
    assert not (tmp_path / "run").exists()
    fitting = int(str(refused.value).split("set it to ")[1].split()[0])
    assert fitting > 500_000
    needed = memory_of(capture, config, fitting, CPU)
    assert needed.total - capture.images.held_bytes <= 1 << 30
    check_memory(capture, config, fitting, CPU)


def test_points_that_do_not_fit_are_named(capture: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer triangles than points cannot be asked for."""
    monkeypatch.setattr(train_memory, "available_memory", lambda: 1 << 18)
    with pytest.raises(InputError, match=r"starts from [\d,]+ points; thin them"):
        check_memory(capture, SHORT, 600, CPU)


def test_photos_in_memory_are_not_asked_for_again(capture: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decoded photos are in what is free no more; those that are still to be decoded need room."""
    size = 50 << 20

    def make(index: int) -> Picture:
        width, height = capture.images.sizes[index]
        return Picture(torch.zeros(height, width, 3, dtype=torch.uint8))

    count = len(capture)
    lazy = LazyPictures(make, capture.images.sizes, [size] * count, lambda: b"", limit=size * count)
    views = replace(capture, images=lazy)
    monkeypatch.setattr(train_memory, "available_memory", lambda: 300 << 20)
    assert lazy.held_bytes == 0
    with pytest.raises(InputError, match="are free"):
        check_memory(views, SHORT, 600, CPU)
    lazy.preload()
    assert lazy.held_bytes == size * count
    assert check_memory(views, SHORT, 600, CPU).kept == size * count


def test_photos_that_are_decoded_anew_on_purpose_are_not_said_to_be_too_large(capture: Dataset) -> None:
    own = capture.images
    many = replace(capture, images=LazyPictures(own.picture, own.sizes, [99] * len(own.sizes), own.fingerprint, 0))
    for streams in (False, True):
        notes = check_train(many, SHORT, 2, CPU, streams=streams)
        assert any("do not fit into memory" in note for note in notes) is not streams
