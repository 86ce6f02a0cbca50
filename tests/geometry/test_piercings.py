"""What the hierarchy of boxes finds is what looking at everything finds."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.intersections import IntersectionSearch, intersecting_faces
from etsplat.geometry.piercings import overlapping_boxes, winding_numbers
from etsplat.geometry.topology import MeshTopology
from helpers.meshes import bumpy_sphere


def pairs_by_looking(corners: Tensor, chosen: list[int]) -> list[tuple[int, int]]:
    """All pairs of chosen faces whose boxes have a point in common."""
    low, high = corners.amin(dim=1), corners.amax(dim=1)
    meet = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(dim=2)
    return sorted((a, b) for a in chosen for b in chosen if a < b and bool(meet[a, b]))


def winding_by_angles(point: Tensor, corners: Tensor) -> int:
    """By the solid angles of all faces, which is another way than counting along a ray."""
    a, b, c = (corners - point).unbind(1)
    x, y, z = a.norm(dim=1), b.norm(dim=1), c.norm(dim=1)
    volume = (a * torch.linalg.cross(b, c)).sum(dim=1)
    rest = x * y * z + (a * b).sum(dim=1) * z + (b * c).sum(dim=1) * x + (c * a).sum(dim=1) * y
    return round(float(torch.atan2(volume, rest).sum()) / (2 * torch.pi))


@pytest.mark.sanitize
@given(
    st.lists(st.tuples(*[st.integers(0, 4)] * 9), min_size=1, max_size=40),
    st.randoms(use_true_random=False),
)
@settings(max_examples=100, deadline=None)
def test_pairs_of_boxes_are_all_that_there_are(numbers: list[tuple[int, ...]], random) -> None:
    """On a small grid, where boxes are flat, touch and coincide; of some of the faces, each pair once."""
    corners = torch.tensor(numbers, dtype=torch.float64).reshape(-1, 3, 3)
    chosen = random.sample(range(len(corners)), random.randint(0, len(corners)))
    rows = torch.tensor(chosen, dtype=torch.int64)
    first, second = (rows[each] for each in overlapping_boxes(corners[rows]))
    found = sorted(tuple(sorted(pair)) for pair in zip(first.tolist(), second.tolist(), strict=True))
    assert found == pairs_by_looking(corners, chosen)


@pytest.mark.sanitize
@pytest.mark.parametrize("amplitude", [0.1, 1.0])
def test_windings_are_those_of_solid_angles(amplitude: float) -> None:
    """Also inside of what cuts through itself, and where a face is as wide as the mesh."""
    vertices, faces = bumpy_sphere(2, 3, amplitude)
    vertices = vertices.double()
    spike = vertices.clone()
    spike[0] = -5 * vertices[0]
    points = 0.7 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0)).double()
    seen = set()
    for mesh in (vertices, spike):
        expected = [winding_by_angles(point, mesh[faces]) for point in points]
        assert winding_numbers(points, mesh, MeshTopology.from_faces(faces, len(mesh))).tolist() == expected
        seen |= set(expected)
    assert len(seen) > (2 if amplitude == 1.0 else 1)


@pytest.mark.sanitize
@pytest.mark.parametrize("threads", [1, 3])
def test_a_search_marks_what_a_first_look_would(threads: int) -> None:
    """However few or many vertices moved since: none, one, a patch to and fro, all."""
    vertices, faces = icosphere(3)
    random = torch.Generator().manual_seed(1)
    before = num_threads()
    set_num_threads(threads)
    try:
        search, seen = IntersectionSearch(faces), set()
        for moved in (0, 0, 1, 0, 30, 200, 5, 1, 642, 2, 300, 0):
            rows = torch.randperm(len(vertices), generator=random)[:moved]
            vertices[rows] += 0.3 * torch.randn(moved, 3, generator=random)
            found = search(vertices)
            assert torch.equal(found, intersecting_faces(vertices, faces))
            seen.add(int(found.sum()))
        original = icosphere(3)[0]
        assert not bool(search(original).any())
        assert len(seen) > 4
    finally:
        set_num_threads(before)


def test_nothing_to_look_at() -> None:
    """No faces, and a single one."""
    assert [len(found) for found in overlapping_boxes(torch.zeros(0, 3, 3).double())] == [0, 0]
    vertices = torch.eye(3).double()
    one = MeshTopology.from_faces(torch.tensor([[0, 1, 2]]), 3)
    assert winding_numbers(torch.zeros(0, 3).double(), vertices, one).tolist() == []
    assert IntersectionSearch(torch.zeros(0, 3).long())(vertices).tolist() == []
    assert IntersectionSearch(one.faces)(vertices).tolist() == [False]
