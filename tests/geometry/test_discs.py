"""Discs in the place of regions: what becomes of handles, loops and pinched vertices."""

import pytest
import torch
import trimesh

from etsplat.geometry.discs import with_discs
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import enclosed_volume, face_areas
from etsplat.geometry.parts import genera
from etsplat.geometry.topology import MeshTopology


def torus() -> tuple[torch.Tensor, torch.Tensor]:
    made = trimesh.creation.torus(1.0, 0.4, major_sections=48, minor_sections=24)
    return torch.from_numpy(made.vertices.copy()).float(), torch.from_numpy(made.faces.copy()).long()


def checked(vertices: torch.Tensor, faces: torch.Tensor, removed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    found, joined = with_discs(vertices, faces, removed)
    topology = MeshTopology.from_faces(joined, len(found))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()
    assert torch.equal(joined.unique(), torch.arange(len(found)))
    stays = vertices[faces[~removed]]
    assert torch.equal(found[joined[: len(stays)]], stays)
    return found, joined


def test_a_torus_without_a_piece_of_its_ring_is_a_bent_bar() -> None:
    vertices, faces = torus()
    middle = vertices[faces].mean(dim=1)
    removed = torch.atan2(middle[:, 1], middle[:, 0]).abs() < 0.5
    found, joined = checked(vertices, faces, removed)
    assert genera(faces, len(vertices)) == [1]
    assert genera(joined, len(found)) == [0]
    ends = joined[int((~removed).sum()) :]
    assert face_areas(found, ends).sum() == pytest.approx(2 * torch.pi * 0.4**2, rel=0.05)  # flat, both
    lengths = (found[ends] - found[ends.roll(1, dims=1)]).norm(dim=2)
    assert lengths.max() < 4 * (2 * torch.pi * 0.4 / 24)
    assert 0 < enclosed_volume(found, joined) < enclosed_volume(vertices, faces)


def test_a_torus_whose_hole_is_spanned_is_a_bun() -> None:
    """The band on the side of the hole goes, and a disc closes each of its two loops."""
    vertices, faces = torus()
    removed = vertices[faces].mean(dim=1)[:, :2].norm(dim=1) < 0.8
    found, joined = checked(vertices, faces, removed)
    assert genera(joined, len(found)) == [0]
    assert enclosed_volume(found, joined) > enclosed_volume(vertices, faces)


def test_a_disc_in_the_place_of_a_disc_changes_no_genus() -> None:
    vertices, faces = torus()
    removed = (vertices[faces].mean(dim=1) - torch.tensor([1.4, 0.0, 0.0])).norm(dim=1) < 0.3
    found, joined = checked(vertices, faces, removed)
    assert genera(joined, len(found)) == [1]


def test_a_ball_without_a_belt_is_two_caps() -> None:
    vertices, faces = icosphere(3)
    found, joined = checked(vertices, faces, vertices[faces].mean(dim=1)[:, 2].abs() < 0.4)
    assert genera(joined, len(found)) == [0, 0]


def test_where_regions_touch_in_a_vertex_each_has_its_loop() -> None:
    """Every second face around a vertex goes: that becomes one for each fan that stays."""
    vertices, faces = icosphere(2)
    around = (faces == int(faces[100, 0])).any(dim=1).nonzero()[:, 0]
    first = int(around[0])
    opposite = next(int(face) for face in around if len(set(faces[face].tolist()) & set(faces[first].tolist())) == 1)
    removed = torch.zeros(len(faces), dtype=torch.bool)
    removed[[first, opposite]] = True
    found, joined = checked(vertices, faces, removed)
    assert genera(joined, len(found)) == [0]
