"""Untangling as a whole; single piercings are in test_separation.py, what a run sees in tests/optim."""

import pytest
import torch
from torch import Tensor

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.intersections import intersecting_faces
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.untangle import untangle


def test_a_mesh_that_is_tangled_all_over_is_not_pushed_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its sheets have no sides, and looking at all pairs of its faces took minutes."""
    vertices, faces = icosphere(3)
    crumpled = vertices + 0.5 * torch.randn(vertices.shape, generator=torch.Generator().manual_seed(0))
    topology = MeshTopology.from_faces(faces, len(vertices))
    assert intersecting_faces(crumpled, faces).float().mean() > 0.5

    def push(*_: object) -> Tensor:
        raise AssertionError("pushed")

    monkeypatch.setattr("etsplat.geometry.untangle.separated", push)
    untangle(crumpled, topology)
