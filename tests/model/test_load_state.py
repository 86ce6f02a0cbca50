"""A model takes the tensors of another state, or says which of them does not fit and stays as it is."""

from typing import Any

import pytest
import torch
from torch import Tensor

import etsplat
from etsplat.model.model import Model


def _mesh(level: int = 1) -> etsplat.TriangleMesh:
    return etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(level), colors=0.5, opacity=0.9, sigma=0.3)


def _soup(level: int = 1) -> etsplat.TriangleSoup:
    vertices, faces = etsplat.icosphere(level)
    return etsplat.TriangleSoup.from_triangles(vertices[faces], 0.5, opacity=0.5, sigma=0.5, sh_degree=1)


def _textured(level: int = 1) -> etsplat.TexturedMesh:
    vertices, faces = etsplat.icosphere(level)
    return etsplat.TexturedMesh.from_mesh(vertices, faces, torch.rand(8, 8, 3), torch.rand(len(faces), 3, 2))


MODELS = {"mesh": _mesh, "soup": _soup, "textured": _textured}


@pytest.mark.parametrize("kind", MODELS)
def test_another_count_of_triangles_is_taken_whole(kind: str) -> None:
    model, finer = MODELS[kind](1), MODELS[kind](2)
    model.load_state(finer.state())
    assert model.count == finer.count
    camera = etsplat.orbit_cameras(8, 8, azimuths=1)[0]
    assert torch.equal(model.render(camera).color, finer.render(camera).color)


WRONG: list[tuple[str, dict[str, Any], str]] = [
    ("mesh", {"vertices": torch.zeros(5, 3)}, r"state\[vertices\] must have 42 rows beside the others, got 5"),
    ("mesh", {"vertices": torch.zeros(42, 2)}, r"state\[vertices\] must have shape \(rows, 3\), got \(42, 2\)"),
    ("mesh", {"log_sigma": torch.zeros(1)}, r"state\[log_sigma\] must have shape \(\), got \(1,\)"),
    ("mesh", {"colors": torch.zeros(42, 3)}, r"state\[colors\] must have 80 rows"),
    ("mesh", {"vertices": torch.zeros(42, 3).double()}, r"state\[vertices\] must be torch\.float32 as the model, got"),
    ("mesh", {"vertexes": torch.zeros(42, 3)}, "state must name some of vertices, .* got vertexes"),
    ("mesh", {"colors": torch.ones(80, 3), "faces": torch.full((80, 3), 42)}, "faces"),
    ("mesh", {"faces": [[0, 1, 2]]}, r"state\[faces\] must be a tensor of shape \(rows, 3\), got list"),
    ("soup", {"opacity_logits": torch.zeros(5)}, r"state\[opacity_logits\] must have 80 rows .*, got 5: load all tog"),
    ("soup", {"sh_rest": torch.zeros(80, 8, 3)}, r"state\[sh_rest\] must have shape \(rows, 3, 3\), got \(80, 8, 3\)"),
    ("soup", {"sh_dc": [0.5]}, r"state\[sh_dc\] must be a tensor of shape \(rows, 1, 3\), got list"),
    ("textured", {"face_uvs": torch.zeros(3, 3, 2)}, r"state\[face_uvs\] must have 80 rows"),
    ("textured", {"vertices": torch.zeros(5, 3)}, r"state\[vertices\] must have 42 rows"),
]


@pytest.mark.parametrize(("kind", "state", "message"), WRONG)
def test_what_does_not_fit_is_named_and_nothing_changes(kind: str, state: dict[str, Any], message: str) -> None:
    model: Model = MODELS[kind]()
    before: dict[str, Tensor] = {name: tensor.clone() for name, tensor in model.state().items()}
    with pytest.raises(ValueError, match=message):
        model.load_state(state)
    assert all(tensor.equal(before[name]) for name, tensor in model.state().items())


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("given", [None, ({}, {})])
def test_what_is_no_state_is_named(kind: str, given: Any) -> None:
    """As the pair that `apply_rows` returns, whose first is one."""
    with pytest.raises(ValueError, match=r"state must be a Mapping, got (None|tuple): a dict of tensors by name"):
        MODELS[kind]().load_state(given)
