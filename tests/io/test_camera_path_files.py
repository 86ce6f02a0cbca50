"""Recorded camera paths come back as they were, and what is none is refused with a reason."""

import json

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.io.camera_path_files import KeyPoses, read_camera_path
from helpers.captures import circle_poses


def test_what_is_saved_comes_back(tmp_path):
    for aspect in (None, 1.5):
        keys = KeyPoses(circle_poses(4), torch.tensor([30.0, 40.0, 50.0, 60.5], dtype=torch.float64), aspect)
        (tmp_path / "path.json").write_text(keys.to_json())
        again = read_camera_path(tmp_path / "path.json")
        torch.testing.assert_close(again.viewmats, keys.viewmats, atol=0, rtol=0)
        assert again.fovs.tolist() == keys.fovs.tolist()
        assert (len(again), again.aspect) == (4, aspect)


def key(**changes):
    return {"viewmat": torch.eye(4).tolist(), "fov": 40, **changes}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not JSON"),
        ("[]", "is no camera path"),
        ({"format": "etsplat path 9"}, "is no camera path"),
        ({"keys": []}, "a list of 1 to"),
        ({"keys": {}}, "a list of 1 to"),
        ({"keys": [key()], "aspect": 0}, "`aspect` must be a number between"),
        ({"keys": [key()], "aspect": float("nan")}, "`aspect` must be a number between"),
        ({"keys": [key(), 5]}, r"keys\[1\]: is no object"),
        ({"keys": [key(fov=0)]}, "`fov` must be a number of degrees"),
        ({"keys": [key(viewmat=[[1, 0], [0, 1]])]}, "4 rows of 4 numbers"),
        ({"keys": [key(viewmat=[["a"] * 4] * 4)]}, "4 rows of 4 numbers"),
        ({"keys": [key(viewmat=[[float("inf")] * 4] * 4)]}, "4 rows of 4 numbers"),
        ({"keys": [key(viewmat=torch.diag(torch.tensor([1.0, 1, -1, 1])).tolist())]}, "must be a rotation"),
        ({"keys": [key(viewmat=(2 * torch.eye(4)).tolist())]}, "must be a rotation"),
    ],
)
def test_what_is_no_path_is_refused(tmp_path, text, message):
    said = text if isinstance(text, str) else json.dumps({"format": "etsplat path 1", **text})
    if isinstance(text, dict) and "format" in text:
        said = json.dumps(text)
    (tmp_path / "path.json").write_text(said)
    with pytest.raises(InputError, match=message) as caught:
        read_camera_path(tmp_path / "path.json")
    assert "path.json" in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"away\.json: cannot be read"):
        read_camera_path(tmp_path / "away.json")
