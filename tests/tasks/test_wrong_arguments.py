"""What tasks and readers are handed that is of no kind they take is refused by the name of the argument."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import etsplat
from etsplat.core.errors import InputError
from etsplat.io.mesh_files import MeshFile

VERTICES, FACES = etsplat.icosphere(0)
TINY = etsplat.ReconstructConfig.tiny().changed({"resolution": 16, "iterations": 1})


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (MeshFile(VERTICES, FACES[:0]), r"faces: expected indices in \[0, 12\), and at least one face"),
        (MeshFile(VERTICES, FACES + 1), r"faces: expected indices in \[0, 12\)"),
        (MeshFile(VERTICES, FACES.float()), "faces: expected whole numbers"),
        (MeshFile(VERTICES * torch.nan, FACES), "vertices: expected finite values"),
        (MeshFile(VERTICES, FACES, torch.ones(3, 3)), r"face_colors: expected shape \(20, 3\)"),
    ],
)
def test_arrays_of_a_mesh_in_memory_are_looked_at_before_a_run_begins(
    source: MeshFile, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        etsplat.reconstruct(source, tmp_path / "run", TINY)
    with pytest.raises(ValueError, match=message):
        etsplat.reconstruct("demo:owl", tmp_path / "run", TINY, init_mesh=source)
    assert not (tmp_path / "run").exists()


def a_mesh() -> etsplat.TriangleMesh:
    return etsplat.TriangleMesh.from_mesh(VERTICES, FACES, colors=0.5, opacity=0.9, sigma=0.3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: etsplat.reconstruct((VERTICES, FACES), "run", TINY), "source: is of type tuple; it must be a path, a"),
        (lambda: etsplat.reconstruct("demo:owl", None, TINY), "out: is None; it must be the path of a folder"),
        (
            lambda: etsplat.reconstruct("demo:owl", "run", TINY, init_mesh=3),
            "init_mesh: is of type int; it must be a p",
        ),
        (lambda: etsplat.train(None, "run"), "source: is None; it must be a path, a demo's name or a Dataset"),
        (lambda: etsplat.train("demo:scene", None), "out: is None; it must be the path of a folder"),
        (lambda: etsplat.export(None, "a.glb"), "source: is None; it must be a result of train or reconstruct, a T"),
        (
            lambda: etsplat.export(a_mesh(), "a.glb"),
            r"TriangleMesh, and no soup; mesh\.save\('a\.glb'\) writes",
        ),
        (
            lambda: etsplat.export(a_mesh().to_file(), "a.glb"),
            r"MeshFile, and no soup; etsplat\.save_mesh\('a\.glb'",
        ),
        (lambda: etsplat.texture_mesh(None), "run: is None; it must be a result of reconstruct or a path"),
        (lambda: etsplat.export("run", None), "path: is None; it must be the path of a file"),
        (lambda: etsplat.load_image(None), "path: is None; it must be the path of an image"),
        (lambda: etsplat.load_mesh(None), "path: is None; it must be a path"),
        (lambda: etsplat.load_dataset(None), "path: is None; it must be the path of a folder"),
    ],
)
def test_what_is_no_path_is_told_what_is_taken(
    call: Callable[[], object], message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        call()
    assert not list(tmp_path.iterdir())


def test_a_scorer_takes_the_name_of_a_device_and_no_path() -> None:
    photos = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0,), azimuths=5, supersampling=1)
    by_name, by_device = etsplat.Scorer(photos, "cpu"), etsplat.Scorer(photos, torch.device("cpu"))
    assert by_name.cheap(a_mesh()) == by_device.cheap(a_mesh())
    with pytest.raises(ValueError, match="dataset must be a Dataset, got 'photos'"):
        etsplat.Scorer("photos", "cpu")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: etsplat.TrainConfig(optimizer={}), r"optimizer: is a group of settings, .*TrainConfig\(\)\.changed\("),
        (lambda: etsplat.TrainConfig(**asdict(etsplat.TrainConfig())), ": is a group of settings, "),
        (lambda: etsplat.TrainConfig().changed(None), "changes: are of type NoneType; they must be values by name"),
        (lambda: etsplat.TrainConfig().changed([("iterations", 5)]), "changes: are of type list; they must be values"),
    ],
)
def test_groups_and_changes_are_told_apart(make: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_numbers_of_numpy_are_numbers() -> None:
    """As they come out of arrays; what is kept are Python's own, which files can hold."""
    changes: dict[str, Any] = {"iterations": np.int64(5), "densification": {"growth": np.float32(1.5)}}
    config = etsplat.TrainConfig.tiny().changed({**changes, "asset": np.bool_(False)})
    assert config == etsplat.TrainConfig.tiny().changed(
        {"iterations": 5, "densification": {"growth": 1.5}, "asset": False}
    )
    assert (type(config.iterations), type(config.densification.growth), type(config.asset)) == (int, float, bool)
    with pytest.raises(InputError, match=r"iterations: is 5\.5; it must be a whole number"):
        etsplat.TrainConfig.tiny().changed({"iterations": np.float64(5.5)})


def test_a_scorer_makes_the_folder_that_it_draws_into(tmp_path: Path) -> None:
    """Also by its name, which ended in an operator of str."""
    photos = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0,), azimuths=5, supersampling=1)
    scorer = etsplat.Scorer(photos, "cpu")
    scores = scorer.full(a_mesh(), str(tmp_path / "a" / "b"))
    assert [view["name"] for view in scores["test_views"]] == [photos.names[view] for view in photos.test]
    assert len(list((tmp_path / "a" / "b").glob("*.png"))) == 3 * len(photos.test)
    with pytest.raises(InputError, match="folder: is None; it must be the path of a folder"):
        scorer.full(a_mesh(), None)  # pyright: ignore[reportArgumentType]
