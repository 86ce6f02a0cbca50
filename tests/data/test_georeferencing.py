import pytest
import torch

from etsplat.core.cameras import camera_centers
from etsplat.data.load import load_dataset
from etsplat.io.georeference import Georeference
from helpers import foreign_captures as foreign
from helpers.captures import circle_poses, write_colmap

FAR = (500_000.0, 5_400_000.0, 300.0)


def test_coordinates_of_maps_are_made_relative_to_whole_units_nearby(tmp_path):
    """And offset plus coordinate is where it was, for cameras and points, to a hundredth of a millimetre."""
    capture = foreign.truth(center=FAR)
    foreign.write_openmvg(tmp_path, capture)
    found = load_dataset(tmp_path)
    assert found.georeference is not None
    offset = torch.tensor(found.georeference.offset, dtype=torch.float64)
    assert torch.equal(offset, offset.round())
    assert float(found.centers.abs().max()) < 10
    torch.testing.assert_close(found.centers + offset, torch.from_numpy(capture.centers), atol=1e-5, rtol=0)
    assert found.exact_points is not None
    torch.testing.assert_close(found.exact_points + offset, capture.points, atol=1e-8, rtol=0)
    assert found.notes[-1].startswith("coordinates are relative to (")


def test_colmaps_cameras_keep_all_digits_too(tmp_path):
    """In single precision they were off by up to a quarter of a unit."""
    poses = circle_poses(6, FAR)
    write_colmap(tmp_path, [(16, 12)] * 6, poses=poses)
    found = load_dataset(tmp_path)
    offset = torch.tensor(found.georeference.offset, dtype=torch.float64)
    torch.testing.assert_close(found.centers + offset, camera_centers(poses), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("center", "moved"), [((0.0, 0.0, 0.0), False), ((100.0, 0.0, 0.0), False), (FAR, True)])
def test_only_what_is_far_is_moved(tmp_path, center, moved):
    foreign.write_openmvg(tmp_path, foreign.truth(center=center))
    assert (load_dataset(tmp_path).georeference is not None) == moved


def test_cameras_at_one_place_are_not_far_from_the_origin(tmp_path):
    """How far they are from each other is rounding, here of poses with eight digits. Zeros have no sign."""
    near = circle_poses(6)
    near[:, :3, 3] = (-near[:, :3, :3] @ torch.tensor([0.3, -0.2, -1.0]).double()).float().double()
    write_colmap(tmp_path / "near", [(16, 12)] * 6, poses=near)
    assert load_dataset(tmp_path / "near").georeference is None
    write_colmap(tmp_path / "far", [(16, 12)] * 6, poses=circle_poses(6, (-0.2, -1.3, 5e5)))
    found = load_dataset(tmp_path / "far")
    assert "relative to (0, 0, 500000)" in found.notes[0]


def test_poses_with_few_digits_keep_their_places(tmp_path):
    """Rotations of six digits are orthogonal to 1e-6, which at 5,400 km would be metres."""
    capture = foreign.truth(center=FAR)
    foreign.write_reality_capture_xmp(tmp_path, capture)
    for path in (tmp_path / "images").glob("*.xmp"):
        index = capture.names.index(path.stem)
        rotation = " ".join(f"{value:.6f}" for value in capture.rotation(index).flatten())
        text = path.read_text()
        start, end = text.index("<xcr:Rotation>") + 14, text.index("</xcr:Rotation>")
        path.write_text(text[:start] + rotation + text[end:])
    found = load_dataset(tmp_path)
    assert found.georeference is not None
    offset = torch.tensor(found.georeference.offset, dtype=torch.float64)
    torch.testing.assert_close(found.centers + offset, torch.from_numpy(capture.centers), atol=1e-4, rtol=0)


def test_the_scenes_own_record_and_the_move_are_one(tmp_path):
    """x_world = offset + scale x holds of what was read; of what was moved too."""
    foreign.write_openmvg(tmp_path, foreign.truth(center=(0.0, 0.0, 50_000.0)))
    Georeference((7.0, 0.0, 0.0), 2.0, "z", "EPSG:25832").write(tmp_path)
    found = load_dataset(tmp_path).georeference
    assert found is not None
    assert (found.scale, found.up, found.crs) == (2.0, "z", "EPSG:25832")
    assert found.offset == pytest.approx((7.0, 0.0, 100_000.0), abs=10)
    near = tmp_path / "near"
    near.mkdir()
    foreign.write_openmvg(near, foreign.truth())
    Georeference((7.0, 0.0, 0.0)).write(near)
    assert load_dataset(near).georeference == Georeference((7.0, 0.0, 0.0))
