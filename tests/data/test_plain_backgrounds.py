"""Objects are told from plain backgrounds, and other backgrounds refused."""

import re

import numpy as np
import pytest
from PIL import Image

from etsplat.data.plain_backgrounds import find_object

HEIGHT, WIDTH = 180, 240


def place() -> tuple[np.ndarray, np.ndarray]:
    """x and y of pixel centres in [0, 1]."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return columns / WIDTH, rows / HEIGHT


def ring(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A cup from above: a ring with a hole that shows the background, and a saucer apart from it."""
    radius = np.hypot(1.33 * (x - 0.45), y - 0.45)
    return ((radius > 0.12) & (radius < 0.28)) | ((np.abs(x - 0.8) < 0.06) & (np.abs(y - 0.8) < 0.08))


BACKGROUNDS = {
    "white": lambda x, y: np.full((HEIGHT, WIDTH, 3), 0.95),
    "black": lambda x, y: np.full((HEIGHT, WIDTH, 3), 0.03),
    "grey, brighter to the right": lambda x, y: (0.4 + 0.3 * x)[..., None] * np.ones(3),
    "blue, darker outside": lambda x, y: (1.1 - (x - 0.5) ** 2 - (y - 0.5) ** 2)[..., None] * np.array([0.3, 0.4, 0.7]),
}


def picture(background: np.ndarray, mask: np.ndarray, noise: float) -> np.ndarray:
    """A striped, orange object before a background, with noise."""
    x, _ = place()
    stripes = np.where((x * 30).astype(int) % 2, 1.0, 0.8)[..., None] * np.array([0.9, 0.45, 0.1])
    colors = np.where(mask[..., None], stripes, background)
    colors = colors + np.random.default_rng(0).normal(0, noise, colors.shape)
    return (255 * colors.clip(0, 1)).round().astype(np.uint8)


@pytest.mark.parametrize("noise", [0.0, 0.03])
@pytest.mark.parametrize("name", BACKGROUNDS)
def test_an_object_is_found_with_its_holes_and_parts(name, noise):
    """Whatever the background's colour, however it changes; within a pixel or so of the outline."""
    truth = ring(*place())
    found = find_object(picture(BACKGROUNDS[name](*place()), truth, noise))
    assert found.mask is not None, found.problem
    assert (found.mask & truth).sum() / (found.mask | truth).sum() > 0.94


def test_what_is_no_plain_background_is_refused_with_the_reason():
    """A checked cloth, an object beyond the border, a wall above a table, nothing, and nearly all of the picture."""
    x, y = place()
    white = BACKGROUNDS["white"](x, y)
    checked = np.where(((x * 24).astype(int) + (y * 18).astype(int)) % 2, 0.9, 0.5)[..., None] * np.ones(3)
    for background, mask, reason in [
        (checked, ring(x, y), "pattern"),
        (white, np.abs(y - 0.5) < 0.2, "the object touches it"),
        (np.where((y > 0.6)[..., None], [0.5, 0.3, 0.2], white), ring(x, y), "border|pattern"),
        (white, np.zeros((HEIGHT, WIDTH), dtype=bool), "nothing stands out"),
        (white, np.hypot(x - 0.5, y - 0.5) < 0.01, "nothing large enough"),
        (white, (np.abs(x - 0.5) < 0.47) & (np.abs(y - 0.5) < 0.458), "hardly any background"),
    ]:
        found = find_object(picture(background, mask, 0.01))
        assert found.mask is None
        assert re.search(reason, found.problem)


def test_objects_of_real_photos_are_found_and_photos_of_rooms_refused(shared_data):
    """Renderings of a mug before a wall whose light falls off, found to an IoU of 0.98; photos of a kitchen."""
    x, y = np.meshgrid(np.linspace(0, 1, 400), np.linspace(0, 1, 400))
    wall = np.array([0.3, 0.4, 0.6]) * (1 - 0.5 * ((x - 0.5) ** 2 + (y - 0.5) ** 2))[..., None]
    for path in sorted((shared_data / "objects" / "mug" / "train").iterdir())[:3]:
        photo = np.asarray(Image.open(path)) / 255
        colors = photo[..., :3] * photo[..., 3:] + wall * (1 - photo[..., 3:])
        colors += np.random.default_rng(0).normal(0, 0.02, colors.shape)
        found, truth = find_object((255 * colors.clip(0, 1)).astype(np.uint8)), photo[..., 3] >= 0.5
        assert found.mask is not None, found.problem
        assert (found.mask & truth).sum() / (found.mask | truth).sum() > 0.98
    for path in sorted((shared_data / "scenes" / "kitchen25" / "images").iterdir())[:3]:
        assert find_object(np.asarray(Image.open(path).convert("RGB"))).mask is None
