import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from etsplat.geometry.flips import flipped
from etsplat.geometry.measures import enclosed_volume
from etsplat.geometry.topology import MeshTopology
from helpers.meshes import bumpy_sphere


def flip(vertices, faces):
    return flipped(vertices, MeshTopology.from_faces(torch.as_tensor(faces), len(vertices)))


def edge_set(faces):
    return {frozenset(pair) for a, b, c in faces.tolist() for pair in ((a, b), (b, c), (c, a))}


def opposite_angles(vertices, faces):
    """Sum of the angles opposite to each edge."""
    topology = MeshTopology.from_faces(faces, len(vertices))
    corners = vertices[faces].double()
    sums = torch.zeros(len(topology.edges), dtype=torch.float64)
    for k in range(3):
        apex = corners[:, (k + 2) % 3]
        one, other = corners[:, k] - apex, corners[:, (k + 1) % 3] - apex
        cosine = (one * other).sum(1) / one.norm(dim=1) / other.norm(dim=1)
        sums.index_add_(0, topology.face_edges[:, k], cosine.clamp(-1, 1).arccos())
    return sums


def a_grid(side, rng):
    """Of flat squares whose corners are shaken, all halved in the same direction."""
    steps = torch.arange(side, dtype=torch.float64)
    vertices = torch.cartesian_prod(steps, steps)
    vertices = torch.cat([vertices, torch.zeros(len(vertices), 1)], dim=1)
    inside = ((vertices[:, :2] > 0) & (vertices[:, :2] < side - 1)).all(1)
    vertices[inside, :2] += 0.45 * (torch.rand(int(inside.sum()), 2, generator=rng, dtype=torch.float64) - 0.5)
    corner = (side * torch.arange(side - 1)[:, None] + torch.arange(side - 1)).flatten()
    below, above = [corner, corner + side, corner + 1], [corner + side, corner + side + 1, corner + 1]
    return vertices, torch.cat([torch.stack(below, dim=1), torch.stack(above, dim=1)])


def test_of_a_quad_the_short_diagonal_is_taken_and_rows_keep_the_orientation():
    vertices = torch.tensor(
        [[-2.0, 0, 0], [2, 0, 0], [0, 1, 0], [0, -1, 0], [-4, 4, 0], [4, 4, 0], [-4, -4, 0], [4, -4, 0]]
    )
    ring = [[0, 2, 4], [2, 5, 4], [2, 1, 5], [0, 6, 3], [3, 6, 7], [3, 7, 1]]
    found = flip(vertices, [[0, 1, 2], [1, 0, 3], *ring])
    assert [sorted(row) for row in found[:2].tolist()] == [[1, 2, 3], [0, 2, 3]]
    corners = vertices[found[:2]]
    assert (torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()


def test_in_the_plane_the_result_is_a_delaunay_triangulation(rng):
    """Opposite angles make half a circle at most, but for the margin; the area is covered once."""
    vertices, faces = a_grid(12, rng)
    assert (opposite_angles(vertices, faces) > 1.02 * torch.pi).any()
    found = flip(vertices, faces)
    topology = MeshTopology.from_faces(found, len(vertices))
    free = (topology.neighbor_offsets.diff()[topology.edges] > 3).all(1)
    assert (opposite_angles(vertices, found)[free] < 1.02 * torch.pi).all()
    corners = vertices[found]
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert (areas > 0).all()
    assert areas.sum().item() == pytest.approx(121)


@given(st.integers(1, 3), st.integers(0, 99), st.floats(0.5, 4))
@settings(max_examples=25, deadline=None)
def test_closed_meshes_stay_what_they_are(level, seed, stretch):
    """Closed, manifold, oriented, with the same holes and parts, and of the same volume but for what is nearly flat."""
    vertices, faces = bumpy_sphere(level, seed)
    vertices = vertices * torch.tensor([stretch, 1.0, 1.0])
    found = flip(vertices, faces)
    topology = MeshTopology.from_faces(found, len(vertices))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()
    assert topology.euler_characteristic() == 2
    assert enclosed_volume(vertices, found) == pytest.approx(enclosed_volume(vertices, faces), rel=0.1)
    assert torch.equal(found, flip(vertices, faces))


def test_no_ridge_is_cut_off():
    """The same quad, folded along its long diagonal by a right angle."""
    flat = torch.tensor(
        [[-2.0, 0, 0], [2, 0, 0], [0, 1, 0], [0, -1, 0], [-4, 4, 0], [4, 4, 0], [-4, -4, 0], [4, -4, 0]]
    )
    folded = torch.stack([flat[:, 0], flat[:, 1], flat[:, 1].abs()], dim=1)
    ring = [[0, 2, 4], [2, 5, 4], [2, 1, 5], [0, 6, 3], [3, 6, 7], [3, 7, 1]]
    assert frozenset((0, 1)) in edge_set(flip(folded, [[0, 1, 2], [1, 0, 3], *ring]))
    assert frozenset((0, 1)) not in edge_set(flip(flat, [[0, 1, 2], [1, 0, 3], *ring]))


@pytest.mark.parametrize("last", [[1, 0, 3], [0, 1, 3]], ids=["valence", "orientation"])
def test_edges_that_cannot_be_turned_stay(last):
    """Those of vertices that would be left with fewer than three edges, and between faces that do not agree."""
    vertices = torch.tensor([[-2.0, 0, 0], [2, 0, 0], [0, 1, 0], [0, -1, 0]])
    faces = torch.tensor([[0, 1, 2], last])
    assert torch.equal(flip(vertices, faces), faces)


def test_a_third_face_holds_an_edge():
    vertices, faces = a_grid(4, torch.Generator().manual_seed(0))
    vertices[:, 0] *= 3
    turned = edge_set(faces) - edge_set(flip(vertices, faces))
    assert turned
    for edge in turned:
        a, b = sorted(edge)
        apex = torch.cat([vertices, torch.tensor([[0.0, 0.0, 1.0]])])
        finned = torch.cat([faces, torch.tensor([[a, b, len(vertices)]])])
        assert edge in edge_set(flip(apex, finned))


def test_a_wrong_number_of_vertices_is_refused():
    vertices, faces = bumpy_sphere(0, 0)
    with pytest.raises(ValueError, match="vertices"):
        flipped(vertices[:-1], MeshTopology.from_faces(faces, len(vertices)))
