"""Frames come out of video files upright, all of them, and damaged files are refused in one line."""

import numpy as np
import pytest
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.io.video_files import count_frames, grey_frames, write_video_frames
from helpers.videos import pan, rewrite_video, write_video


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "walk: 1.mp4"  # with a colon, as a protocol has one
    write_video(path, pan(range(0, 40, 2)))
    return path


def test_frames_are_counted_shown_small_and_grey_and_written_whole(video, tmp_path):
    assert count_frames(video) == 20
    frames, small = list(grey_frames(video, 960)), list(grey_frames(video, 80))
    assert len(frames) == len(small) == 20
    assert frames[0].shape == (120, 160)
    assert small[0].shape == (60, 80)
    truth = pan(range(0, 40, 2))
    told = []
    (tmp_path / "out").mkdir()
    files = write_video_frames(video, [3, 4, 17], tmp_path / "out", lambda *state: told.append(state))
    assert [file.name for file in files] == ["frame_000003.jpg", "frame_000004.jpg", "frame_000017.jpg"]
    assert sorted((tmp_path / "out").iterdir()) == files
    for file, number in zip(files, [3, 4, 17], strict=True):
        with Image.open(file) as image:
            assert np.abs(np.asarray(image, dtype=float) - truth[number]).mean() < 4
        assert np.abs(frames[number].astype(float) - truth[number][..., 0]).mean() < 4
    assert told[-1] == (3, 3)


def test_a_video_that_says_that_it_lies_on_its_side_is_turned(video, tmp_path):
    rewrite_video(video, tmp_path / "turned.mp4", ["-display_rotation", "90"])
    turned, frames = next(grey_frames(tmp_path / "turned.mp4", 960)), next(grey_frames(video, 960))
    assert turned.shape == (160, 120)
    assert np.abs(turned.astype(float) - np.rot90(frames)).mean() < 2


def test_frames_at_an_uneven_pace_are_neither_repeated_nor_dropped(video, tmp_path):
    """Here of 20 frames all of the first ten and every third of the others."""
    keep = ["-vf", "select='lt(n,10)+not(mod(n,3))'", "-fps_mode", "vfr", "-c:v", "libx264", "-threads", "1"]
    rewrite_video(video, tmp_path / "uneven.mp4", after=keep)
    frames, every = list(grey_frames(tmp_path / "uneven.mp4", 960)), list(grey_frames(video, 960))
    kept = [*range(10), 12, 15, 18]
    assert len(frames) == len(kept)
    for frame, number in zip(frames, kept, strict=True):
        assert np.abs(frame.astype(float) - every[number]).mean() < 5


def test_a_video_whose_frames_are_all_skipped_is_refused(video):
    """By an edit list that begins behind the last frame: FFmpeg counts them, and decodes none."""
    data = bytearray(video.read_bytes())
    begin = data.index(b"elst") + 16
    data[begin : begin + 4] = (1 << 30).to_bytes(4, "big")
    video.write_bytes(data)
    assert count_frames(video) > 0
    with pytest.raises(InputError, match="none of its frames can be decoded; convert it to MP4 anew"):
        list(grey_frames(video, 80))


def test_a_video_whose_pictures_change_in_size_is_refused(tmp_path):
    """From there on FFmpeg counts from 0 again: other frames than those that were chosen would be written."""
    whole, options = b"", ("-c:v", "mjpeg", "-pix_fmt", "yuvj420p")
    for width in (160, 80):
        write_video(tmp_path / "part.mjpeg", pan(range(4), width=width), *options)
        whole += (tmp_path / "part.mjpeg").read_bytes()
    (tmp_path / "both.mjpeg").write_bytes(whole)
    rewrite_video(tmp_path / "both.mjpeg", tmp_path / "video.avi")
    for numbers in ([0, 2, 5], [5, 7]):  # more than are chosen, and none
        with pytest.raises(InputError, match="change in size on the way"):
            write_video_frames(tmp_path / "video.avi", numbers, tmp_path, lambda done, of: None)


def test_what_is_no_video_is_refused_in_one_line(video, tmp_path):
    """Empty, text, cut short, damaged, sound alone, and lists of other files, which are not opened."""
    whole = video.read_bytes()
    rewrite_video(
        video, tmp_path / "sound.mp4", ["-f", "lavfi", "-i", "sine=duration=0.2"], ["-map", "0:a", "-c:a", "aac"]
    )
    damaged = bytearray(whole)
    start = whole.index(b"mdat") + 200
    damaged[start : start + 4000] = np.random.default_rng(0).bytes(4000)
    contents = {
        "empty": (b"", "the file is empty"),
        "text": (b"no video", "cannot be read"),
        "cut": (whole[: len(whole) // 2], "moov atom not found"),
        "damaged": (bytes(damaged), "cannot be read|has no frames"),
        "sound": ((tmp_path / "sound.mp4").read_bytes(), "no pictures in it"),
        "list": (f"ffconcat version 1.0\nfile '{video.name}'\n".encode(), "cannot be read"),
        "playlist": (b"#EXTM3U\n#EXTINF:10,\nhttp://127.0.0.1:9/a.ts\n", "cannot be read"),
    }
    for name, (data, message) in contents.items():
        path = tmp_path / f"{name}.mp4"
        path.write_bytes(data)
        with pytest.raises(InputError, match=message) as raised:
            assert count_frames(path) == len(list(grey_frames(path, 960)))
        assert str(raised.value).startswith(f"video {path}: ")
        assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match="no such file"):
        count_frames(tmp_path / "absent.mp4")


def test_reading_may_end_early(video):
    """Who needs the first frames only does not wait for the others, nor is told that something is wrong."""
    frames = grey_frames(video, 960)
    next(frames)
    frames.close()
