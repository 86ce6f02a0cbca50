import pytest
import torch

from etsplat.cli.parse import parse
from etsplat.cli.runs import DemoObject, DemoScene, Train
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene


@pytest.fixture(scope="module")
def capture() -> Dataset:
    return demo_scene(120, 90)


def test_every_eighth_of_the_photos_is_for_testing(capture):
    """42 photos of the size asked for, split by name."""
    assert len(capture) == 42
    assert set(capture.images.sizes) == {(120, 90)}
    assert capture.test == list(range(0, 42, 8))
    assert sorted([*capture.train, *capture.test]) == list(range(42))


def test_points_lie_where_the_photos_show_their_colours(capture):
    """Most of the points that are not hidden have nearly the colour of their pixel; cameras and points agree."""
    assert capture.points is not None
    matches = []
    for view in (0, 25):
        camera = capture.cameras[view]
        local = capture.points @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
        pixels = local @ camera.Ks[0].T
        column, row = (pixels[:, axis] / pixels[:, 2] for axis in (0, 1))
        inside = (local[:, 2] > 0) & (column >= 0) & (column < 120) & (row >= 0) & (row < 90)
        photo = capture.images[view].float() / 255
        seen = photo[row[inside].long(), column[inside].long()]
        matches.append(((seen - capture.point_colors[inside]).abs().amax(dim=1) < 0.25).float().mean())
    assert min(matches) > 0.4


def test_the_scene_is_deterministic(capture):
    """The same bits every time."""
    again = demo_scene(120, 90)
    assert torch.equal(again.images[3], capture.images[3])
    assert torch.equal(again.exact_points, capture.exact_points)


def test_demo_with_and_without_scene_are_two_commands():
    """Each has its own options; presets and kinds of scenes set the defaults of the others."""
    assert isinstance(parse(["demo"]), DemoObject)
    scene = parse(["demo", "scene", "--method", "bilateral"])
    assert isinstance(scene, DemoScene)
    assert scene.settings.method == "bilateral"
    words = ["train", "photos", "--out", "run", "--preset", "paper", "--scene-type=indoor"]
    train = parse([*words, "--optimizer.lr-sigma", "0.1"])
    assert isinstance(train, Train)
    settings = train.settings
    assert (settings.loss.lambda_dssim, settings.optimizer.lr_sigma, settings.iterations) == (0.4, 0.1, 30_000)
