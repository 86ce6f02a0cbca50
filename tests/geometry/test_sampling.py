import math

import pytest
import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import face_areas
from etsplat.geometry.sampling import sample_surface

SQUARE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]])
FACES = torch.tensor([[0, 1, 2], [4, 4, 4], [0, 2, 3], [1, 1, 2]])
EXPECTED_FACES = [2, 2, 2, 0, 0, 2]
EXPECTED_POINT = ["0x1.0c2fa412f3eb8p-3", "0x1.cc7a498f9d358p-1"]


def test_same_seed_gives_the_same_points_and_another_seed_others():
    """A seed fixes the points to the bit; the first ones are written down here, so that machines can be compared."""
    points, faces = sample_surface(SQUARE, FACES, 1000, 7)
    again, _ = sample_surface(SQUARE.double(), FACES.int(), 1000, 7)
    other, _ = sample_surface(SQUARE, FACES, 1000, (7, 1))
    assert torch.equal(points, again)
    assert not torch.equal(points, other)
    assert (points.dtype, faces.dtype) == (torch.float64, torch.int64)
    assert faces[:6].tolist() == EXPECTED_FACES
    assert [value.hex() for value in points[0, :2].tolist()] == EXPECTED_POINT


def test_points_lie_in_their_faces_and_faces_without_area_get_none():
    """Every point satisfies its face's inequalities, and zero-area faces are never drawn."""
    points, faces = sample_surface(SQUARE, FACES, 20_000, 0)
    assert set(faces.tolist()) == {0, 2}
    x, y, z = points.unbind(1)
    assert bool((z == 0).all())
    assert bool(torch.where(faces == 0, (x >= y) & (x <= 1) & (y >= 0), (y >= x) & (y <= 1) & (x >= 0)).all())


def test_density_is_uniform_in_area():
    """Counts per face follow the areas (chi-squared), and mean and variance inside a triangle are the uniform ones."""
    vertices, faces = icosphere(2)
    vertices = vertices * torch.tensor([1.0, 2.0, 5.0])
    count = 200_000
    _, face = sample_surface(vertices, faces, count, 1)
    expected = face_areas(vertices.double(), faces)
    expected = expected / expected.sum() * count
    chi_squared = float(((torch.bincount(face, minlength=len(faces)) - expected) ** 2 / expected).sum())
    assert abs(chi_squared - len(faces)) < 5 * math.sqrt(2 * len(faces))
    points, _ = sample_surface(SQUARE, FACES[:1], count, 2)
    torch.testing.assert_close(points.mean(0), torch.tensor([2 / 3, 1 / 3, 0]).double(), rtol=0, atol=3e-3)
    torch.testing.assert_close(points.var(0), torch.tensor([1 / 18, 1 / 18, 0]).double(), rtol=0, atol=1e-3)


def test_surface_without_area_is_refused():
    """No faces, only degenerate faces, or NaN vertices raise instead of returning garbage."""
    for vertices, faces in [(SQUARE, FACES[:0]), (SQUARE, FACES[1:2]), (SQUARE / 0, FACES)]:
        with pytest.raises(ValueError, match="vertices and faces must be a"):
            sample_surface(vertices, faces, 10, 0)
    points, face = sample_surface(SQUARE, FACES, 0, 0)
    assert points.shape == (0, 3)
    assert face.shape == (0,)
