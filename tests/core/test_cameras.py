"""Cameras follow the conventions of docs/conventions.md."""

import math

import numpy as np
import pytest
import torch

import etsplat
from etsplat import Cameras, intrinsics, look_at, orbit_cameras, sphere_grid

UP = torch.tensor([0.0, 1.0, 0.0])
ORIGIN = torch.zeros(3)


def project(viewmat, K, point):
    in_view = viewmat[:3, :3] @ point + viewmat[:3, 3]
    pixel = K @ (in_view / in_view[2])
    return pixel[:2], in_view[2]


@pytest.fixture
def cameras() -> Cameras:
    eyes = torch.tensor([[0.0, 0.0, 4.0], [3.0, 1.0, 0.0], [0.0, -2.0, -2.0]])
    return Cameras(look_at(eyes, ORIGIN, UP), intrinsics(40, 64, 48).expand(3, 3, 3), 64, 48)


def test_target_lands_in_the_middle_of_the_image(cameras):
    for viewmat, K, center in zip(cameras.viewmats, cameras.Ks, cameras.centers, strict=True):
        pixel, z = project(viewmat, K, ORIGIN)
        torch.testing.assert_close(pixel, torch.tensor([32.0, 24.0]))
        assert float(z) == pytest.approx(float(center.norm()), rel=1e-6)


def test_axes_are_opencvs():
    """From +z, world +x is to the right of the image and world +y is up, which is a smaller row."""
    viewmat = look_at(torch.tensor([0.0, 0.0, 4.0]), ORIGIN, UP)
    K = intrinsics(40, 64, 48)
    assert project(viewmat, K, torch.tensor([1.0, 0.0, 0.0]))[0][0] > 32
    assert project(viewmat, K, torch.tensor([0.0, 1.0, 0.0]))[0][1] < 24


def test_rotations_are_proper(cameras):
    rotation = cameras.viewmats[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(3, 3, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(3))


def test_centers_are_the_eyes(cameras):
    expected = torch.tensor([[0.0, 0.0, 4.0], [3.0, 1.0, 0.0], [0.0, -2.0, -2.0]])
    torch.testing.assert_close(cameras.centers, expected, atol=1e-6, rtol=0)


def test_intrinsics_span_the_field_of_view():
    """A ray at half the vertical field of view meets the image border."""
    K = intrinsics(40, 64, 48)
    ray = torch.tensor([0.0, math.tan(math.radians(20)), 1.0])
    torch.testing.assert_close((K @ ray)[1], torch.tensor(48.0))
    assert K[0, 0] == K[1, 1]


def test_indexing_always_gives_a_batch(cameras):
    assert len(cameras[1]) == 1
    assert len(cameras[1:]) == 2
    chosen = cameras[[2, 0]]
    torch.testing.assert_close(chosen.viewmats, cameras.viewmats[[2, 0]])
    assert (chosen.width, chosen.height) == (64, 48)


def test_scaling_keeps_what_is_seen(cameras):
    """A point keeps its relative place in the image, also where sizes are rounded."""
    scaled = cameras.scaled(0.3)
    assert (scaled.width, scaled.height) == (19, 14)
    point = torch.tensor([0.3, 0.2, 0.1])
    before, _ = project(cameras.viewmats[0], cameras.Ks[0], point)
    after, _ = project(scaled.viewmats[0], scaled.Ks[0], point)
    torch.testing.assert_close(before / torch.tensor([64.0, 48.0]), after / torch.tensor([19.0, 14.0]))


def test_to_changes_the_dtype(cameras):
    assert cameras.to(dtype=torch.float64).viewmats.dtype == torch.float64
    assert cameras.to(dtype=torch.float64).Ks.dtype == torch.float64


def test_sphere_grid_orders_azimuth_fastest_and_turns_about_y():
    points = sphere_grid([0, 90], [0, 90], 2.0)
    expected = torch.tensor([[0.0, 0, 2], [2, 0, 0], [0, 2, 0], [0, 2, 0]])
    torch.testing.assert_close(points, expected, atol=1e-6, rtol=0)


def test_bad_cameras_are_refused_by_name():
    K, viewmats = intrinsics(40, 4, 4)[None], torch.eye(4)[None]
    with pytest.raises(ValueError, match="viewmats"):
        Cameras(torch.eye(4), K, 4, 4)
    with pytest.raises(ValueError, match="Ks"):
        Cameras(viewmats, K.expand(2, 3, 3), 4, 4)
    with pytest.raises(ValueError, match="width"):
        Cameras(viewmats, K, 0, 4)
    with pytest.raises(ValueError, match="up"):
        look_at(torch.tensor([0.0, 2.0, 0.0]), ORIGIN, UP)
    with pytest.raises(ValueError, match="eye"):
        look_at(ORIGIN, ORIGIN, UP)
    with pytest.raises(ValueError, match="fov_y_degrees"):
        intrinsics(180, 4, 4)


@pytest.mark.parametrize("factor", [0, -1, math.nan, math.inf, -math.inf])
def test_cameras_are_scaled_by_positive_finite_factors_alone(factor):
    cameras = Cameras(torch.eye(4)[None], intrinsics(50, 9, 8)[None], 9, 8)
    with pytest.raises(ValueError, match="factor must be positive and finite"):
        cameras.scaled(factor)


@pytest.mark.parametrize("size", [[32], "32", None, True, 32.5, 0, 2**27])
def test_sizes_of_images_are_whole_numbers(size):
    viewmats, K = torch.eye(4)[None], intrinsics(50, 9, 8)
    for name, sizes in (("width", (size, 8)), ("height", (9, size))):
        with pytest.raises(ValueError, match=f"{name} must be an integer from 1 to 67108864, got"):
            Cameras(viewmats, K[None], *sizes)
        with pytest.raises(ValueError, match=f"{name} must be an integer from 1 to 67108864, got"):
            intrinsics(50, *sizes)


@pytest.mark.parametrize(("degrees", "got"), [("60", "a number, got '60'"), (True, "a number"), (180, "between")])
def test_a_field_of_view_is_a_number(degrees, got):
    with pytest.raises(ValueError, match=f"fov_y_degrees must be {got}"):
        intrinsics(degrees, 9, 8)


def test_there_are_as_many_cameras_as_there_are(cameras):
    """Also for loops over them, which end at an IndexError."""
    assert len(list(cameras)) == 3
    for index in (3, -4):
        with pytest.raises(IndexError, match=f"index of a camera must be below 3, as there are so many, got {index}"):
            cameras[index]


@pytest.mark.parametrize(
    ("odd", "text"),
    [
        ({"azimuths": 0}, "azimuths must be an integer of at least 1, got 0"),
        ({"azimuths": 2.0}, "azimuths must be an integer"),
        ({"elevations": ()}, "elevations must be degrees"),
        ({"elevations": (0.0, 90)}, "elevations must be degrees, none of them straight above or below"),
    ],
)
def test_an_orbit_has_cameras(odd, text):
    with pytest.raises(ValueError, match=text):
        orbit_cameras(9, 8, **odd)


def test_cameras_of_integers_are_refused():
    with pytest.raises(ValueError, match=r"viewmats must be of floating-point numbers, got torch\.int64"):
        Cameras(torch.eye(4)[None].long(), intrinsics(50, 9, 8)[None], 9, 8)


@pytest.mark.parametrize(
    ("odd", "text"),
    [
        ({"eye": torch.ones(5, 1)}, r"eye must have shape \(\.\.\., 3\)"),
        ({"eye": torch.ones(5, 3, dtype=torch.int64)}, "eye must be of floating-point numbers"),
        ({"target": torch.zeros(4, 3)}, r"target must have shape \(3,\) or that of eye, \(5, 3\), got \(4, 3\)"),
        ({"target": torch.zeros(2, 5, 3)}, "target must have shape"),
        ({"eye": torch.full((5, 3), math.nan)}, "eye must be finite, got 15 NaN"),
        ({"eye": torch.full((5, 3), math.inf)}, "eye must be finite"),
        ({"target": (0, 0, math.nan)}, "target must be finite"),
        ({"up": (0, math.inf, 0)}, "up must be finite"),
        ({"up": torch.ones(1)}, "up must have shape"),
        ({"up": None}, "up must be a tensor or three numbers, got None"),
        ({"up": "y"}, "up must be a tensor or three numbers, got 'y'"),
    ],
)
def test_what_cannot_be_looked_at_is_refused_by_name(odd, text):
    with pytest.raises(ValueError, match=text):
        look_at(**{"eye": torch.rand(5, 3) + 1, "target": torch.zeros(3), "up": (0, 1, 0), **odd})


@pytest.mark.parametrize("index", [2, -1, np.int64(2), np.array(2), torch.tensor(2)])
def test_one_camera_is_chosen_by_whole_numbers_of_every_library(cameras, index):
    one = cameras[index]
    assert len(one) == 1
    assert torch.equal(one.viewmats, cameras.viewmats[2:3])


def test_several_cameras_are_chosen_by_whatever_holds_their_indices(cameras):
    """A tuple too, which torch takes as an index for each axis; or by a mask."""
    mask = torch.tensor([True, False, True])
    for index in ((0, 2), [0, 2], np.array([0, 2]), torch.tensor([0, 2]), range(0, 3, 2), slice(0, 3, 2), mask):
        assert torch.equal(cameras[index].viewmats, cameras.viewmats[[0, 2]]), index


def test_cameras_can_be_looked_for(cameras):
    """They are compared as objects: tensors have no answer of one word."""
    one, other = cameras[0], cameras[0]
    assert [other, one].index(one) == 1
    assert one != other
    assert {one: "one"}[one] == "one"


def test_sizes_are_ints_whatever_they_were_given_as(cameras):
    made = Cameras(cameras.viewmats, cameras.Ks, torch.tensor(64), np.int32(48))
    assert (made.width, type(made.width), made.height, type(made.height)) == (64, int, 48, int)
    assert made.scaled(torch.tensor(0.5)).width == 32


@pytest.mark.parametrize(
    ("odd", "text"),
    [
        (lambda: Cameras.stacked([]), "cameras: expected at least one, got none"),
        (lambda: Cameras.stacked([torch.eye(4)]), r"cameras\[0\] must be Cameras, got a tensor of shape \(4, 4\)"),
        (lambda: sphere_grid([0.0], [0.0], "2"), "distance must be a number, got '2'"),
    ],
)
def test_what_cannot_be_stacked_or_placed_is_named(odd, text):
    with pytest.raises(ValueError, match=text):
        odd()


def test_an_image_that_no_memory_holds_is_refused(cameras):
    """By 2^18 x 2^18 pixels it ended in a MemoryError of native code, or in torch's words."""
    with pytest.raises(ValueError, match=r"at most 2147483648 pixels together, got 262144 x 262144: draw it in parts"):
        Cameras(cameras.viewmats, cameras.Ks, 1 << 18, 1 << 18)
    assert Cameras(cameras.viewmats, cameras.Ks, 1 << 26, 1 << 5).width == 1 << 26


def test_a_list_of_cameras_is_told_how_to_become_one(cameras):
    """As `Dataset.cameras[:3]` is."""
    mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(0), colors=0.5, opacity=0.9, sigma=0.3)
    with pytest.raises(ValueError, match=r"got list of them: pass etsplat\.Cameras\.stacked\(cameras\)"):
        mesh.render([cameras[0], cameras[1]])
    with pytest.raises(ValueError, match=r"got list: make them by etsplat\.Cameras\("):
        mesh.render([])
