"""Vertices that may move until faces cut through others by it."""

import pytest
import torch

from etsplat.geometry.held_back import around_folds, held_back
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.intersections import intersecting_faces


def test_what_cuts_through_nothing_stays_as_it_moved() -> None:
    vertices, faces = icosphere(2)
    moved = vertices * torch.tensor([1.3, 0.7, 1.0])
    assert torch.equal(held_back(moved, vertices, faces, torch.zeros(len(faces), dtype=torch.bool)), moved)


def test_corners_of_a_new_fold_go_back_and_all_else_stays() -> None:
    """One vertex of a sphere goes through it to the other side."""
    vertices, faces = icosphere(2)
    moved = 1.1 * vertices
    moved[0] = -1.3 * vertices[0]
    found = held_back(moved, vertices, faces, torch.zeros(len(faces), dtype=torch.bool))
    assert torch.equal(found[0], vertices[0])
    assert not bool(intersecting_faces(found, faces).any())
    assert float((found == moved).all(dim=1).float().mean()) > 0.8


def test_one_that_goes_back_takes_what_it_would_cut_through_with_it() -> None:
    """Two spheres in one grow together; where the inner one grows a vertex too far, the outer one alone goes back."""
    inner, faces = icosphere(2)
    vertices, faces = torch.cat([inner, 1.05 * inner]), torch.cat([faces, faces + len(inner)])
    moved = torch.cat([1.2 * inner, 1.26 * inner])
    moved[0] = 1.5 * inner[0]
    found = held_back(moved, vertices, faces, torch.zeros(len(faces), dtype=torch.bool))
    assert not bool(intersecting_faces(found, faces).any())
    assert torch.equal(found[0], vertices[0])
    assert not torch.equal(found, vertices)


def test_faces_that_are_spared_may_fold() -> None:
    vertices, faces = icosphere(2)
    moved = vertices.clone()
    moved[0] = -1.3 * vertices[0]
    assert torch.equal(held_back(moved, vertices, faces, torch.ones(len(faces), dtype=torch.bool)), moved)


def test_where_it_does_not_end_all_go_back(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = icosphere(2)
    moved = 1.1 * vertices
    moved[0] = -1.3 * vertices[0]
    monkeypatch.setattr("etsplat.geometry.held_back._LOOKS", 1)
    assert torch.equal(held_back(moved, vertices, faces, torch.zeros(len(faces), dtype=torch.bool)), vertices)


def test_a_fold_and_what_it_shares_corners_with_is_around_it() -> None:
    vertices, faces = icosphere(3)
    assert not bool(around_folds(vertices, faces).any())
    vertices[0] = -1.3 * vertices[0]
    folded = intersecting_faces(vertices, faces)
    corners = set(faces[folded].reshape(-1).tolist())
    expected = [not corners.isdisjoint(face) for face in faces.tolist()]
    assert 0 < sum(expected) < len(faces)
    assert around_folds(vertices, faces).tolist() == expected
