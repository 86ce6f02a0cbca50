"""What strangers get wrong: each error names what they gave and what to give instead."""

import subprocess
import sys
from pathlib import Path

import pytest

from etsplat.core.errors import InputError
from etsplat.io.run_directory import RunDirectory
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.train import train
from helpers.captures import write_photo
from tests.helpers.commands import Run, assert_one_line_error


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    write_photo(tmp_path / "photos" / "a.jpg", 16, 12, seed=0)
    return tmp_path / "photos" / "a.jpg"


def test_a_demo_of_another_name_or_task(etsplat: Run, tmp_path: Path) -> None:
    out = str(tmp_path / "run")
    for task, other in (("train", "demo:owl"), ("reconstruct", "demo:scene")):
        assert_one_line_error(etsplat(task, other, "--out", out), f"{other}: is for `etsplat")
        result = etsplat(task, "demo:cat", "--out", out)
        assert_one_line_error(result, "not built in", "demo:owl for `etsplat reconstruct`")


@pytest.mark.parametrize("task", ["train", "reconstruct"])
def test_one_photo_or_a_video_in_the_place_of_a_capture(task: str, etsplat: Run, photo: Path) -> None:
    video = photo.with_name("walk.MP4")
    video.touch()
    out = str(photo.with_name("run"))
    assert_one_line_error(etsplat(task, str(photo), "--out", out), "is one photo; name the folder")
    assert_one_line_error(etsplat(task, str(video), "--out", out), f"etsplat data sfm {video} --out")


def test_cameras_of_one_photo_or_of_a_video_that_is_not_there(etsplat: Run, photo: Path) -> None:
    pytest.importorskip("pycolmap")
    out = str(photo.with_name("scene"))
    assert_one_line_error(etsplat("data", "sfm", str(photo), "--out", out), "is one photo; name the folder")
    assert_one_line_error(etsplat("data", "sfm", "walk.mp4", "--out", out), "no such file or folder")


def test_words_that_may_be_chosen_are_listed_in_their_order() -> None:
    """In processes of their own: the order of a set is another one in each."""
    program = [sys.executable, "-c", "from etsplat.cli import main; main()", "export", "run", "--format", "fbx"]
    for seed in ("1", "2"):
        said = subprocess.run(program, env={"PYTHONHASHSEED": seed}, capture_output=True, text=True, check=False)
        words = " ".join(said.stderr.replace("\u2502", " ").split())
        assert "'glb', 'obj', 'off', 'ply', 'etz', 'html', 'safetensors'" in words


@pytest.mark.parametrize("command", [["doctor"], ["demo", "--out", "run"], ["export", "run"]])
def test_a_package_that_is_needed_and_missing(command: list[str], tmp_path: Path) -> None:
    """As after `pip install --no-deps`; with --debug the traceback is there."""
    program = "import sys; sys.modules['torch'] = None; from etsplat.cli import main; main()"

    def said(*arguments: str) -> tuple[int, str]:
        call = [sys.executable, "-c", program, *arguments]
        done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
        return done.returncode, done.stderr

    line = "etsplat: the module torch is not installed: install etsplat anew, without pip's --no-deps\n"
    assert said(*command) == (1, line)
    assert "Traceback" in said(*command, "--debug")[1]


@pytest.mark.parametrize("task", ["reconstruct", "train"])
def test_settings_are_spelled_as_options_for_the_command_alone(task: str, etsplat: Run, tmp_path: Path) -> None:
    """Who calls the function reads its arguments, also after a command in the same process."""
    source, make = {"reconstruct": ("demo:owl", reconstruct), "train": ("demo:scene", train)}[task]
    RunDirectory.create(tmp_path / "run", {"task": task})
    there, none = str(tmp_path / "run"), str(tmp_path / "none")
    shell = "run already; continue it with --resume, replace it with --overwrite, or choose another folder"
    assert_one_line_error(etsplat(task, source, "--out", there), shell)
    assert_one_line_error(
        etsplat(task, source, "--out", none, "--resume"), "no run to resume; start it without --resume"
    )
    assert_one_line_error(etsplat(task, source, "--out", none, "--resume", "--overwrite"), "--resume and --overwrite: ")
    with pytest.raises(
        InputError, match="run already; continue it with resume=True, replace it with overwrite=True, or"
    ):
        make(source, there)
    with pytest.raises(InputError, match=r"no run to resume; start it without resume$"):
        make(source, none, resume=True)
    with pytest.raises(InputError, match=r"^resume and overwrite: contradict each other"):
        make(source, none, resume=True, overwrite=True)
