from dataclasses import replace

import pytest
import torch

from etsplat.model.triangle_soup import TriangleSoup


def soup(rng: torch.Generator, degree: int = 2) -> TriangleSoup:
    return TriangleSoup.from_triangles(
        torch.rand((5, 3, 3), generator=rng),
        torch.rand((5, 3), generator=rng),
        opacity=0.28,
        sigma=1.16,
        sh_degree=degree,
    )


def test_start_has_the_values_asked_for(rng):
    """Opacity, sigma and colours come back through the activations."""
    start = soup(rng)
    torch.testing.assert_close(start.opacities, torch.full((5,), 0.28))
    torch.testing.assert_close(start.sigma, torch.full((5,), 1.16))
    rng.manual_seed(20261121)
    torch.rand((5, 3, 3), generator=rng)
    colors = torch.rand((5, 3), generator=rng)
    torch.testing.assert_close(start.display_colors(), colors)
    torch.testing.assert_close(start.display_colors(torch.tensor([0.0, 0, 2])), colors)
    assert start.sh_degree == 2
    assert all(parameter.requires_grad for parameter in start.parameters().values())


def test_colors_depend_on_the_direction_once_the_bands_do(rng):
    """A coefficient of the z band brightens one side and darkens the other."""
    start = soup(rng)
    start.sh_rest.data[:, 1] = 0.1
    front, back = (start.display_colors(torch.tensor([0.0, 0.0, z])) for z in (1.0, -1.0))
    assert bool((front > back).all())


def test_wrong_shapes_are_refused(rng):
    """A tensor with another number of rows or bands is named."""
    parts = {name: value.detach() for name, value in soup(rng).parameters().items()}
    with pytest.raises(ValueError, match="sigma_raw"):
        TriangleSoup(**{**parts, "sigma_raw": torch.zeros(4)})
    with pytest.raises(ValueError, match="sh_rest"):
        TriangleSoup(**{**parts, "sh_rest": torch.zeros(5, 4, 3)})


def test_some_of_the_triangles_are_a_soup_of_the_same_kind(rng):
    """With its appearance and notes; detached."""
    whole = replace(soup(rng), notes={"iteration": "3"})
    rows = torch.tensor([True, False, False, True, True])
    some = whole.kept(rows)
    assert (len(some), some.notes, some.appearance) == (3, whole.notes, whole.appearance)
    for name, values in some.parameters().items():
        assert torch.equal(values, getattr(whole, name)[rows])
        assert not values.requires_grad


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"opacity": torch.full((3,), 0.5)}, r"opacity must be a number, got a tensor of shape \(3,\)"),
        ({"opacity": 1.0}, "opacity must be above 0 and below 1, got 1"),
        ({"sigma": 0.01}, r"sigma must be above 0\.01 and finite, got 0\.01"),
        ({"sigma": "soft"}, "sigma must be a number, got 'soft'"),
        ({"sh_degree": 4}, "sh_degree must be an integer from 0 to 3, got 4"),
    ],
)
def test_numbers_of_a_start_are_checked_where_it_is_made(given, message):
    """All triangles begin alike."""
    start = {"opacity": 0.5, "sigma": 0.5, "sh_degree": 0, **given}
    with pytest.raises(ValueError, match=message):
        TriangleSoup.from_triangles(torch.rand(5, 3, 3), torch.rand(5, 3), **start)
