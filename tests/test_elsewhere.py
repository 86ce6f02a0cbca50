"""What other programs are told of our cameras: `benchmarks.elsewhere`."""

import math
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
import torch
from torch import Tensor

from benchmarks.elsewhere.__main__ import averaged
from benchmarks.elsewhere.server import serving
from benchmarks.elsewhere.subject import Shot, moved
from etsplat.core.cameras import Cameras, look_at
from etsplat.geometry.similarity import Similarity, rotation_between

POINTS = torch.tensor([[0.1, -0.2, 0.3], [0.4, 0.1, -0.3], [0, 0, 0]], dtype=torch.float64)
FRAME = Similarity(
    rotation_between(torch.tensor([0.6, 0.8, 0.0]), torch.tensor([0.0, 0.0, 1.0])), 7.0, torch.tensor([1.0, -2.0, 3.0])
)
CAMERA = Cameras(
    look_at(torch.tensor([1.0, 2.0, 2.0]), torch.tensor([0.1, 0.0, 0.0]), torch.tensor([0.0, 0.3, 1.0]))[None],
    torch.tensor([[[90.0, 0, 37], [0, 95.0, 21], [0, 0, 1]]]),
    80,
    50,
)


def pixels(camera: Cameras, points: Tensor) -> Tensor:
    """Where points are in a picture, as `Cameras` has it."""
    seen = points @ camera.viewmats[0, :3, :3].double().T + camera.viewmats[0, :3, 3].double()
    flat = seen @ camera.Ks[0].double().T
    return flat[:, :2] / flat[:, 2:]


def test_a_camera_moves_with_what_it_sees() -> None:
    """Turned, scaled and moved, points stay at their pixels."""
    found = pixels(moved(CAMERA, FRAME.apply), FRAME.apply(POINTS))
    assert torch.allclose(found, pixels(CAMERA, POINTS), atol=1e-4)  # the camera's pose is float32


def test_opengl_draws_points_where_our_cameras_do() -> None:
    """By the pose and the projection that are handed over; what lies between near and far is not cut off."""
    picture = torch.zeros(50, 80, 3)
    shot = Shot("000", CAMERA, picture, picture, lambda x: x, 0.5, 5.0)
    view = shot.view(1)
    pose, projection = (torch.tensor(view[name], dtype=torch.float64).view(4, 4) for name in ("pose", "projection"))
    clip = torch.cat([POINTS, torch.ones(3, 1)], dim=1) @ torch.linalg.inv(pose).T @ projection.T
    x, y, depth = (clip[:, :3] / clip[:, 3:]).unbind(1)
    assert (depth.abs() < 1).all()
    found = torch.stack([(x + 1) * 40, (1 - y) * 25], dim=1)
    assert torch.allclose(found, pixels(CAMERA, POINTS), atol=1e-9)
    assert (shot.view(4)["width"], shot.view(4)["height"]) == (320, 200)


def test_larger_pictures_are_averaged_block_by_block() -> None:
    picture = torch.arange(4 * 6 * 3.0).view(4, 6, 3)
    found = averaged(picture, 2)
    assert found.shape == (2, 3, 3)
    assert math.isclose(float(found[1, 2, 0]), float(picture[2:, 4:, 0].mean()))


def test_the_server_gives_pages_modules_and_the_file_alone(tmp_path: Path) -> None:
    (tmp_path / "node_modules" / "three").mkdir(parents=True)
    (tmp_path / "node_modules" / "three" / "a.js").write_text("1")
    (tmp_path / "b.glb").write_bytes(b"glTF")
    (tmp_path / "secret").write_text("no")
    with serving(tmp_path, tmp_path / "b.glb") as server:
        for path, text in (("npm/three/a.js", b"1"), ("file.glb", b"glTF")):
            with urlopen(f"{server}/{path}") as answer:
                assert answer.read() == text
        with urlopen(f"{server}/three.html") as answer:
            assert b"GLTFLoader" in answer.read()
        for path in ("npm/%2e%2e/secret", "npm/../secret", "../../secret"):
            with pytest.raises(HTTPError):
                urlopen(f"{server}/{path}")
