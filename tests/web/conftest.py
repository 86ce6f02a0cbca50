"""A browser for the tests of pages, and a capture for their cameras."""

import pytest

from etsplat.data.load import load_dataset
from helpers.browser import browser_page, find_browser
from helpers.captures import write_transforms


@pytest.fixture(scope="module")
def flags():
    """Of the browser; a module may have its own."""
    return ()


@pytest.fixture(scope="module")
def page(flags):
    if find_browser() is None:
        pytest.skip("there is no Chromium")
    pytest.importorskip("websockets")
    with browser_page(*flags) as opened:
        yield opened


@pytest.fixture
def capture(tmp_path):
    """Eight cameras around the origin, of an odd lens."""
    write_transforms(tmp_path / "scene", 8, cx=8.5, cy=5.5, fl_y=15.0)
    return load_dataset(tmp_path / "scene", preload=False)
