import gc
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.io.depth_maps import load_depth, resize_depth

DEPTH = np.array([[0.0, 1.5, 2.25], [3.0, np.nan, 4.5]], dtype=np.float32)
KNOWN = torch.tensor([[0.0, 1.5, 2.25], [3.0, 0.0, 4.5]])


def write_exr(path, channels):
    OpenEXR = pytest.importorskip("OpenEXR")
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))


def test_every_kind_of_file_gives_the_same_depths(tmp_path):
    """Floats as they are, integers in thousandths; NaN, infinity, 0 and Blender's 1e10 are unknown."""
    np.save(tmp_path / "a.npy", DEPTH)
    Image.fromarray(np.nan_to_num(1000 * DEPTH).astype(np.uint16)).save(tmp_path / "a.png")
    write_exr(tmp_path / "a.exr", {"Z": np.where(DEPTH == 0, np.float32(1e10), DEPTH)})
    np.save(tmp_path / "i.npy", np.where(DEPTH == 0, np.inf, DEPTH)[..., None])
    for name in ("a.npy", "a.png", "a.exr", "i.npy"):
        assert torch.equal(load_depth(tmp_path / name), KNOWN), name


def test_a_unit_that_is_given_counts_for_integers_and_floats(tmp_path):
    np.save(tmp_path / "a.npy", DEPTH)
    Image.fromarray(np.array([[0, 256, 512]], dtype=np.uint16)).save(tmp_path / "a.png")
    assert torch.equal(load_depth(tmp_path / "a.npy", 2.0), 2 * KNOWN)
    assert load_depth(tmp_path / "a.png", 1 / 256).tolist() == [[0.0, 1.0, 2.0]]


def test_of_an_exr_with_colours_the_channel_called_like_depth_is_taken(tmp_path):
    grey = np.full((2, 3), 7.0, dtype=np.float32)
    write_exr(tmp_path / "a.exr", {"R": grey, "G": grey, "B": grey, "ViewLayer.Depth.Z": np.nan_to_num(DEPTH)})
    assert torch.equal(load_depth(tmp_path / "a.exr"), KNOWN)
    write_exr(tmp_path / "b.exr", {"X": grey, "Q": grey})
    with pytest.raises(InputError, match=r"has the channels .* call that of the depth Z"):
        load_depth(tmp_path / "b.exr")


def test_what_is_no_depth_map_is_refused_with_what_to_do(tmp_path):
    Image.fromarray(np.zeros((2, 3), dtype=np.uint8)).save(tmp_path / "grey.png")
    np.save(tmp_path / "negative.npy", -DEPTH)
    np.save(tmp_path / "color.npy", np.zeros((2, 3, 3)))
    np.save(tmp_path / "words.npy", np.array([["a", "b"]]))
    (tmp_path / "cut.exr").write_bytes(b"\x76\x2f\x31\x01\x02")
    (tmp_path / "cut.npy").write_bytes((tmp_path / "negative.npy").read_bytes()[:-4])
    (tmp_path / "a.tif").write_bytes(b"II")
    for name, why in (
        ("grey.png", "write grey ones of 16 bits"),
        ("negative.npy", "negative numbers; write 0"),
        ("color.npy", "one number for each pixel"),
        ("words.npy", "no array of numbers"),
        ("cut.npy", "damaged"),
        ("a.tif", "convert it to 16-bit PNG, NPY or EXR"),
        ("gone.npy", "no such file"),
    ):
        with pytest.raises(InputError, match=why):
            load_depth(tmp_path / name)
    pytest.importorskip("OpenEXR")
    with pytest.raises(InputError, match="no EXR that can be read"):
        load_depth(tmp_path / "cut.exr")


def test_threads_that_take_turns_at_any_time_read_the_same(tmp_path):
    """Here at each collection of garbage, of which headers are full: CPython 3.11 called good files damaged."""
    np.save(tmp_path / "a.npy", DEPTH)
    before = gc.get_threshold()

    def take_turns(*_: object) -> None:
        time.sleep(0)

    gc.callbacks.append(take_turns)
    gc.set_threshold(20, 1000, 1000)
    try:
        with ThreadPoolExecutor(4) as pool:
            maps = list(pool.map(load_depth, [tmp_path / "a.npy"] * 60))
    finally:
        gc.set_threshold(*before)
        gc.callbacks.remove(take_turns)
    assert all(torch.equal(found, KNOWN) for found in maps)


@pytest.mark.parametrize("size", [(5, 4), (10, 8), (7, 3), (40, 32)])
def test_every_depth_of_another_size_is_one_of_the_map(size):
    """Foreground at 1, background at 9: nothing in between; what is mostly unknown stays unknown."""
    depth = torch.full((16, 20), 9.0)
    depth[4:12, 6:15] = 1.0
    depth[:, :3] = 0.0
    small = resize_depth(depth, *size)
    assert small.shape == (size[1], size[0])
    assert set(small.unique().tolist()) == {0.0, 1.0, 9.0}
    assert small[small.shape[0] // 2, small.shape[1] // 2] == 1.0
    assert bool((small[:, 0] == 0).all())


def test_a_map_of_the_right_size_stays_as_it_is():
    assert resize_depth(KNOWN, 3, 2) is KNOWN
