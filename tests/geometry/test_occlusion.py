import pytest
from torch.nn.functional import normalize

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.occlusion import ambient_occlusion

VERTICES, FACES = icosphere(4)


def test_nothing_shades_a_ball() -> None:
    points = VERTICES[FACES[::50]].mean(dim=1)
    normals = normalize(points, dim=1)
    found = ambient_occlusion(7 * VERTICES + 3, FACES, 7 * points + 3, normals, directions=48, width=256)
    assert found.min() > 0.99


@pytest.mark.parametrize("opening", [0.25, 0.5, 0.75])
def test_light_in_a_bowl_is_the_part_of_the_sphere_that_is_missing(opening: float) -> None:
    """The form factor of a cap of a sphere, seen from anywhere within it, is its part of the sphere's area."""
    middles = VERTICES[FACES].mean(dim=1)
    bowl = FACES[middles[:, 2] < 1 - 2 * opening]
    points = VERTICES[bowl].mean(dim=1)
    lower = points[:, 2] < 0.7 - 2 * opening  # away from the brim, which is a zigzag
    assert lower.sum() > 20
    found = ambient_occlusion(VERTICES, bowl, points[lower], -normalize(points[lower], dim=1), width=512)
    assert (found - opening).abs().mean() < 0.02
    assert (found - opening).abs().max() < 0.06


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match="normals"):
        ambient_occlusion(VERTICES, FACES, VERTICES, VERTICES[1:])
