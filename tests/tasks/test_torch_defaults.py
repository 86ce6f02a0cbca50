"""Whatever torch's default dtype and device are, runs have the same bits, and leave both as they are."""

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

import etsplat


@pytest.fixture(params=["float64", "device"])
def others(request) -> Iterator[None]:
    """Double precision, as programs of science take it; a device, in the place of a GPU, where nothing has values."""
    if request.param == "float64":
        torch.set_default_dtype(torch.float64)
    else:
        torch.set_default_device("meta")
    yield
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)


def same(a: Tensor, b: Tensor) -> bool:
    return a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)


REFERENCES: dict[str, dict[str, Tensor]] = {}


def reference(name: str, make) -> dict[str, Tensor]:
    """What is made by torch's own defaults, once."""
    dtype, device = torch.get_default_dtype(), torch.get_default_device()
    if name not in REFERENCES:
        torch.set_default_dtype(torch.float32)
        with torch.device("cpu"):
            REFERENCES[name] = make("before")
        torch.set_default_dtype(dtype)
    assert (torch.get_default_dtype(), torch.get_default_device()) == (dtype, device)
    return REFERENCES[name]


def check(name: str, make) -> None:
    expected, kinds = reference(name, make), (torch.get_default_dtype(), torch.get_default_device())
    found = make("within")
    assert kinds == (torch.get_default_dtype(), torch.get_default_device())
    assert [key for key in expected if not same(expected[key], found[key])] == []


def test_photos_of_meshes_and_scenes(others):
    def make(_):
        owl = etsplat.demo_object()
        photos = etsplat.photograph(owl, 24, 24, elevations=(10.0,), azimuths=5, supersampling=2)
        scene = etsplat.demo_scene(16, 12)
        assert owl.face_colors is not None
        return {
            "mesh": owl.vertices,
            "colors": owl.face_colors,
            "photo": photos.images[3],
            "pose": photos.viewmats,
            "scene": scene.images[5],
            "points": scene.point_colors,
            "poses": scene.viewmats,
        }

    check("photos", make)


def test_a_trainer_of_a_soup(others, tmp_path):
    def make(folder):
        with torch.device("cpu"):
            generator = torch.Generator().manual_seed(0)
            spots = 2 * torch.rand((300, 3), generator=generator, dtype=torch.float32) - 1
            start = etsplat.StartPoints(spots, torch.full((300, 3), 0.5, dtype=torch.float32))
        photos = etsplat.demo_scene(16, 12)
        soup = etsplat.start_soup(start, generator, scale=1.0, opacity=0.3, sigma=1.0, sh_degree=1)
        trainer = etsplat.Trainer(soup, photos.watching(), etsplat.Objective(etsplat.Photometric(0.2)))
        trainer.fit(4, run=tmp_path / folder)
        return {name: value.detach() for name, value in trainer.outcome().model.parameters().items()}

    check("trainer", make)


def test_reconstruct(others, tmp_path):
    def make(folder):
        config = etsplat.ReconstructConfig.tiny().changed({"iterations": 20, "resolution": 32})
        etsplat.reconstruct("demo:owl", tmp_path / folder, config)
        etsplat.export(tmp_path / folder, tmp_path / f"{folder}.ply", etsplat.ExportConfig())
        mesh = etsplat.load_mesh(tmp_path / f"{folder}.ply")
        return {"vertices": mesh.vertices, "faces": mesh.faces}

    check("reconstruct", make)


def test_train(others, tmp_path):
    def make(folder):
        config = etsplat.TrainConfig.tiny().changed({"iterations": 40, "width": 32, "asset": True})
        etsplat.train("demo:scene", tmp_path / folder, config)
        with torch.device("cpu"):
            soup = etsplat.TriangleSoup.load(tmp_path / folder / "soup.safetensors")
        return {name: value.detach() for name, value in soup.parameters().items()}

    check("train", make)
