"""Solids of cubes that touch each other or themselves."""

from itertools import product

import pytest
import torch
from torch import Tensor

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.manifold import taken_apart
from etsplat.geometry.topology import MeshTopology


def cubes(*places: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """The surface of unit cubes, the sides between two of them left out, with one vertex at each corner."""
    number: dict[tuple[int, ...], int] = {}
    faces = []
    for place, axis, side in product(places, range(3), range(2)):
        beyond = list(place)
        beyond[axis] += 2 * side - 1
        if tuple(beyond) in places:
            continue
        corners = []
        for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
            corner = list(place)
            corner[axis] += side
            corner[(axis + 1) % 3] += u
            corner[(axis + 2) % 3] += v
            corners.append(number.setdefault(tuple(corner), len(number)))
        a, b, c, d = corners if side else corners[::-1]
        faces += [[a, b, c], [a, c, d]]
    return torch.tensor(list(number), dtype=torch.float32), torch.tensor(faces)


def volume(vertices: Tensor, faces: Tensor) -> float:
    a, b, c = vertices[faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


PATH = [(0, 0), (0, 1), (1, 1)]


@pytest.mark.parametrize(
    ("places", "parts", "euler"),
    [
        ([(0, 0, 0), (1, 1, 0)], 2, 4),  # in an edge
        ([(0, 0, 0), (1, 1, 1)], 2, 4),  # in a vertex
        ([(0, 0, 0), (1, 1, 0), (0, 0, 2), (1, 1, 2)], 4, 8),  # in two edges on one line
        # Joined above: an arch, whose feet touch in an edge.
        ([(0, 0, 0), (1, 1, 0), *((x, y, 1) for x, y in PATH)], 1, 2),
        # Joined above and below: both ends of the edge stay one vertex, and it is divided. A ring, with a hole.
        ([(0, 0, 0), (1, 1, 0), *((x, y, z) for x, y in PATH for z in (-1, 1))], 1, 0),
        ([(0, 0, 0), (1, 1, 0), (0, 0, 1), (1, 1, 1), *((x, y, z) for x, y in PATH for z in (-1, 2))], 1, 0),
    ],
)
def test_what_touches_is_taken_apart(places: list[tuple[int, int, int]], parts: int, euler: int) -> None:
    vertices, faces = cubes(*places)
    assert not MeshTopology.from_faces(faces, len(vertices)).is_manifold()
    found, triangles = taken_apart(vertices, faces)
    topology = MeshTopology.from_faces(triangles, len(found))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()
    assert int(topology.components().max()) + 1 == parts
    assert topology.euler_characteristic() == euler
    assert len(triangles.unique()) == len(found)
    assert volume(found, triangles) == pytest.approx(len(places), abs=0.1)


def test_a_manifold_stays_as_it_is() -> None:
    vertices, faces = icosphere(1)
    found, triangles = taken_apart(vertices, faces)
    assert torch.equal(found, vertices)
    assert torch.equal(triangles, faces)


def test_an_open_surface_is_refused() -> None:
    vertices, faces = cubes((0, 0, 0), (1, 1, 0))
    with pytest.raises(ValueError, match="must bound a closed surface"):
        taken_apart(vertices, faces[1:])
