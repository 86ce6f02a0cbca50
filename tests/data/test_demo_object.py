import numpy as np
import pytest
import torch

from etsplat.data.demo_object import demo_object
from etsplat.data.meshing import dual_contour
from etsplat.geometry.measures import enclosed_volume
from etsplat.geometry.topology import MeshTopology


@pytest.fixture(scope="module")
def owl():
    return demo_object()


def solid(vertices, faces):
    """The topology of what is closed, manifold and oriented."""
    topology = MeshTopology.from_faces(torch.as_tensor(faces), len(vertices))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()
    return topology


def test_the_demo_object_is_one_closed_manifold_of_genus_0(owl):
    topology = solid(owl.vertices, owl.faces)
    assert topology.euler_characteristic() == 2
    assert int(topology.components().max()) == 0


def test_the_demo_object_faces_outwards_and_has_the_promised_size(owl):
    assert enclosed_volume(owl.vertices, owl.faces) > 1
    assert 10_000 <= len(owl.faces) <= 20_000
    assert owl.face_colors is not None
    assert owl.face_colors.shape == (len(owl.faces), 3)
    assert bool((owl.face_colors == 1).all())


def test_the_demo_object_has_creases_rounds_and_concavities(owl):
    """Edges by the turn of the normal across them: many nearly flat ones, many sharp ones, inward and outward."""
    v, f = owl.vertices.double(), owl.faces
    corners = v[f]
    normal = torch.nn.functional.normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=1
    )
    pairs = MeshTopology.from_faces(f, len(v)).face_pairs
    one, other = pairs[:, 0], pairs[:, 1]
    turn = (normal[one] * normal[other]).sum(1)
    outward = ((corners[other].mean(1) - corners[one].mean(1)) * normal[one]).sum(1) < 0
    sharp = turn < 0.7
    assert int((sharp & outward).sum()) > 500
    assert int((sharp & ~outward).sum()) > 200
    assert int((turn > 0.98).sum()) > 5000


def test_the_demo_object_is_the_same_every_time(owl):
    again = demo_object()
    assert torch.equal(again.vertices, owl.vertices)
    assert torch.equal(again.faces, owl.faces)


def test_dual_contouring_reproduces_a_box_exactly():
    """Corners and edges off the grid come out where they are: the meeting point of the planes is solved for."""
    half = np.array([0.613, 0.407, 0.511])
    v, f = dual_contour(lambda p: (np.abs(p) - half).max(axis=1), (-1, -1, -1), 0.1, (20, 20, 20))
    solid(v, f)
    assert enclosed_volume(torch.from_numpy(v), torch.from_numpy(f)) == pytest.approx(8 * half.prod(), rel=1e-9)
    np.testing.assert_allclose(v.max(axis=0), half, atol=1e-9)


def test_dual_contouring_keeps_two_sheets_in_one_cell_apart():
    """Two balls with a gap narrower than a cell stay two closed surfaces; one vertex per cell would join them."""

    def balls(p):
        return np.minimum(*(np.linalg.norm(p - [x, 0.013, 0.021], axis=1) - 0.4 for x in (-0.43, 0.43)))

    v, f = dual_contour(balls, (-1, -1, -1), 0.09, (23, 23, 23))
    assert solid(v, f).euler_characteristic() == 4


def test_a_surface_at_the_border_of_the_box_is_refused():
    with pytest.raises(ValueError, match="reaches the border"):
        dual_contour(lambda p: np.linalg.norm(p, axis=1) - 1.1, (-1, -1, -1), 0.1, (20, 20, 20))
