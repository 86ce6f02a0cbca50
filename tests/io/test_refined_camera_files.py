"""cameras.json is read as it was written, and what is no camera is named."""

import json
from pathlib import Path
from typing import Any

import pytest

from etsplat.core.errors import InputError
from etsplat.io.refined_camera_files import CAMERAS_FILE, RefinedCamera, read_refined_cameras, write_refined_cameras

POSE = [[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, -1.0, 0.25], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
CAMERA = RefinedCamera(POSE, [[90.0, 0.0, 32.0], [0.0, 91.0, 24.0], [0.0, 0.0, 1.0]], 64, 48, True, 0.4, 0.02, 0.01)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    """Of a folder without the file, nothing."""
    assert read_refined_cameras(tmp_path) == {}
    write_refined_cameras(tmp_path, {"a": CAMERA, "b": CAMERA})
    assert read_refined_cameras(tmp_path) == {"a": CAMERA, "b": CAMERA}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmat": POSE[:3]}, "viewmat that is wrong: it must be 4 rows"),
        ({"viewmat": [[2.0, 0, 0, 0], *POSE[1:]]}, "must be a rotation"),
        ({"K": [[1.0, 0.0], [0.0, 1.0]]}, "no K of three rows"),
        ({"K": [[0.0, 0, 1], [0, 1, 1], [0, 0, 1]]}, "no matrix of a pinhole"),
        ({"width": 0}, "width or height"),
        ({"shifted": "far"}, "`shifted` is"),
        ({"training": 1}, "`training` is"),
    ],
)
def test_a_damaged_camera_is_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    """With its photo, and what to do."""
    write_refined_cameras(tmp_path, {"photo_7": CAMERA})
    found = json.loads((tmp_path / CAMERAS_FILE).read_text())
    found["cameras"]["photo_7"] |= change
    (tmp_path / CAMERAS_FILE).write_text(json.dumps(found))
    with pytest.raises(InputError, match=rf"camera 'photo_7' .*{message}.*delete the file"):
        read_refined_cameras(tmp_path)


@pytest.mark.parametrize("text", ["{", "[]", '{"format": "etsplat path 1", "cameras": {}}', '{"cameras": 3}'])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    """JSON or not."""
    (tmp_path / CAMERAS_FILE).write_text(text)
    with pytest.raises(InputError, match="delete it"):
        read_refined_cameras(tmp_path)
