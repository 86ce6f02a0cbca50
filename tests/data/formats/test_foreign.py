"""What other programs write of a capture is read as the capture: cameras, pixels and points, for each of them."""

import numpy as np
import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from helpers.foreign_captures import WRITERS, Truth, truth, write_photos

CENTERED, ONE_SIZE = ("bundler", "llff"), ("record3d", "nsvf")

NOTES = {
    "metashape": "1 of 7 photos are disabled or not aligned and are left out",
    "llff": "poses_bounds.npy does not say how the lens distorts: with COLMAP's model of these photos in sparse/, that"
    " is read",
}


def capture_for(kind: str) -> Truth:
    """What a program can write: some have principal points in the middle, some have photos of one size."""
    capture = truth(centered=kind in CENTERED)
    if kind not in ONE_SIZE:
        return capture
    sizes, photos = [capture.sizes[0]] * len(capture.names), [capture.photos[0]] * len(capture.names)
    return Truth(
        capture.names, sizes, capture.viewmats, capture.Ks[:1].expand(6, 3, 3), photos, capture.points, capture.colors
    )


@pytest.mark.parametrize("kind", WRITERS)
def test_cameras_pixels_and_points_are_those_that_were_written(tmp_path, kind):
    """To 1e-5 of their size, and the photos to the bit."""
    capture = capture_for(kind)
    WRITERS[kind](tmp_path, capture)
    found = load_dataset(tmp_path)
    torch.testing.assert_close(found.viewmats, capture.viewmats, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(found.Ks, capture.Ks, atol=1e-9, rtol=1e-9)
    assert found.images.sizes == list(capture.sizes)
    for picture, photo in zip(found.images, capture.photos, strict=True):
        assert np.array_equal(picture.numpy(), photo)
    assert found.exact_points is not None
    torch.testing.assert_close(found.exact_points, capture.points, atol=1e-9, rtol=1e-9)
    if kind != "openmvg":  # whose points have no colour
        torch.testing.assert_close(found.point_colors, torch.from_numpy(capture.colors / 255).float())
    assert found.notes == ((NOTES[kind],) if kind in NOTES else ())


@pytest.mark.parametrize("kind", WRITERS)
def test_coordinates_of_maps_keep_their_millimetres(tmp_path, kind):
    """Cameras 6,000 km from the origin are where they were written, to a hundredth of a millimetre."""
    capture = truth(center=(500_000.0, 5_400_000.0, 300.0), centered=kind in CENTERED)
    if kind in ("record3d", "nsvf", "neus"):
        pytest.skip("its frames lie at the origin")
    WRITERS[kind](tmp_path, capture)
    found = load_dataset(tmp_path)
    assert found.georeference is not None
    assert found.exact_points is not None
    offset = torch.tensor(found.georeference.offset, dtype=torch.float64)
    torch.testing.assert_close(found.centers + offset, torch.from_numpy(capture.centers), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.exact_points + offset, capture.points, atol=1e-5, rtol=0)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_missing_photo_is_named(tmp_path, kind):
    capture = capture_for(kind)
    WRITERS[kind](tmp_path, capture)
    photo = sorted(tmp_path.rglob("*.png"))[2]
    photo.unlink()
    if kind == "record3d":  # what is there counts
        assert len(load_dataset(tmp_path)) == len(capture.names) - 1
        return
    if kind in ("neus", "llff"):  # which is missing, none can tell
        with pytest.raises(InputError, match="has 6 poses, but there are 5 photos"):
            load_dataset(tmp_path)
        return
    with pytest.raises(InputError, match=rf"1 of 6 images are missing \(first: .*{photo.stem}"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("kind", WRITERS)
def test_masks_and_smaller_copies_go_with_every_layout(tmp_path, kind):
    capture = capture_for(kind)
    WRITERS[kind](tmp_path, capture)
    names = [path.name for path in sorted(tmp_path.rglob("*.png"))]
    write_photos(tmp_path / "masks", capture, names)
    write_photos(tmp_path / "copies", capture, names)
    found = load_dataset(tmp_path, images="copies", width=24)
    assert found.images.mask(0) is not None
    assert found.images.sizes[0] == (24, 18)
    torch.testing.assert_close(found.Ks[0, :2], capture.Ks[0, :2] / 2)
