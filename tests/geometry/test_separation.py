"""Sheets that cross are found, told apart by what they enclose, and pushed apart by little."""

import pytest
import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.intersections import count_self_intersections, intersecting_faces
from etsplat.geometry.piercings import Piercings, find_piercings, outer_windings
from etsplat.geometry.separation import separated
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.untangle import untangle


def crossing(vertices: torch.Tensor, topology: MeshTopology) -> tuple[Piercings, list[int]]:
    """What pierces what, and the winding numbers outside of both sheets."""
    found = find_piercings(vertices, topology, intersecting_faces(vertices, topology.faces))
    return found, sorted(set(outer_windings(vertices, topology, found).tolist()))


def spheres(*placed: tuple[float, tuple[float, float, float]]) -> tuple[torch.Tensor, MeshTopology]:
    """Spheres by radius and centre, in one mesh, float64."""
    vertices, faces = icosphere(2)
    parts = [radius * vertices.double() + torch.tensor(center).double() for radius, center in placed]
    corners = torch.cat([faces + k * len(vertices) for k in range(len(parts))])
    return torch.cat(parts), MeshTopology.from_faces(corners, len(vertices) * len(parts))


def pillow(depth: float) -> tuple[torch.Tensor, MeshTopology]:
    """A sphere pressed flat, 0.02 to either side, with a dent of its upper side that is so much deeper."""
    vertices, faces = icosphere(4)
    vertices = vertices.double()
    upper = (vertices[:, 2] > 0) & (vertices[:, :2].norm(dim=1) < 0.4)
    vertices[:, 2] = 0.02 * vertices[:, 2].sign() * vertices[:, 2].abs().sqrt()
    vertices[upper, 2] -= 0.04 + depth
    return vertices, MeshTopology.from_faces(faces, len(vertices))


def test_an_edge_through_a_face_is_found_where_it_pierces() -> None:
    """One edge of a large triangle goes through another at known weights; the other way round nothing does."""
    vertices = torch.tensor([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, -1], [1, 1, 1], [9, 9, 5]]).double()
    topology = MeshTopology.from_faces(torch.tensor([[0, 1, 2], [3, 4, 5]]), 6)
    found = find_piercings(vertices, topology, torch.tensor([True, True]))
    pierced = [(topology.edges[edge].tolist(), int(face)) for edge, face in zip(found.edges, found.faces, strict=True)]
    assert ([3, 4], 0) in pierced
    at = found.weights[pierced.index(([3, 4], 0))]
    torch.testing.assert_close(at, torch.tensor([0.5, 0.25, 0.25]).double())


def test_nothing_is_found_where_nothing_is_marked() -> None:
    """A sphere has no piercings, and a round leaves it as it is."""
    vertices, topology = spheres((1.0, (0.0, 0.0, 0.0)))
    none = torch.zeros(topology.num_faces, dtype=torch.bool)
    assert len(find_piercings(vertices, topology, none).edges) == 0
    assert torch.equal(separated(vertices, topology, none), vertices)


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_winding_numbers_tell_overlap_from_inversion(turn: int) -> None:
    """Overlapping spheres: 0; the same inside of a larger one: 1; a pillow dented through its back: -1. Every way."""
    pair = ((0.5, (0.01, 0.02, 0.03)), (0.5, (0.41, 0.33, 0.24)))
    for expected, (vertices, topology) in {0: spheres(*pair), 1: spheres(*pair, (3.0, (0.0, 0.0, 0.0)))}.items():
        assert crossing(vertices.roll(turn, dims=1), topology)[1] == [expected]
    vertices, topology = pillow(0.01)
    assert crossing(vertices.roll(turn, dims=1), topology)[1] == [-1]


def test_what_is_thinner_than_nothing_is_turned_right_by_little() -> None:
    """The dent goes back through the back of the pillow: by about its depth, and nowhere else."""
    vertices, topology = pillow(0.003)
    assert count_self_intersections(vertices, topology.faces) > 0
    untangled, left = untangle(vertices.float(), topology)
    moved = (untangled - vertices).norm(dim=1)
    assert left == count_self_intersections(untangled, topology.faces) == 0
    assert float(moved.max()) < 0.02
    assert float(moved[vertices[:, :2].norm(dim=1) > 0.7].max()) < 1e-6
