"""Poses and lenses that can be read, and are told to be none of the photos'."""

import json

import pytest
import torch

from etsplat import look_at
from etsplat.data.load import load_dataset
from helpers.captures import UP, circle_poses, write_colmap, write_transforms

AWAY, ONE_PLACE = "hardly a camera has points of the scene before it", "all cameras are at one place"


def write_points(folder, offset=0.0):
    """A ball of points about the origin, which write_transforms looks at."""
    points = torch.randn(40, 3, generator=torch.Generator().manual_seed(1)) + offset
    head = "ply\nformat ascii 1.0\nelement vertex 40\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in points.tolist())
    (folder / "points.ply").write_text(f"{head}end_header\n{rows}")


def turned(document, signs):
    """With other axes of the cameras."""
    for frame in document["frames"]:
        matrix = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        frame["transform_matrix"] = (matrix @ torch.diag(torch.tensor([*signs, 1.0], dtype=torch.float64))).tolist()


@pytest.mark.parametrize(
    ("signs", "offset", "notes"),
    [((1.0, 1.0, 1.0), 0.0, ()), ((1.0, -1.0, -1.0), 0.0, (AWAY,)), ((1.0, 1.0, 1.0), 1e4, (AWAY,))],
)
def test_cameras_with_other_axes_see_no_points(tmp_path, signs, offset, notes):
    """OpenCV's in transforms.json; or points of another frame."""
    write_transforms(tmp_path, 9, ply_file_path="points.ply")
    write_points(tmp_path, offset)
    path = tmp_path / "transforms.json"
    document = json.loads(path.read_text())
    turned(document, signs)
    path.write_text(json.dumps(document))
    found = load_dataset(tmp_path).notes
    assert [note.startswith(start) for note, start in zip(found, notes, strict=True)] == [True] * len(notes)


@pytest.mark.parametrize(("signs", "told"), [((1.0, 1.0, 1.0), False), ((1.0, -1.0, -1.0), True)])
def test_without_points_cameras_that_all_look_away_from_their_middle_are_told(tmp_path, signs, told):
    """OpenCV's in transforms.json again; or a panorama, of which the note says what it cannot know."""
    write_transforms(tmp_path, 9)
    path = tmp_path / "transforms.json"
    document = json.loads(path.read_text())
    turned(document, signs)
    path.write_text(json.dumps(document))
    found = load_dataset(tmp_path).notes
    assert [note.startswith("all cameras look away from what is between them") for note in found] == [True] * told


def test_cameras_side_by_side_and_along_a_way_have_no_middle_to_look_away_from(tmp_path):
    """Their axes are parallel, meet nowhere, or meet ahead of some and behind others."""
    turn = torch.Generator().manual_seed(2)
    for name, spread in (("parallel", 0.0), ("scattered", 0.5)):
        places = torch.randn(12, 3, generator=turn, dtype=torch.float64)
        targets = places + torch.tensor([0.0, 0.0, 9.0], dtype=torch.float64)
        targets += 9 * spread * torch.randn(12, 3, generator=turn, dtype=torch.float64)
        write_colmap(tmp_path / name, [(16, 12)] * 12, poses=look_at(places, targets, UP), points=0)
        assert load_dataset(tmp_path / name).notes == ()


def test_a_few_cameras_that_look_away_are_nothing_to_be_told(tmp_path):
    poses = circle_poses(12)
    poses[3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)) @ poses[3, :3]
    write_colmap(tmp_path, [(16, 12)] * 12, poses=poses)
    assert load_dataset(tmp_path).notes == ()


@pytest.mark.parametrize("points", [0, 20])
def test_cameras_at_one_place_say_nothing_of_depth(tmp_path, points):
    """Turned there, or with one pose for all."""
    for name, poses in (("turned", circle_poses(6)), ("same", circle_poses(1).repeat(6, 1, 1))):
        poses[:, :3, 3] = -poses[:, :3, :3] @ torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
        write_colmap(tmp_path / name, [(16, 12)] * 6, poses=poses, points=points)
        (note,) = load_dataset(tmp_path / name).notes
        assert note.startswith(ONE_PLACE)


@pytest.mark.parametrize(
    ("lens", "told"),
    [
        ({"fl_x": 100, "cx": 0, "cy": 12}, []),
        ({"fl_x": 0.7, "cx": 0.5, "cy": 0.5}, ["9 of 9 photos would show more than 168 degrees"]),
        ({"cx": 160, "cy": 60}, ["9 of 9 photos have the optical axis beside them"]),
        ({"cx": -1}, ["9 of 9 photos have the optical axis beside them"]),
        ({"fl_y": 0.4, "cy": 13}, ["9 of 9 photos would show", "9 of 9 photos have the optical axis"]),
    ],
)
def test_lenses_that_are_in_no_pixels_of_the_photos_are_told(tmp_path, lens, told):
    """As where they are shares of its sides, or of a photo ten times as large: runs went on, and learned nothing."""
    write_transforms(tmp_path, 9, **lens)
    found = load_dataset(tmp_path).notes
    assert [note.startswith(start) for note, start in zip(found, told, strict=True)] == [True] * len(told)
