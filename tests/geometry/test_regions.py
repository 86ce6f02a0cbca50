"""Regions to crop to, and how they are written."""

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.geometry.regions import Box, Sphere, region_of


def test_a_sphere_holds_what_is_within_its_radius() -> None:
    """The border belongs to it."""
    region = region_of("sphere:1,0,-2,0.5")
    assert region == Sphere((1.0, 0.0, -2.0), 0.5)
    points = torch.tensor([[1.0, 0, -2], [1.5, 0, -2], [1.51, 0, -2], [0, 0, 0]])
    assert region.holds(points).tolist() == [True, True, False, False]


def test_a_box_is_given_by_any_two_opposite_corners() -> None:
    """Each pair of coordinates is put in order."""
    region = region_of("box:1,-1,3,-1,1,2")
    assert region == Box((-1.0, -1.0, 2.0), (1.0, 1.0, 3.0))
    points = torch.tensor([[0.0, 0, 2.5], [1, 1, 3], [0, 0, 1.9], [1.1, 0, 2.5]])
    assert region.holds(points).tolist() == [True, True, False, False]


@pytest.mark.parametrize("text", ["sphere:1,-2.5,3e-05,4", "box:-1,-2,-3,1,2,3.5"])
def test_a_region_is_written_as_it_is_read(text: str) -> None:
    assert str(region_of(text)) == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sphere:1,2,3", "write auto, sphere:X,Y,Z,R or box:X0,Y0,Z0,X1,Y1,Z1"),
        ("box:1,2,3,4,5,x", "write auto, sphere"),
        ("ball:1,2,3,4", "write auto, sphere"),
        ("", "write auto, sphere"),
        ("sphere:0,0,nan,1", "finite numbers"),
        ("sphere:0,0,0,-1", "a sphere of radius -1; the radius must be above 0"),
        ("box:0,0,0,1,0,1", "a box without an inside; its corners must differ along every axis"),
    ],
)
def test_what_is_no_region_is_refused_with_the_forms_that_there_are(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        region_of(text, "--crop")
    assert str(error.value).startswith("--crop: is ")
