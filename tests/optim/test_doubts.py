"""What is probably wrong with the photos and cameras of a run is told before its first step."""

import warnings
from dataclasses import replace
from typing import Any

import pytest
import torch

import etsplat

PHOTOS = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0, 30.0), azimuths=4, supersampling=1)
FOUR_TIMES = torch.tensor([[4.0], [4.0], [1.0]])  # as of photos that were larger
FLIPPED = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def a_trainer(photos: etsplat.Dataset, **arguments: Any) -> etsplat.Trainer[etsplat.TriangleMesh]:
    mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
    return etsplat.Trainer(mesh, photos, etsplat.Objective(etsplat.Photometric()), **arguments)


def told(trainer: etsplat.Trainer[Any], **arguments: Any) -> list[str]:
    events = list[Any]()
    trainer.fit(trainer.progress.iteration + 1, callbacks=[events.append], **arguments)
    return [event.text for event in events if isinstance(event, etsplat.NoteEvent)]


def larger(factor: float) -> etsplat.Dataset:
    viewmats = PHOTOS.viewmats.clone()
    viewmats[:, :3, 3] *= factor
    return replace(PHOTOS, viewmats=viewmats)


@pytest.mark.parametrize(
    ("photos", "words"),
    [
        (replace(PHOTOS, viewmats=FLIPPED @ PHOTOS.viewmats), "look away from what is between them"),
        (replace(PHOTOS, Ks=PHOTOS.Ks * FOUR_TIMES), "the optical axis beside them"),
        (
            replace(PHOTOS, images=etsplat.StoredPictures([torch.tensor([1.0, 1, 1, 0]).expand(16, 16, 4)] * 8)),
            "photos with alpha must be premultiplied",
        ),
        (larger(100), r"spread over 418.1 units, and the model's own rates are made for 0.5 to 50: .*bounding_sphere"),
    ],
)
def test_what_is_doubtful_is_told_once(photos: etsplat.Dataset, words: str, tmp_path: Any) -> None:
    """As an event, also where there is a folder; where nobody listens, as a warning."""
    trainer = a_trainer(photos)
    (note,) = told(trainer, run=tmp_path / "run")
    with pytest.warns(UserWarning, match=words) as found:
        a_trainer(photos).fit(1)
    assert [str(warning.message) for warning in found] == [note]
    assert found[0].filename == __file__
    assert told(trainer) == []


def test_nothing_is_told_of_good_photos_or_chosen_rates() -> None:
    mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        a_trainer(PHOTOS).fit(1)
        a_trainer(larger(100), schedule=etsplat.Schedule({**mesh.rates, "vertices": 0.2})).fit(1)


@pytest.mark.parametrize("task", ["reconstruct", "train"])
def test_tasks_tell_it_of_photos_in_memory(task: str, tmp_path: Any) -> None:
    """They were told of folders alone; once, though they fit by a trainer."""
    photos = replace(PHOTOS, Ks=PHOTOS.Ks * FOUR_TIMES)
    events = list[Any]()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if task == "train":
            config = etsplat.TrainConfig.tiny().changed({"iterations": 1})
            etsplat.train(photos, tmp_path / "run", config, callbacks=[events.append])
        else:
            tiny = etsplat.ReconstructConfig.tiny().changed({"iterations": 1, "start.shape": "sphere"})
            etsplat.reconstruct(photos, tmp_path / "run", tiny, callbacks=[events.append])
    notes = [event.text for event in events if isinstance(event, etsplat.NoteEvent)]
    assert sum("the optical axis beside them" in note for note in notes) == 1
