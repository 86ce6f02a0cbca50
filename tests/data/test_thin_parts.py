"""Wires that are thinner than the cells of the grid that a hull is carved on."""

from itertools import product

import numpy as np
import pytest
import torch
import trimesh

from etsplat.data.dataset import Dataset
from etsplat.data.false_handles import silhouette_errors
from etsplat.data.photograph import photograph
from etsplat.data.photos import photos_of
from etsplat.data.thin_parts import ThinParts
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.parts import Shape, shape_of
from etsplat.geometry.topology import MeshTopology
from etsplat.io.mesh_files import MeshFile


def wire_cube(thickness: float) -> MeshFile:
    """The twelve edges of a cube as round wires."""
    corners = [np.array(corner) for corner in product((-0.55, 0.55), repeat=3)]
    pairs = [(a, b) for a, b in product(corners, corners) if (a != b).sum() == 1 and a.sum() < b.sum()]
    wires = [trimesh.creation.cylinder(thickness / 2, segment=pair, sections=8) for pair in pairs]
    balls = [trimesh.creation.icosphere(1, thickness / 2).apply_translation(corner) for corner in corners]
    whole = trimesh.util.concatenate([*wires, *balls])
    return MeshFile(torch.from_numpy(whole.vertices.copy()).float(), torch.from_numpy(whole.faces.copy()).long())


@pytest.fixture(scope="module")
def cage() -> Dataset:
    """Wires of three pixels."""
    return photograph(wire_cube(0.02), 300, 300, supersampling=2)


def test_a_hull_of_wires_thinner_than_its_cells_is_whole(cage: Dataset) -> None:
    assert shape_of(*visual_hull(cage, 6000)) != Shape(1, 5)
    vertices, faces = visual_hull(cage, 6000, thin=True)
    assert shape_of(vertices, faces) == Shape(1, 5)
    topology = MeshTopology.from_faces(faces, len(vertices))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert 4000 < len(faces) < 8000
    lost, added = silhouette_errors(photos_of(cage), vertices, faces).mean(dim=0).tolist()
    assert lost < 0.01
    assert added < 0.1


def ball(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points, axis=1) - 0.5


def test_what_cells_are_small_enough_for_has_no_skin() -> None:
    parts = ThinParts.of(ball, 24, 0.1)
    assert parts.skin.shape == (25, 25, 25)
    assert not parts.skin.any()
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (100, 3))
    np.testing.assert_array_equal(parts.skinned(points), ball(points))


@pytest.mark.parametrize("radius", [0.01, 0.03])
def test_a_wire_between_nodes_has_a_skin_that_reaches_them_and_vertices_go_back(radius: float) -> None:
    """Its length is along x, between y and z of nodes, where it stays away from a ball that is large enough."""

    def field(points: np.ndarray) -> np.ndarray:
        wire = np.maximum(np.linalg.norm(points[:, 1:] - 0.05, axis=1) - radius, np.abs(points[:, 0]) - 0.8)
        return np.minimum(wire, np.linalg.norm(points + np.array([0.0, 0.0, 0.6]), axis=1) - 0.35)

    parts = ThinParts.of(field, 24, 0.1)
    along = np.stack([np.linspace(-0.7, 0.7, 15), np.full(15, 0.0), np.full(15, 0.0)], axis=1)
    assert (field(along) > 0).all()
    assert (parts.skinned(along) < 0).all()
    far = np.array([[0.0, 0.0, -0.9], [0.0, 0.5, 0.5]])
    np.testing.assert_array_equal(parts.skinned(far), field(far))
    there = along + np.array([0.0, -0.03, 0.02])
    moved = parts.without_skin(there)
    np.testing.assert_allclose(field(moved), 0, atol=2e-3)
    assert np.abs(moved - there).max() < 0.15
    np.testing.assert_array_equal(parts.without_skin(far), far)
