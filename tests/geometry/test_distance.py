import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.geometry.distance import closest_places, closest_points
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.sampling import sample_surface
from helpers.meshes import TETRAHEDRON, bumpy_sphere, read_obj


def brute_force(points: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    """Squared distances (N, F): the plane where the foot of the perpendicular is inside, else the nearest edge."""
    corners = vertices.double()[faces]
    p = points.double()[:, None, None]
    side = corners.roll(-1, dims=1) - corners
    length2 = side.square().sum(2)
    t = ((p - corners) * side).sum(3) / torch.where(length2 > 0, length2, 1.0)
    foot = corners + t.clamp(0, 1)[..., None] * side
    best = (p - foot).square().sum(3).amin(2)
    u, v = side[:, 0], -side[:, 2]
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    determinant = uu * vv - uv * uv
    w = p[:, :, 0] - corners[:, 0]
    wu, wv = (w * u).sum(2), (w * v).sum(2)
    flat = determinant <= 1e-20 * (uu + vv) ** 2
    scale = torch.where(flat, 1.0, determinant)
    b, c = (vv * wu - uv * wv) / scale, (uu * wv - uv * wu) / scale
    inside = (b >= 0) & (c >= 0) & (b + c <= 1) & ~flat
    plane = (w - b[..., None] * u - c[..., None] * v).square().sum(2)
    return torch.where(inside, torch.minimum(plane, best), best)


def assert_exact(points, vertices, faces):
    squared, nearest = closest_points(points, vertices, faces)
    expected = brute_force(points, vertices, faces)
    torch.testing.assert_close(squared, expected.amin(1), rtol=1e-9, atol=1e-14)
    chosen = expected.gather(1, nearest[:, None])[:, 0]
    torch.testing.assert_close(chosen, expected.amin(1), rtol=1e-9, atol=1e-14)


@pytest.mark.sanitize
@given(st.integers(0, 999), st.sampled_from([0.0, 1e-3, 1.0, 100.0]))
@settings(max_examples=15, deadline=None)
def test_agrees_with_brute_force_on_a_soup(seed, spread):
    """Distances and faces are those of a search over all pairs, for points on, near and far from a triangle soup."""
    rng = torch.Generator().manual_seed(seed)
    vertices = torch.randn(60, 3, generator=rng)
    faces = torch.randint(60, (40, 3), generator=rng)  # some repeat a vertex: segments
    points = vertices.repeat(2, 1) + spread * torch.randn(120, 3, generator=rng)
    assert_exact(points, vertices, faces)


def test_agrees_with_brute_force_on_a_mesh(rng):
    """The same on a bumpy sphere, from inside, outside and far away."""
    vertices, faces = bumpy_sphere(3, 5)
    points = torch.randn(400, 3, generator=rng) * torch.tensor([0.1, 1.0, 10.0, 1.0]).repeat(100)[:, None]
    assert_exact(points, vertices, faces)


def test_degenerate_faces_are_segments_and_points():
    """A needle, a segment, a point and a needle of height 1e-15 have the distances of what they look like."""
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [1, 0, 0], [1, 1e-15, 0]], dtype=torch.float64)
    query = torch.tensor([[1.5, 3.0, 4.0], [-3.0, 0.0, 4.0], [3.0, 0.0, 0.0]])
    for face in ([0, 1, 2], [0, 1, 1], [0, 1, 3], [1, 0, 2]):
        squared, _ = closest_points(query, vertices, torch.tensor([face]))
        torch.testing.assert_close(squared, torch.tensor([25.0, 25.0, 1.0]).double(), rtol=1e-12, atol=0)
    squared, _ = closest_points(query, vertices, torch.tensor([[0, 0, 0]]))
    torch.testing.assert_close(squared, torch.tensor([27.25, 25.0, 9.0]).double())


def test_samples_lie_on_their_surface():
    """Points drawn from a surface are at distance zero from it, to rounding."""
    vertices, faces = icosphere(4)
    points, _ = sample_surface(vertices, faces, 5000, 0)
    squared, _ = closest_points(points, vertices, faces)
    assert float(squared.max()) < 1e-30


def test_equal_distances_give_the_smallest_index():
    """The centre of a regular tetrahedron is equally far from its four faces: the first is taken."""
    vertices, faces = TETRAHEDRON
    for shift in range(4):
        _, nearest = closest_points(torch.zeros(1, 3), vertices, faces.roll(shift, dims=0))
        assert nearest.tolist() == [0]


def test_threads_do_not_change_the_result(rng):
    """One thread and all threads give the same distances and faces, to the bit."""
    vertices, faces = bumpy_sphere(3, 1)
    points = torch.randn(3000, 3, generator=rng)
    all_cores = num_threads()
    results = []
    for count in (1, all_cores, 3):
        set_num_threads(count)
        results.append(closest_points(points, vertices, faces))
    set_num_threads(0)
    for squared, nearest in results[1:]:
        assert torch.equal(squared, results[0][0])
        assert torch.equal(nearest, results[0][1])


def test_real_mesh_agrees_with_brute_force(shared_data, rng):
    """On goathead, points near and far get the brute-force distances."""
    vertices, faces = read_obj(shared_data / "famous" / "goathead.obj")
    points, _ = sample_surface(vertices, faces, 60, 3)
    points = points + torch.randn(60, 3, generator=rng, dtype=torch.float64) * torch.logspace(-6, 1, 60)[:, None]
    assert_exact(points, vertices, faces)


def test_bad_arguments_are_named():
    """No faces, wrong shapes, NaN and wrong indices raise one line."""
    vertices, faces = TETRAHEDRON
    points = torch.zeros(1, 3)
    for arguments, message in [
        ((points, vertices, faces[:0]), "faces must not be empty"),
        ((points[0], vertices, faces), "points must have shape"),
        ((points / 0, vertices, faces), "points must be finite"),
        ((points, vertices / 0, faces), "vertices must be finite"),
        ((points, vertices, faces + 1), "faces must be indices"),
        ((points, vertices, faces.float()), "faces must be int32 or int64"),
    ]:
        with pytest.raises(ValueError, match=message):
            closest_points(*arguments)
    squared, nearest = closest_points(points[:0], vertices, faces)
    assert len(squared) == len(nearest) == 0


def test_places_are_where_the_nearest_points_are(rng: torch.Generator) -> None:
    """Inside of faces, on edges and at corners: weights sum to 1, and the distance is the exact one."""
    vertices, faces = bumpy_sphere(3, 0)
    points = torch.cat([1.5 * torch.randn(500, 3, generator=rng), vertices[:20], vertices[faces].mean(dim=1)[:20]])
    face, weights = closest_places(points, vertices, faces)
    squared, nearest = closest_points(points, vertices, faces)
    assert torch.equal(face, nearest)
    assert float(weights.min()) >= 0
    assert torch.allclose(weights.sum(dim=1), torch.ones(len(points), dtype=torch.float64))
    found = (weights[..., None] * vertices.double()[faces[face]]).sum(dim=1)
    assert torch.allclose((found - points).square().sum(dim=1), squared, rtol=1e-9, atol=1e-12)
    assert ((weights > 0).sum(dim=1).unique() == torch.tensor([1, 2, 3])).all()


def test_places_on_triangles_without_area() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    _, weights = closest_places(torch.tensor([[2.0, 1, 0], [-1, 0, 0]]), vertices, torch.tensor([[0, 1, 2]]))
    assert torch.allclose(weights @ vertices.double(), torch.tensor([[2.0, 0, 0], [0, 0, 0]], dtype=torch.float64))
