"""A video becomes a folder of frames, once."""

import json

import pytest

from etsplat.core.errors import InputError
from etsplat.data.structure_from_motion import find_cameras
from etsplat.data.video_intake import frames_of_video
from helpers.videos import pan, texture, write_video


def no_report(phase: str, done: int, total: int) -> None:
    """Nobody looks."""


def test_frames_are_written_once_and_taken_from_there_the_next_time(tmp_path):
    """With a record of where they come from; frames of another number or another video are refused."""
    write_video(tmp_path / "walk.mp4", pan(range(0, 80, 2)))
    told = []
    folder = frames_of_video(tmp_path / "walk.mp4", tmp_path / "out" / "frames", 8, lambda *state: told.append(state))
    record = json.loads((folder / "frames.json").read_text())
    names = sorted(path.name for path in folder.glob("*.jpg"))
    assert names == [f"frame_{number:06d}.jpg" for number in record["numbers"]]
    assert 5 <= len(names) <= 8
    assert {phase for phase, _, _ in told} == {"Reading the video", "Writing frames"}
    assert sorted(path.name for path in folder.parent.iterdir()) == ["frames"]
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    frames_of_video(tmp_path / "walk.mp4", folder, 8, no_report)
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    with pytest.raises(InputError, match="another number of them"):
        frames_of_video(tmp_path / "walk.mp4", folder, 9, no_report)


def test_videos_that_show_nothing_new_or_of_too_few_frames_are_refused_by_name(tmp_path):
    write_video(tmp_path / "still.mp4", pan([0] * 20))
    with pytest.raises(InputError, match=r"video .*still\.mp4: the camera hardly moves"):
        frames_of_video(tmp_path / "still.mp4", tmp_path / "out" / "frames", 8, no_report)
    with pytest.raises(InputError, match="frames: is 2; at least 3"):
        frames_of_video(tmp_path / "still.mp4", tmp_path / "out" / "frames", 2, no_report)
    assert [path.name for path in tmp_path.iterdir()] == ["still.mp4"]


def test_frames_stay_where_no_scene_comes_of_them(tmp_path):
    """Pictures that have nothing in common; they are kept and taken again."""
    pytest.importorskip("pycolmap")
    write_video(tmp_path / "walk.mp4", [texture(160, 120, seed) for seed in range(20)])
    for _ in range(2):
        with pytest.raises(InputError, match="could be placed in one scene"):
            find_cameras(tmp_path / "walk.mp4", tmp_path / "scene", frames=6, max_size=64, threads=1)
        assert [path.name for path in (tmp_path / "scene").iterdir()] == ["frames"]
