"""What `import etsplat` hands out can be copied and pickled: to worker processes, into notebooks' caches."""

import copy
import inspect
import pickle
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import etsplat
from etsplat import MeshFile, MeshTopology, StoredPictures, TriangleMesh, TriangleSoup

CAMERAS = etsplat.orbit_cameras(16, 12, azimuths=1)
MESH = MeshFile(*etsplat.icosphere(1), vertex_colors=torch.rand(42, 3))
PICTURES = StoredPictures([torch.rand(12, 16, 4).mul(255).byte() for _ in range(5)])


def _mesh() -> TriangleMesh:
    return TriangleMesh.from_mesh(MESH.vertices, MESH.faces, colors=0.5, opacity=0.9, sigma=0.3)


def _textured() -> etsplat.TexturedMesh:
    texture, uvs = torch.rand(8, 8, 3), torch.rand(80, 3, 2)
    return etsplat.TexturedMesh.from_mesh(MESH.vertices, MESH.faces, texture, uvs)


def _soup() -> TriangleSoup:
    return TriangleSoup.from_triangles(
        MESH.vertices[MESH.faces], torch.rand(80, 3), opacity=0.5, sigma=0.5, sh_degree=1
    )


def _rasterization() -> etsplat.Rasterization:
    return _mesh().render(CAMERAS, outputs=("depth", "normal", "statistics"))


def _dataset() -> etsplat.Dataset:
    names = [str(index) for index in range(5)]
    return etsplat.Dataset(CAMERAS.viewmats, CAMERAS.Ks, PICTURES, names, [0, 1, 2], [3, 4])


def _statistics() -> Any:
    found = _rasterization().statistics
    assert found is not None
    return found


def _adam() -> etsplat.Adam:
    adam = etsplat.Adam({"vertices": torch.rand(4, 3).requires_grad_()}, {"vertices": 0.1})
    adam.parameters["vertices"].grad = torch.rand(4, 3)
    adam.step()
    return adam


VALUES: dict[str, Callable[[], Any]] = {
    "Adam": _adam,
    "Cameras": lambda: CAMERAS,
    "CheckpointEvent": lambda: etsplat.CheckpointEvent(3, Path("x")),
    "Cutoffs": lambda: etsplat.Cutoffs(x_max=1.5),
    "Dataset": _dataset,
    "DensifyAndPrune": lambda: etsplat.DensifyAndPrune(begin=3),
    "DepthNormals": lambda: etsplat.DepthNormals(0.5),
    "Distortion": lambda: etsplat.Distortion(0.5),
    "DivergedError": lambda: etsplat.DivergedError("the loss is NaN at iteration 3"),
    "DoneEvent": lambda: etsplat.DoneEvent(3, 0.5),
    "EdgeLength": lambda: etsplat.EdgeLength(0.5, power=2),
    "Exposure": lambda: etsplat.Exposure(10),
    "Fixed": lambda: etsplat.Fixed(),
    "GeometryMetrics": lambda: etsplat.GeometryMetrics(0.1, 0.0, 0.1, 0.9, 1, 2),
    "Guard": lambda: etsplat.Guard(tolerance=0.1),
    "Harmonics": lambda: etsplat.Harmonics(0.5),
    "InputError": lambda: etsplat.InputError("mesh x: no such file"),
    "Laplacian": lambda: etsplat.Laplacian(0.5),
    "Lpips": lambda: etsplat.Lpips(),
    "MeshAppearance": lambda: etsplat.MeshAppearance("bilateral"),
    "MeshEnergies": lambda: etsplat.mesh_energies(MESH.vertices, MeshTopology.from_faces(MESH.faces, 42).connectivity),
    "MeshFile": lambda: MESH,
    "MeshTopology": lambda: MeshTopology.from_faces(MESH.faces, 42),
    "Georeference": lambda: etsplat.Georeference((1.0, 2.0, 3.0), 0.5, "z", "EPSG:25832"),
    "Normalization": lambda: etsplat.Normalization(torch.rand(3), 2.0),
    "NoteEvent": lambda: etsplat.NoteEvent("text"),
    "Objective": lambda: etsplat.Objective(etsplat.Photometric(0.2), [etsplat.EdgeLength(0.5)]),
    "Opacity": lambda: etsplat.Opacity(0.5),
    "Photometric": lambda: etsplat.Photometric(0.2, "l2"),
    "Outcome": lambda: etsplat.Outcome(_soup(), 250, 2, 30.0, 29.5),
    "Picture": lambda: PICTURES.picture(0),
    "PrepareEvent": lambda: etsplat.PrepareEvent(1, 2),
    "PruneRules": lambda: etsplat.PruneRules(views=3),
    "Rasterization": _rasterization,
    "ExportConfig": lambda: etsplat.ExportConfig(clean=True),
    "ReconstructConfig": lambda: etsplat.ReconstructConfig.demo(),
    "ReconstructResult": lambda: etsplat.ReconstructResult(Path("x"), MESH, {"psnr": 30.0}),
    "CameraRefinement": lambda: etsplat.CameraRefinement.of("poses", 1000, 40),
    "CamerasEvent": lambda: etsplat.CamerasEvent(100, 10, 100, 25.0, 26.0, True),
    "UndoEvent": lambda: etsplat.UndoEvent(10, 110, 0.1, 0.2),
    "RefineEvent": lambda: etsplat.RefineEvent(1, 2, 3),
    "RowPlan": lambda: etsplat.RowPlan.keeping(torch.tensor([True, False, True])),
    "Schedule": lambda: etsplat.Schedule({"vertices": 0.1}),
    "Size": lambda: etsplat.Size(0.5),
    "SmoothNormals": lambda: etsplat.SmoothNormals(0.5),
    "Softness": lambda: etsplat.Softness(0.5),
    "SoupAppearance": lambda: etsplat.SoupAppearance(sh_degree=2),
    "StartPoints": lambda: etsplat.StartPoints(torch.rand(5, 3), torch.rand(5, 3)),
    "StageEvent": lambda: etsplat.StageEvent("mesh", 1, 2),
    "StepEvent": lambda: etsplat.StepEvent(1, 2, 0.1, 0.2, {"faces": 3.0}, {}),
    "StoredPictures": lambda: PICTURES,
    "Strategy": lambda: etsplat.Strategy(),
    "SubdivideAndUntangle": lambda: etsplat.SubdivideAndUntangle({100: 500}),
    "TextureAppearance": lambda: etsplat.TextureAppearance(max_level=3),
    "TexturedMesh": _textured,
    "TrainConfig": lambda: etsplat.TrainConfig.tiny(),
    "TrainResult": lambda: etsplat.TrainResult(Path("x"), _soup(), {"psnr": 30.0}),
    "TriangleMesh": _mesh,
    "TriangleSoup": _soup,
    "TriangleStatistics": _statistics,
    "UniformSteps": lambda: etsplat.UniformSteps(0.5),
}
NO_VALUES = {
    "Custom": "holds a function of the caller's",
    "Drawing": "a step's model, photo and rendering, while its loss is computed",
    "LazyPictures": "holds a function of the caller's, and a pool of threads at work",
    "Scorer": "a device and a pool of threads at work",
    "Term": "what terms derive from",
    "Trainer": "at work; its state is in checkpoints",
}
"""Public classes that are not in the table, and why."""


def test_every_public_class_is_in_the_table_or_says_why_not() -> None:
    classes = {name for name in etsplat.__all__ if inspect.isclass(getattr(etsplat, name))}
    assert classes == set(VALUES) | set(NO_VALUES)


@pytest.mark.parametrize("name", VALUES)
@pytest.mark.parametrize("how", ["deepcopy", "pickle"])
def test_copies_are_equal_and_share_no_memory(name: str, how: str) -> None:
    value = VALUES[name]()
    assert type(value) is getattr(etsplat, name)
    if name == "MeshEnergies" or name == "Rasterization":
        value = _detached(value) if how == "deepcopy" else value  # torch copies no tensors within a graph
    again = copy.deepcopy(value) if how == "deepcopy" else pickle.loads(pickle.dumps(value))
    assert type(again) is type(value)
    mine, theirs = _contents(value), _contents(again)
    assert len(mine) > 0 or name in ("Fixed", "Strategy")
    assert [path for path, _ in mine] == [path for path, _ in theirs]
    for (path, one), (_, other) in zip(mine, theirs, strict=True):
        if isinstance(one, Tensor):
            assert torch.equal(one, other), path
            assert one.requires_grad == other.requires_grad or not one.is_leaf, path
            assert one.numel() == 0 or one.data_ptr() != other.data_ptr(), path
        else:
            assert one == other, path


def _detached(value: Any) -> Any:
    if isinstance(value, tuple):
        return type(value)(*(entry.detach() for entry in value))
    found = copy.copy(value)
    for entry in fields(found):
        tensor = getattr(found, entry.name)
        setattr(found, entry.name, tensor.detach() if isinstance(tensor, Tensor) else tensor)
    return found


def _contents(value: Any, path: str = "") -> list[tuple[str, Any]]:
    """Every tensor and plain value in it, with where it stands."""
    if isinstance(value, Tensor | str | int | float | bool | Path | type(None)):
        return [(path, value)]
    if isinstance(value, BaseException):
        return _contents(value.args, path)
    if isinstance(value, torch.nn.Module):
        return _contents(dict(value.state_dict()), path)
    if isinstance(value, dict):
        return [found for key in value for found in _contents(value[key], f"{path}[{key}]")]
    if isinstance(value, list | tuple | set | frozenset):
        ordered = sorted(value) if isinstance(value, set | frozenset) else value
        return [found for index, entry in enumerate(ordered) for found in _contents(entry, f"{path}[{index}]")]
    names = [entry.name for entry in fields(value)] if is_dataclass(value) else list(vars(value))
    return [found for name in names for found in _contents(getattr(value, name), f"{path}.{name}")]
