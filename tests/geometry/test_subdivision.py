import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import enclosed_volume, face_areas
from etsplat.geometry.subdivision import longest_edge_plan
from etsplat.geometry.topology import MeshTopology
from helpers.meshes import bumpy_sphere, read_obj

TRIANGLE = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def subdivide(vertices, faces, budget, scores=None):
    topology = MeshTopology.from_faces(faces, len(vertices))
    scores = face_areas(vertices, faces) if scores is None else scores
    plan = longest_edge_plan(vertices, topology, scores, budget)
    return plan, plan.interpolate(vertices), plan.faces


def split_edges_by_a_plain_loop(vertices, topology, scores, budget):
    """The definition: faces by descending score, each at most once, until the budget is met."""
    lengths = (vertices[topology.edges[:, 0]] - vertices[topology.edges[:, 1]]).double().square().sum(1).tolist()
    used, split, count = set(), [], topology.num_faces
    for f in sorted(range(topology.num_faces), key=lambda f: (-float(scores[f]), f)):
        edge = min(topology.face_edges[f].tolist(), key=lambda e: (-lengths[e], e))
        group = topology.edge_faces[topology.edge_face_offsets[edge] : topology.edge_face_offsets[edge + 1]].tolist()
        if used & set(group):
            continue
        if count + len(group) > budget:
            break
        count += len(group)
        used |= set(group)
        split.append(edge)
    return sorted(split)


@given(st.integers(0, 2), st.integers(0, 99), st.integers(0, 700))
@settings(max_examples=40, deadline=None)
def test_selection_is_greedy_by_score(level, seed, budget):
    """The native selection splits the same edges as the definition written as a loop."""
    vertices, faces = bumpy_sphere(level, seed)
    faces = faces[: len(faces) - seed % 7]
    topology = MeshTopology.from_faces(faces, len(vertices))
    scores = face_areas(vertices, faces)
    plan = longest_edge_plan(vertices, topology, scores, budget)
    expected = topology.edges[split_edges_by_a_plain_loop(vertices, topology, scores, budget)]
    assert plan.new_vertices.tolist() == expected.tolist()


@pytest.mark.sanitize
@given(st.integers(0, 3), st.integers(0, 99), st.floats(0, 3))
@settings(max_examples=40, deadline=None)
def test_surface_and_topology_survive(level, seed, growth):
    """After a step the mesh is closed, manifold, oriented, of the same Euler characteristic, area and volume."""
    vertices, faces = bumpy_sphere(level, seed)
    budget = round(len(faces) * growth)
    plan, new_vertices, new_faces = subdivide(vertices.double(), faces, budget)
    topology = MeshTopology.from_faces(new_faces, len(new_vertices))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()
    assert topology.euler_characteristic() == 2
    assert len(new_faces) == len(faces) + 2 * len(plan.new_vertices) <= max(budget, len(faces))
    assert torch.equal(new_vertices[: len(vertices)].float(), vertices)
    areas, new_areas = face_areas(vertices.double(), faces), face_areas(new_vertices, new_faces)
    torch.testing.assert_close(torch.zeros_like(areas).index_add(0, plan.parent_face, new_areas), areas)
    assert enclosed_volume(new_vertices, new_faces) == pytest.approx(enclosed_volume(vertices, faces), rel=1e-6)


@given(st.integers(0, 99))
@settings(max_examples=10, deadline=None)
def test_each_face_is_split_at_most_once(seed):
    """A parent has one child or two, whatever the budget, and two children have half its area each."""
    vertices, faces = bumpy_sphere(3, seed)
    plan, new_vertices, new_faces = subdivide(vertices.double(), faces, 10**9)
    children = torch.bincount(plan.parent_face, minlength=len(faces))
    assert set(children.tolist()) == {1, 2}
    expected = face_areas(vertices.double(), faces)[plan.parent_face] / children[plan.parent_face]
    torch.testing.assert_close(face_areas(new_vertices, new_faces), expected)


def test_budget_is_met_exactly_on_a_closed_mesh():
    """Repeated steps towards an even budget end on it, and a further step changes nothing."""
    vertices, faces = bumpy_sphere(2, 0)
    for _ in range(4):
        _, vertices, faces = subdivide(vertices, faces, 1000)
    assert len(faces) == 1000
    plan, _, _ = subdivide(vertices, faces, 1001)
    assert plan.is_empty
    assert torch.equal(plan.faces, faces)
    assert torch.equal(plan.parent_face, torch.arange(1000))


def test_pair_across_the_longest_edge_becomes_four():
    """Two triangles whose common edge is the longest become four around its midpoint, with their orientation."""
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    plan, vertices, faces = subdivide(square, torch.tensor([[0, 1, 2], [0, 2, 3]]), 4)
    assert plan.new_vertices.tolist() == [[0, 2]]
    assert vertices[4].tolist() == [0.5, 0.5, 0.0]
    assert faces.tolist() == [[4, 1, 2], [0, 4, 3], [0, 1, 4], [4, 2, 3]]
    assert plan.parent_face.tolist() == [0, 1, 0, 1]


def test_boundary_edge_splits_one_face():
    """A lone triangle becomes two, and its corner values land on the right corners."""
    plan, vertices, faces = subdivide(TRIANGLE, torch.tensor([[2, 0, 1]]), 2)
    assert vertices[3].tolist() == [2.0, 0.5, 0.0]
    assert faces.tolist() == [[3, 0, 1], [2, 0, 3]]
    assert plan.inherit(torch.tensor([7])).tolist() == [7, 7]


def test_three_faces_around_an_edge_are_split_together():
    """Non-manifold input stays conforming: every face around the edge is split, or none."""
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [1, 1, 0], [1, -1, 0], [1, 0, 1]])
    fin = torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert subdivide(vertices, fin, 5)[0].is_empty
    plan, _, faces = subdivide(vertices, fin, 6)
    assert len(faces) == 6
    assert plan.new_vertices.tolist() == [[0, 1]]


def test_largest_score_goes_first():
    """With room for one pair only, the pair of the best-scored face is split."""
    vertices, faces = icosphere(1)
    scores = torch.zeros(80)
    scores[41] = 1
    plan, _, _ = subdivide(vertices, faces, 82, scores)
    assert 41 in plan.parent_face[80:].tolist()


@pytest.mark.parametrize("name", ["armadillo", "boot", "human_neutral"])
def test_real_meshes_keep_their_topology(shared_data, name):
    """Two steps on real meshes keep closedness, orientation, Euler characteristic and area, open ones included."""
    vertices, faces = read_obj(shared_data / "famous" / f"{name}.obj")
    before = MeshTopology.from_faces(faces, len(vertices))
    area = float(face_areas(vertices, faces).sum())
    for factor in (1.3, 2.0):
        _, vertices, faces = subdivide(vertices, faces, int(factor * len(faces)))
    after = MeshTopology.from_faces(faces, len(vertices))
    for check in ("is_closed", "is_manifold", "is_oriented", "euler_characteristic"):
        assert getattr(after, check)() == getattr(before, check)(), check
    assert float(face_areas(vertices, faces).sum()) == pytest.approx(area, rel=1e-9)


def test_bad_arguments_are_named():
    """Wrong shapes and NaN scores raise one line with the argument's name."""
    topology = MeshTopology.from_faces(torch.tensor([[0, 1, 2]]), 3)
    scores = torch.ones(1)
    with pytest.raises(ValueError, match="vertices must have shape"):
        longest_edge_plan(TRIANGLE[:2], topology, scores, 4)
    with pytest.raises(ValueError, match="scores must have shape"):
        longest_edge_plan(TRIANGLE, topology, torch.ones(2), 4)
    with pytest.raises(ValueError, match="scores must be finite"):
        longest_edge_plan(TRIANGLE, topology, scores / 0, 4)
    with pytest.raises(ValueError, match=r"budget_faces must be an integer of at least 0, got 4\.5"):
        longest_edge_plan(TRIANGLE, topology, scores, 4.5)
    with pytest.raises(ValueError, match="topology must be a MeshTopology, got MeshConnectivity: pass MeshTopology"):
        longest_edge_plan(TRIANGLE, topology.connectivity, scores, 4)
    plan = longest_edge_plan(TRIANGLE, topology, scores, 4)
    with pytest.raises(ValueError, match="a row for each of 3 vertices, got 2"):
        plan.interpolate(TRIANGLE[:2])
    with pytest.raises(ValueError, match="a row for each of 1 faces, got 3"):
        plan.inherit(TRIANGLE)
