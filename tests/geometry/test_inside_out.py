"""What is inside out is found, and turned right where it is; what is open is not taken for it."""

import pytest
import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.inside_out import inside_out, turned_out
from etsplat.geometry.intersections import count_self_intersections, intersecting_faces
from etsplat.geometry.measures import enclosed_volume
from etsplat.geometry.piercings import winding_numbers
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.untangle import untangle

PINCH = 1.13
"""Where along x the blade of `twisted` is thinner than nothing."""


def twisted(turn: int = 0) -> tuple[torch.Tensor, MeshTopology]:
    """A long blade, float64, whose upper and lower side change places at `PINCH`: its tip is inside out."""
    vertices, faces = icosphere(4)
    vertices = vertices.double() * torch.tensor([2.0, 0.5, 0.1]).double()
    vertices[:, 2] *= torch.tanh(3 * (PINCH - vertices[:, 0]))
    return vertices.roll(turn, dims=1), MeshTopology.from_faces(faces, len(vertices))


def wrong_in(vertices: torch.Tensor, topology: MeshTopology) -> torch.Tensor:
    return inside_out(vertices, topology, intersecting_faces(vertices, topology.faces))


def test_a_mesh_winds_once_around_what_is_inside() -> None:
    """Minus once if its faces look inwards; an open one counts as closed by a cone over its border."""
    vertices, faces = icosphere(3)
    vertices = vertices.double()
    points = torch.tensor([[0, 0, 0.8], [0.3, 0.2, 0.1], [0, 0, 1.2], [2.0, -1, 1], [0.1, 0, -0.5]]).double()
    for corners, sign in ((faces, 1), (faces.flip(1), -1)):
        found = winding_numbers(points, vertices, MeshTopology.from_faces(corners, len(vertices)))
        assert found.tolist() == [sign, sign, 0, 0, sign]
    for axis in range(3):
        half = faces[(vertices[faces][..., axis] >= 0).all(dim=1)]
        beside = torch.eye(3).double()[axis] * torch.tensor([[0.5], [-0.5], [1.5]]).double()
        found = winding_numbers(beside, vertices, MeshTopology.from_faces(half, len(vertices)))
        assert found.tolist() == [1, 0, 0]


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_the_tip_behind_a_pinch_is_inside_out(turn: int) -> None:
    """All of it but for faces that cross, and nothing else."""
    vertices, topology = twisted(turn)
    wrong, along = wrong_in(vertices, topology), vertices.roll(-turn, dims=1)[:, 0]
    assert bool(wrong[along > PINCH + 0.05].all())
    assert not bool(wrong[along < PINCH - 0.05].any())


def test_the_tip_is_turned_right_where_it_is() -> None:
    """Each vertex of it goes to the other side of the surface, which stays; the rest does not move."""
    vertices, topology = twisted()
    wrong = wrong_in(vertices, topology)
    turned = turned_out(vertices, topology, wrong)
    assert torch.equal(turned[~wrong], vertices[~wrong])
    mirrored = vertices * torch.tensor([1.0, 1.0, -1.0]).double()
    inner = wrong & (vertices[:, 0] > PINCH + 0.1)
    assert float((turned - mirrored)[inner].norm(dim=1).max()) < 0.02  # an edge is 0.1 long: faces are flat
    assert not bool(wrong_in(turned, topology)[vertices[:, 0] > PINCH + 0.1].any())


def test_untangling_keeps_a_tip_that_was_inside_out() -> None:
    """Before it was turned right, folds were pushed and smoothed over all of it, or stayed."""
    vertices, topology = twisted()
    assert count_self_intersections(vertices, topology.faces) > 0
    untangled, left = untangle(vertices.float(), topology, reach=0.5)
    assert left == count_self_intersections(untangled, topology.faces) == 0
    solid = vertices.clone()
    solid[:, 2] = vertices[:, 2] * torch.where(vertices[:, 0] > PINCH, -1.0, 1.0)
    assert enclosed_volume(untangled, topology.faces) > 0.98 * enclosed_volume(solid, topology.faces)
    assert float((untangled[:, 2].abs() - vertices[:, 2].abs()).abs().max()) < 0.02


def test_a_mesh_whose_faces_all_look_inwards_stays() -> None:
    """It has no parts that are inside out: it is as it was handed in."""
    vertices, topology = twisted()
    inverted = MeshTopology.from_faces(topology.faces.flip(1), len(vertices))
    assert not bool((wrong_in(vertices, inverted) & (vertices[:, 0] < PINCH - 0.05)).any())


def test_what_is_open_is_not_inside_out() -> None:
    """A bowl, and balls across its wall: rays from beside the wall leave through the opening."""
    vertices, faces = icosphere(3)
    vertices = vertices.double()
    count, middles = len(vertices), icosphere(0)[0].double()
    balls = [0.15 * vertices + middle for middle in middles]
    for axis in range(3):
        for side in (1, -1):
            bowl = faces[(side * vertices[faces][..., axis] > -0.6).all(dim=1)]
            corners = torch.cat([bowl, *(faces + count * (k + 1) for k in range(len(balls)))])
            topology = MeshTopology.from_faces(corners, count * (len(balls) + 1))
            assert not bool(wrong_in(torch.cat([vertices, *balls]), topology).any())
