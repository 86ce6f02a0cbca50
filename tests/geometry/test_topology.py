from itertools import combinations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from helpers.meshes import TETRAHEDRON_FACES as TETRAHEDRON

STRIP = torch.tensor([[0, 1, 2], [2, 1, 3], [2, 3, 4]])


@st.composite
def any_faces(draw):
    """Arbitrary triangles over few vertices: boundaries, non-manifold edges, flipped and duplicate faces included."""
    num_vertices = draw(st.integers(3, 9))
    triangle = st.lists(st.integers(0, num_vertices - 1), min_size=3, max_size=3, unique=True)
    return torch.tensor(draw(st.lists(triangle, min_size=1, max_size=14))), num_vertices


def edges_of(face):
    return [tuple(sorted((face[k], face[(k + 1) % 3]))) for k in range(3)]


@given(any_faces())
@settings(max_examples=150, deadline=None)
def test_tables_agree_with_a_plain_search(mesh):
    """Edges, face edges, faces of an edge, face pairs and neighbours are what nested loops over the faces find."""
    faces, num_vertices = mesh
    topology = MeshTopology.from_faces(faces, num_vertices)
    plain = faces.tolist()
    edges = sorted({edge for face in plain for edge in edges_of(face)})
    assert topology.edges.tolist() == [list(edge) for edge in edges]
    assert topology.face_edges.tolist() == [[edges.index(edge) for edge in edges_of(face)] for face in plain]
    pairs = []
    for e, edge in enumerate(edges):
        around = [f for f, face in enumerate(plain) if edge in edges_of(face)]
        assert topology.edge_faces[topology.edge_face_offsets[e] : topology.edge_face_offsets[e + 1]].tolist() == around
        pairs += [list(pair) for pair in combinations(around, 2)]
    assert topology.face_pairs.tolist() == pairs
    for v in range(num_vertices):
        neighbors = topology.neighbor_indices[topology.neighbor_offsets[v] : topology.neighbor_offsets[v + 1]]
        assert neighbors.tolist() == sorted({a + b - v for a, b in edges if v in (a, b)})


@pytest.mark.parametrize("level", [-1, 13, 2.0, True])
def test_a_sphere_that_no_memory_holds_is_refused(level):
    with pytest.raises(ValueError, match=f"level must be an integer from 0 to 12, got {level}"):
        icosphere(level)


@pytest.mark.parametrize("level", range(5))
def test_icosphere_is_a_closed_oriented_sphere(level):
    """Every level has the right counts, unit vertices, Euler characteristic 2, and normals that point outwards."""
    vertices, faces = icosphere(level)
    topology = MeshTopology.from_faces(faces, len(vertices))
    assert (len(faces), len(vertices)) == (20 * 4**level, 10 * 4**level + 2)
    assert (vertices.dtype, faces.dtype) == (torch.float32, torch.int64)
    torch.testing.assert_close(vertices.norm(dim=1), torch.ones(len(vertices)), rtol=0, atol=2e-7)
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()
    assert topology.euler_characteristic() == 2
    assert len(topology.face_pairs) == len(topology.edges) == 3 * len(faces) // 2
    a, b, c = vertices[faces].unbind(1)
    assert bool(((b - a).cross(c - a, dim=1) * (a + b + c)).sum(1).gt(0).all())


def test_icosphere_of_the_paper_has_its_published_edge_statistics():
    """Level 4: mean edge length 0.0755 and mean squared length 0.00572 at radius 1."""
    vertices, faces = icosphere(4)
    ends = vertices[MeshTopology.from_faces(faces, len(vertices)).edges]
    lengths = (ends[:, 0] - ends[:, 1]).norm(dim=1)
    assert float(lengths.mean()) == pytest.approx(0.0755, abs=5e-5)
    assert float(lengths.square().mean()) == pytest.approx(0.00572, abs=5e-6)


def test_open_strip_has_a_boundary():
    """A strip is manifold and oriented, not closed, and has the Euler characteristic of a disc."""
    topology = MeshTopology.from_faces(STRIP, 5)
    assert (topology.is_closed(), topology.is_manifold(), topology.is_oriented()) == (False, True, True)
    assert topology.euler_characteristic() == 1


def test_flipped_face_is_not_oriented():
    """Reversing one face of a closed surface breaks the orientation and nothing else."""
    faces = TETRAHEDRON.clone()
    faces[1] = faces[1].flip(0)
    topology = MeshTopology.from_faces(faces, 4)
    assert (topology.is_closed(), topology.is_manifold(), topology.is_oriented()) == (True, True, False)


def test_fin_and_pinched_vertex_are_not_manifold():
    """Three faces at one edge, and two cones that meet in a vertex, are not manifold."""
    fin = torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert not MeshTopology.from_faces(fin, 5).is_manifold()
    pinched = torch.cat([TETRAHEDRON, torch.where(TETRAHEDRON == 0, 0, TETRAHEDRON + 3)])
    topology = MeshTopology.from_faces(pinched, 7)
    assert (topology.is_closed(), topology.is_manifold(), topology.is_oriented()) == (True, False, True)


def test_components_are_counted_and_unused_vertices_are_not():
    """Two tetrahedra beside an unused vertex are two components with Euler characteristic 4."""
    topology = MeshTopology.from_faces(torch.cat([TETRAHEDRON + 1, TETRAHEDRON + 5]), 9)
    assert topology.components().tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert topology.euler_characteristic() == 4
    assert topology.is_manifold()


def test_empty_mesh_has_empty_tables():
    """No faces give empty tables and vacuous answers, no error."""
    topology = MeshTopology.from_faces(torch.zeros(0, 3, dtype=torch.int64), 0)
    assert len(topology.edges) == len(topology.face_pairs) == 0
    assert topology.is_closed()
    assert topology.is_manifold()
    assert len(topology.components()) == 0


def test_connectivity_is_int32_and_made_once():
    """The arrays for the mesh energies hold the same indices, are contiguous, and are made on the first use only."""
    topology = MeshTopology.from_faces(TETRAHEDRON, 4)
    for name in ("edges", "face_pairs", "faces", "neighbor_offsets", "neighbor_indices"):
        tensor = getattr(topology.connectivity, name)
        assert tensor.dtype == torch.int32
        assert tensor.is_contiguous()
        assert tensor.tolist() == getattr(topology, name).tolist()
    assert topology.connectivity is topology.connectivity


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (torch.tensor([[0, 1, 4]]), "faces must be indices from 0 to 3, got indices from 0 to 4"),
        (torch.tensor([[0, -1, 2]]), "got indices from -1 to 2"),
        (torch.tensor([[0, 1, 2], [2, 1, 2]]), r"faces must have three different vertices, got \[2, 1, 2\] for face 1"),
        (torch.tensor([[0, 1, 2, 3]]), "faces must have shape"),
        (torch.tensor([[0.0, 1.0, 2.0]]), "faces must be int32 or int64"),
    ],
)
def test_bad_faces_are_named(faces, message):
    """Wrong indices, repeated vertices, shapes and dtypes raise one line that says which and what is wanted."""
    with pytest.raises(ValueError, match=message):
        MeshTopology.from_faces(faces, 4)
