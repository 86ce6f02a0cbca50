from fractions import Fraction
from itertools import combinations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from etsplat.engines.threads import set_num_threads
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.intersections import count_degenerate_faces, count_self_intersections, intersecting_faces
from etsplat.geometry.measures import bounding_ball
from helpers.meshes import FAMOUS, TETRAHEDRON, bumpy_sphere, read_obj

# The oracle: the definition in rational arithmetic, by clipping instead of by orientation signs.


def subtract(a, b):
    return [x - y for x, y in zip(a, b, strict=True)]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def blend(a, b, t):
    return [x + t * (y - x) for x, y in zip(a, b, strict=True)]


def normal(t):
    return cross(subtract(t[1], t[0]), subtract(t[2], t[0]))


def clip(polygon, height):
    """The part of a polygon (or segment) where the linear function `height` is positive or zero."""
    kept = []
    for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        if height(a) >= 0:
            kept.append(a)
        if height(a) * height(b) < 0:
            kept.append(blend(a, b, height(a) / (height(a) - height(b))))
    return kept


def interiors_meet(s, t):
    s_normal, t_normal = normal(s), normal(t)
    if not any(s_normal) or not any(t_normal):
        return False
    edges = [(t[k], cross(t_normal, subtract(t[(k + 1) % 3], t[k]))) for k in range(3)]
    heights = [dot(t_normal, subtract(v, t[0])) for v in s]
    if not any(heights):
        polygon = s
        for origin, inward in edges:
            polygon = clip(polygon, lambda p, o=origin, n=inward: dot(n, subtract(p, o)))
        return any(any(cross(subtract(b, polygon[0]), subtract(c, polygon[0]))) for b, c in combinations(polygon, 2))
    if min(heights) >= 0 or max(heights) <= 0:
        return False
    points = [v for v, h in zip(s, heights, strict=True) if h == 0]
    for (a, ha), (b, hb) in combinations(zip(s, heights, strict=True), 2):
        if ha * hb < 0:
            points.append(blend(a, b, ha / (ha - hb)))
    low, high = Fraction(0), Fraction(1)
    for origin, inward in edges:
        first, second = (dot(inward, subtract(p, origin)) for p in points)
        if first <= 0 and second <= 0:
            return False
        if first != second:
            t_zero = first / (first - second)
            low, high = (max(low, t_zero), high) if second > first else (low, min(high, t_zero))
    return low < high


def oracle(vertices, faces):
    triangles = [[[Fraction(x) for x in vertices[v].tolist()] for v in face] for face in faces.tolist()]
    marks = [False] * len(triangles)
    for i, j in combinations(range(len(triangles)), 2):
        if interiors_meet(triangles[i], triangles[j]):
            marks[i] = marks[j] = True
    return marks


@pytest.mark.sanitize
@given(
    st.lists(st.tuples(*[st.integers(0, 3)] * 3), min_size=3, max_size=8),
    st.lists(st.tuples(*[st.integers(0, 7)] * 3), min_size=2, max_size=5),
    st.sampled_from([(1.0, 0.0), (0.1, 0.3), (1e-5, 1.0), (1 / 3, -1e3)]),
)
@settings(max_examples=400, deadline=None)
def test_agrees_with_rational_arithmetic_in_special_position(points, faces, frame):
    """On small grids, where touching, coplanar, collinear and shared corners abound, every mark is the exact one.

    The frames make coordinates whose differences are exact, and ones where they are not.
    """
    scale, offset = frame
    vertices = torch.tensor(points, dtype=torch.float64) * scale + offset
    faces = torch.tensor(faces) % len(points)
    assert intersecting_faces(vertices, faces).tolist() == oracle(vertices, faces)


@pytest.mark.parametrize("amplitude", [0.1, 1.0])
def test_agrees_with_rational_arithmetic_on_a_crumpled_sphere(amplitude):
    """Shared edges and corners of a connected mesh count only where faces really cross."""
    vertices, faces = bumpy_sphere(1, 3, amplitude)
    expected = oracle(vertices, faces)
    assert intersecting_faces(vertices, faces).tolist() == expected
    assert any(expected) == (amplitude == 1.0)


def test_clean_meshes_have_none():
    """Icospheres, welded or not, and a flat grid have no intersection."""
    vertices, faces = icosphere(4)
    assert count_self_intersections(vertices, faces) == 0
    assert count_self_intersections(vertices[faces].reshape(-1, 3), torch.arange(3 * len(faces)).reshape(-1, 3)) == 0
    x, y = torch.meshgrid(torch.arange(9.0), torch.arange(9.0), indexing="ij")
    grid = torch.stack([x, y, 0.1 * x + 0.7 * y], dim=2).reshape(-1, 3)
    corner = (torch.arange(8)[:, None] * 9 + torch.arange(8)).reshape(-1, 1)
    cells = torch.cat([corner + torch.tensor([0, 9, 1]), corner + torch.tensor([1, 9, 10])])
    assert count_self_intersections(grid, cells) == 0


def test_needle_through_a_tetrahedron():
    """A needle piercing two faces of a tetrahedron: those two and the needle's three sides intersect, its base not."""
    vertices, faces = TETRAHEDRON
    needle = torch.tensor([[-3.0, 0.3, 0.1], [3, 0.31, 0.1], [3, 0.3, 0.11], [3, 0.29, 0.09]])
    marks = intersecting_faces(torch.cat([vertices, needle]), torch.cat([faces, faces + 4]))
    assert int(marks[:4].sum()) == 2
    assert marks[4:].tolist() == (faces == 0).any(dim=1).tolist()


def test_two_crossing_tetrahedra():
    """A tetrahedron and its mirror image (a stella octangula): all eight faces intersect."""
    vertices, faces = TETRAHEDRON
    assert count_self_intersections(torch.cat([vertices, -vertices]), torch.cat([faces, faces.flip(1) + 4])) == 8


def test_strip_folded_back_onto_itself():
    """Two coplanar triangles at a common edge intersect if they lie on the same side of it, and not if they do not."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.4, 0.7, 0], [0.5, -1, 0]])
    assert count_self_intersections(vertices, torch.tensor([[0, 1, 2], [1, 0, 3]])) == 2
    assert count_self_intersections(vertices, torch.tensor([[0, 1, 2], [1, 0, 4]])) == 0
    assert count_self_intersections(vertices, torch.tensor([[0, 1, 2], [0, 1, 2]])) == 2


def test_faces_that_share_a_corner_can_cross():
    """Of two triangles with a common corner, one cutting through the other counts and one standing on it does not."""
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [1, 1, 1], [1, 0.5, -1], [1, 0.5, 1]])
    assert count_self_intersections(vertices, torch.tensor([[0, 1, 2], [0, 4, 5]])) == 2
    assert count_self_intersections(vertices, torch.tensor([[0, 1, 2], [0, 3, 5]])) == 0


def test_touching_is_not_intersecting():
    """A tip that just touches a face, and faces without area, do not count."""
    vertices = torch.tensor([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, 0], [1, 1, 2], [2, 1, 2], [1, 1, -1]])
    assert count_self_intersections(vertices, torch.tensor([[0, 1, 2], [3, 4, 5]])) == 0
    assert count_self_intersections(vertices, torch.tensor([[0, 1, 2], [6, 4, 5]])) == 2
    assert count_self_intersections(vertices, torch.tensor([[0, 1, 2], [6, 4, 4]])) == 0


def test_threads_do_not_change_the_result():
    """The marks are the same for one thread and for several."""
    vertices, faces = bumpy_sphere(3, 0, 1.0)
    results = []
    for count in (1, 4):
        set_num_threads(count)
        results.append(intersecting_faces(vertices, faces))
    set_num_threads(0)
    assert torch.equal(*results)
    assert bool(results[0].any())


@pytest.mark.parametrize("name", FAMOUS)
def test_real_meshes_are_counted(shared_data, name):
    """The ten shared meshes have no degenerate face, and none but two have self-intersections."""
    vertices, faces = read_obj(shared_data / "famous" / f"{name}.obj")
    expected = {"cow-low-resolution": 3, "human_neutral": 324}.get(name, 0)
    assert count_self_intersections(vertices, faces) == expected
    assert count_degenerate_faces(vertices, faces) == 0


def test_degenerate_faces_are_counted_by_index_area_and_height():
    """Repeated indices, a tiny triangle and a sliver each count once; a small well-shaped triangle does not."""
    vertices = torch.tensor(
        [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1e-7, 0, 0], [0, 1e-7, 0], [1e-3, 0, 0], [0, 1e-3, 0], [0.5, 2e-7, 0]]
    )
    assert bounding_ball(vertices)[1] == pytest.approx(0.5**0.5)
    assert count_degenerate_faces(vertices, torch.tensor([[0, 1, 2], [0, 5, 6]])) == 0
    for face in ([0, 1, 1], [0, 3, 4], [0, 1, 7]):
        assert count_degenerate_faces(vertices, torch.tensor([[0, 1, 2], face])) == 1
    assert count_degenerate_faces(vertices, torch.zeros(0, 3, dtype=torch.int64)) == 0


def test_bad_arguments_are_named():
    """NaN vertices and wrong indices raise one line."""
    vertices, faces = TETRAHEDRON
    for count in (count_self_intersections, count_degenerate_faces):
        with pytest.raises(ValueError, match="vertices must be finite"):
            count(vertices / 0, faces)
        with pytest.raises(ValueError, match="faces must be indices"):
            count(vertices, faces - 1)
