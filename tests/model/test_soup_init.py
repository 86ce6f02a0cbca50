import math

import pytest
import torch

from etsplat.core.cameras import look_at, sphere_grid
from etsplat.core.validation import first_not_finite
from etsplat.model.soup_init import StartPoints, fibonacci_sphere, random_points, spacing, start_soup


def start(points: StartPoints, scale: float = 2.23):
    generator = torch.Generator().manual_seed(5)
    return start_soup(points, generator, scale=scale, opacity=0.28, sigma=1.16, sh_degree=3)


def cube(count: int) -> StartPoints:
    """Random points about the origin, seen from four sides at a distance of 4.03."""
    eyes = sphere_grid([20.0], [0.0, 90, 180, 270], 4.03, torch.float64)
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1, 0]))
    return random_points(count, viewmats, torch.Generator().manual_seed(0))


def test_random_points_fill_what_the_cameras_look_at():
    """Cameras of a NeRF-synthetic scene get its cube, with half side 1.3."""
    positions = cube(2000).positions
    assert float(positions.abs().max()) == pytest.approx(1.3, abs=0.01)
    assert float(positions.mean(dim=0).abs().max()) < 0.1


def test_spacing_is_the_mean_square_of_the_three_nearest():
    """On a unit lattice line the inner points have neighbours at 1, 1 and 2."""
    line = torch.arange(6.0)[:, None] * torch.tensor([[1.0, 0, 0]])
    values = spacing(line)
    assert float(values[2]) == pytest.approx(math.sqrt((1 + 1 + 4) / 3))
    assert float(values[0]) == pytest.approx(math.sqrt((1 + 4 + 9) / 3))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points_still_give_a_soup(count):
    """With fewer than four points there are fewer neighbours, and no NaN."""
    soup = start(cube(count))
    assert len(soup) == count
    assert first_not_finite(soup.parameters()) is None


def test_coincident_points_have_a_size():
    """Points that coincide get the smallest spacing rather than none."""
    assert float(spacing(torch.zeros(5, 3)).min()) == pytest.approx(math.sqrt(1e-7))


def test_triangles_are_right_angled_isosceles_about_their_points():
    """Legs sqrt(2) r, hypotenuse 2 r about the point, where r is the scaled spacing."""
    points = cube(50)
    soup = start(points)
    radius = 2.23 * spacing(points.positions)
    a, b, c = soup.vertices.detach().unbind(dim=1)
    torch.testing.assert_close((a + c) / 2, points.positions)
    torch.testing.assert_close((a - c).norm(dim=1), 2 * radius)
    torch.testing.assert_close((a - b).norm(dim=1), math.sqrt(2) * radius)
    torch.testing.assert_close(soup.display_colors(), points.colors)


def test_sky_reaches_the_farthest_coordinate_and_is_white():
    """Five percent more points on a sphere about the origin, in front of the others."""
    points = cube(100)
    with_sky = points.with_sky()
    assert len(with_sky) == 105
    torch.testing.assert_close(with_sky.positions[:5].norm(dim=1), points.positions.abs().max().expand(5))
    assert float(with_sky.colors[:5].min()) == 1
    torch.testing.assert_close(with_sky.positions[5:], points.positions)


def test_fibonacci_sphere_is_even():
    """Unit length, centred, and no two points closer than evenly spread ones would be."""
    sphere = fibonacci_sphere(400)
    torch.testing.assert_close(sphere.norm(dim=1), torch.ones(400))
    assert float(sphere.mean(dim=0).abs().max()) < 0.01
    assert float(spacing(sphere).min()) > 0.7 * math.sqrt(4 * math.pi / 400)
