"""Videos that are written: what is no frame, and what is no video, is named."""

import numpy as np
import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.io.videos import open_video

ffmpeg = pytest.importorskip("imageio_ffmpeg")
GREY = torch.full((32, 48, 3), 0.5)


def write(path, frames, fps=10) -> None:
    with open_video(path, fps) as append:
        for frame in frames:
            append(frame)


@pytest.mark.parametrize("fps", [24, 29.97, np.int64(5), 0.5])
def test_frames_of_one_size_are_a_video(tmp_path, fps):
    write(tmp_path / "a.mp4", [GREY, GREY.double(), GREY.clone().requires_grad_()], fps)
    assert ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))[0] == 3


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([GREY, torch.zeros(16, 48, 3)], r"frame: expected shape \(32, 48, 3\) like the first one, got \(16, 48, 3\)"),
        ([torch.zeros(32, 48, 4)], r"frame: expected shape \(H, W, 3\).*got \(32, 48, 4\)"),
        ([torch.zeros(32, 48)], r"frame: expected shape \(H, W, 3\)"),
        ([GREY[None]], r"frame: expected shape \(H, W, 3\)"),
        ([torch.zeros(1, 48, 3)], "at least 2 pixels"),
        ([(255 * GREY).byte()], "frame must be of floating-point numbers"),
        ([GREY.numpy()], "frame must be a tensor"),
        ([GREY * torch.nan], "finite"),
        ([], "frames: expected at least one"),
    ],
)
def test_what_is_no_frame_is_named_and_no_file_is_left(tmp_path, frames, message):
    """Frames of other sizes, with alpha, or of bytes became noise or white, without a word."""
    with pytest.raises(ValueError, match=message):
        write(tmp_path / "a.mp4", frames)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("fps", [0, -1, float("nan"), "x", None, True])
def test_a_rate_is_a_number_above_0(tmp_path, fps):
    with pytest.raises(ValueError, match="fps"):
        write(tmp_path / "a.mp4", [GREY], fps)


@pytest.mark.parametrize("name", ["a.gif", "a.webm", "a"])
def test_files_that_hold_no_h264_are_named(tmp_path, name):
    with pytest.raises(ValueError, match=r"path: expected one of the suffixes \.mp4"):
        write(tmp_path / name, [GREY])


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match="create the folder first"):
        write(tmp_path / "no" / "a.mp4", [GREY])
