"""The engine "webgpu" draws what the float64 reference draws, on whatever adapter there is (lavapipe will do)."""

import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

import etsplat
from etsplat.core.errors import EngineUnavailableError, InputError
from etsplat.core.kernels import KERNELS
from etsplat.engines.choice import engine_names, resolve_device, training_engines
from etsplat.engines.webgpu import device as device_module
from etsplat.engines.webgpu import rasterize as rasterize_module
from etsplat.engines.webgpu.device import WebGpu, gpu, spread
from etsplat.engines.webgpu.sort import scan_step, sort_steps
from helpers.scenes import NO_CUTOFFS, Scene, colored, mesh, prepare, render, soup
from helpers.tolerances import assert_close_to_scale

OUTPUTS = ("color", "alpha", "depth", "median_depth", "normal", "statistics")
IMAGES = OUTPUTS[:-1]

# WGSL lets log2 be off by 2^-21 near 1 and exp2 by 3 + 2 |x| ulp. Alpha is opacity * 2^(scale * 2^(e * log2 x)) with
# e = 2 / sigma, and an error of the inner power comes through y exp(-y), 0.37 at most: 1.6e-6 at sigma = 0.15, which
# the soups have at least, and as much again of the two exp2. Pixels of these scenes have up to ten layers that count.
TOLERANCE = 4e-5
SHARPEST = 0.15
# Pixels that float32 decides otherwise at alpha = 1/255, at x = 2, at T = 1/2 or between almost equal depths.
OUTLIERS = {"outliers": 4e-3, "outlier_tolerance": 2e-2}
DRAWN = ("elastic", "bilateral", "single-sided", "hard")


@pytest.fixture
def adapter() -> WebGpu:
    """The GPU, or a skip that says what is missing."""
    try:
        return gpu()
    except EngineUnavailableError as reason:
        pytest.skip(f"{reason} (of Debian, in software: mesa-vulkan-drivers)")


def compare(scene: Scene, tolerance: float = TOLERANCE, images: tuple[str, ...] = IMAGES, **options) -> None:
    """The same images and statistics as the oracle has."""
    options = {"outputs": OUTPUTS, **options}
    out, oracle = render(scene, "webgpu", **options), render(scene, "reference", **options)
    for name in images:
        expected = getattr(oracle, name)
        loose = {**OUTLIERS, "outlier_tolerance": 1.0} if name == "median_depth" else OUTLIERS
        scale = max(1.0, float(expected.max()))
        assert_close_to_scale(getattr(out, name), expected, tolerance, scale=scale, **loose, name=name)
    if oracle.statistics is not None:
        assert (out.statistics.visible != oracle.statistics.visible).sum() <= 1
        for name in ("max_weight", "screen_size", "inradius"):
            expected = getattr(oracle.statistics, name)
            assert_close_to_scale(
                getattr(out.statistics, name), expected, 1e-4, outliers=0.01, outlier_tolerance=0.1, name=name
            )


@pytest.mark.parametrize("kernel", DRAWN)
def test_soup(adapter, kernel, distance, rng):
    compare(soup(rng, 150, views=3), kernel=kernel, distance=distance)


@pytest.mark.parametrize("kernel", DRAWN)
def test_mesh(adapter, kernel, distance, rng):
    compare(mesh(rng), kernel=kernel, distance=distance)


@pytest.mark.parametrize("kernel", DRAWN)
@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.3, 1.0, 4.0, 40.0])
def test_from_sharp_to_flat(adapter, kernel, sigma, rng):
    """What errors are magnified by grows as sigma falls, or, of a single-sided kernel, as it rises."""
    magnified = max(1.0, SHARPEST / sigma, sigma if kernel == "single-sided" else 1.0)
    compare({**soup(rng, 60), "sigma": torch.full((), sigma)}, TOLERANCE * magnified, kernel=kernel)


@pytest.mark.parametrize("size", [(1, 1), (17, 33), (31, 16), (100, 3), (16, 16)])
def test_odd_sizes(adapter, size, rng):
    compare(soup(rng, 80, *size))


@pytest.mark.parametrize("opacity", [0.0, 1e-3, 1.04 / 255, 0.5, 0.995, 1.0])
def test_extremes_of_opacity(adapter, opacity, rng):
    compare({**soup(rng, 80), "opacities": torch.full((80,), opacity)})


@pytest.mark.parametrize("layers", [255, 256, 257, 700])
def test_more_layers_than_a_batch(adapter, layers, rng):
    """Faint triangles, all over the same tiles, in an order that is not that of their depths."""
    scene = soup(rng, layers, size=2.0)
    scene["vertices"][..., 2] = scene["vertices"][..., 2] * 0.1
    scene["opacities"] = torch.full((layers,), 0.02)
    compare(scene, 4 * TOLERANCE, cutoffs=NO_CUTOFFS)


def test_saturated_pixels_stop(adapter, rng):
    compare({**soup(rng, 300, size=2.0), "opacities": torch.ones(300)})


def test_tiny_and_huge_triangles(adapter, rng):
    for size in (0.01, 30.0):
        compare(soup(rng, 100, size=size), 4 * TOLERANCE)


def test_nothing_is_drawn_of_nothing(adapter, rng):
    """No triangles, and triangles behind the camera alone, show the background."""
    empty, behind = soup(rng, 0), soup(rng, 30, views=1)
    behind["vertices"] = behind["vertices"] + torch.tensor([0.0, 0.0, 40.0])
    for scene in (empty, behind):
        seen = render(scene, "webgpu", outputs=OUTPUTS)
        assert torch.equal(seen.color, scene["backgrounds"][:, None, None].expand_as(seen.color))
        assert seen.alpha.abs().max() == 0
        assert not seen.statistics.visible.any()


def test_what_is_not_finite_is_not_drawn(adapter, rng):
    """Of triangles and of cameras: the others are drawn as without them."""
    scene = soup(rng, 60)
    rest = {name: scene[name][4:] for name in ("vertices", "face_colors", "opacities", "sigma")}
    expected = render({**scene, **rest}, "webgpu")
    scene["vertices"][0, 1, 2] = torch.nan
    scene["face_colors"][1, 0] = torch.inf
    scene["opacities"][2] = torch.nan
    scene["vertices"][3, 0, 0] = 1e30
    seen = render(scene, "webgpu", validate=False)
    assert torch.equal(seen.color, expected.color)
    scene["viewmats"] = scene["viewmats"].clone()
    scene["viewmats"][0, 0, 0] = torch.nan
    half = render(scene, "webgpu", validate=False, outputs=OUTPUTS)
    assert half.alpha[0].max() == 0
    assert not half.statistics.visible[0].any()
    assert torch.equal(half.color[1], expected.color[1])


@pytest.mark.parametrize("layout", ["per_view", "per_corner", "per_vertex"])
def test_color_layouts(adapter, layout, rng):
    compare(colored(layout, rng))


@pytest.mark.parametrize("channels", [1, 5, 17])
def test_channels(adapter, channels, rng):
    """Seventeen are more than a pass has room for."""
    compare({**soup(rng, 60, channels=channels), "backgrounds": None}, images=("color", "alpha"))


@pytest.mark.parametrize("depth", ["plane", "centroid"])
def test_depths(adapter, depth, distance, rng):
    compare(soup(rng, 80), distance=distance, depth_of=depth)


def test_the_same_bits_in_every_picture_and_thread(adapter, rng):
    """Threads draw one after the other, on the same buffers, pictures of different sizes."""
    scenes = [soup(rng, 2500 * (i + 1), 40 + 30 * i, 40) for i in range(3)]
    alone = [render(scene, "webgpu").color for scene in scenes]
    found: dict[int, list[torch.Tensor]] = {0: [], 1: [], 2: []}

    def draw(index: int) -> None:
        for _ in range(3):
            found[index].append(render(scenes[index], "webgpu").color)

    threads = [threading.Thread(target=draw, args=(index,)) for index in found]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(torch.equal(picture, alone[index]) for index, pictures in found.items() for picture in pictures)
    assert [len(pictures) for pictures in found.values()] == [3, 3, 3]


@pytest.mark.parametrize(("count", "bits"), [(1, 1), (2047, 4), (2048, 5), (2049, 11), (70000, 31)])
def test_sort(adapter, count, bits, rng):
    """As numpy's stable sort, also where keys are alike."""
    keys = torch.randint(0, 2**bits, (count,), generator=rng).numpy().astype(np.uint32)
    keys[::3] = keys[0]
    pairs = adapter.filled("test keys", keys), adapter.room("test keys 2", 4 * count)
    numbers = np.arange(count, dtype=np.uint32)
    values = adapter.filled("test values", numbers), adapter.room("test values 2", 4 * count)
    steps, sorted_keys, places = sort_steps(adapter, "test", pairs, values, count, bits)
    adapter.run(steps)
    expected = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(adapter.read(places, np.uint32, count), expected)
    np.testing.assert_array_equal(adapter.read(sorted_keys, np.uint32, count), keys[expected])


@pytest.mark.parametrize("count", [0, 1, 1024, 5000])
def test_running_sums(adapter, count, rng):
    numbers = torch.randint(0, 100, (count,), generator=rng).numpy().astype(np.uint32)
    sums = adapter.filled("test sums", np.append(numbers, np.uint32(7)))
    adapter.run([scan_step(adapter, "test step", sums, count)])
    np.testing.assert_array_equal(adapter.read(sums, np.uint32, count + 1), np.append(0, numbers.cumsum()))


def test_sums_that_are_too_large_stay_at_the_largest_number(adapter):
    sums = adapter.filled("test sums", np.full(5, 2**31, np.uint32))
    adapter.run([scan_step(adapter, "test step", sums, 4)])
    assert adapter.read(sums, np.uint32, 1, 16)[0] == 2**32 - 1


def test_workgroups_are_spread_over_two_axes():
    """There are at most 65535 along one."""
    assert spread(0) == (0, 1)
    assert spread(65535) == (65535, 1)
    for count in (65536, 10**6, 2**31):
        columns, rows = spread(count)
        assert max(columns, rows) <= 65535
        assert count <= columns * rows < count + rows


def test_it_has_no_gradients_and_says_so(adapter, rng):
    """Pictures of what learns can be drawn; one line says what to use where they are differentiated."""
    scene = prepare(soup(rng, 10), "webgpu", requires_grad=True)
    with etsplat.engine("webgpu"):
        seen = etsplat.rasterize(**scene)
    with pytest.raises(InputError, match="engine webgpu draws and has no gradients; use engine cpu or cuda"):
        seen.color.sum().backward()


def test_what_it_does_not_draw_it_names(adapter, rng):
    scene = soup(rng, 10)
    with pytest.raises(InputError, match="engine webgpu draws no distortion"):
        render(scene, "webgpu", outputs=("distortion",))
    etsplat.register_kernel("of_this_test", lambda x, sigma: torch.sigmoid((1 - x) / (0.25 * sigma)))
    try:
        with pytest.raises(InputError, match=r"draws the kernels .*, hard, not of_this_test; use engine cpu or cuda"):
            render(scene, "webgpu", kernel="of_this_test")
    finally:
        del KERNELS["of_this_test"]


def test_a_picture_that_is_too_large_is_refused(adapter, rng, monkeypatch):
    """Before anything of it is written."""
    scene = soup(rng, 200)
    monkeypatch.setattr(rasterize_module, "_MOST_SLOTS", 10)
    with pytest.raises(InputError, match="touch more than 10 tiles"):
        render(scene, "webgpu")
    monkeypatch.setattr(adapter, "most_bytes", 4000)
    monkeypatch.setattr(adapter, "_buffers", {})
    with pytest.raises(InputError, match=r"needs 19,200 bytes in one buffer and .* takes 4,000"):
        render(scene, "webgpu")


def test_without_wgpu_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "wgpu", None)
    with pytest.raises(EngineUnavailableError, match=r"needs wgpu .*pip install 'etsplat\[webgpu\]'"):
        WebGpu()


def test_without_an_adapter_it_says_what_is_missing(monkeypatch):
    class Wgpu:
        class gpu:  # noqa: N801
            @staticmethod
            def request_adapter_sync(**_):
                raise RuntimeError("no adapter")

    class Extras:
        @staticmethod
        def set_instance_extras(backends):
            raise RuntimeError("instance already exists")

    modules = {"wgpu": Wgpu, "wgpu.backends.wgpu_native.extras": Extras}
    monkeypatch.setattr(device_module.importlib, "import_module", modules.__getitem__)
    with pytest.raises(EngineUnavailableError, match="found no GPU with Vulkan, Metal or DirectX 12"):
        WebGpu()


def test_it_is_chosen_for_pictures_alone():
    """By its name, on the CPU's tensors; training does not offer it."""
    assert "webgpu" in engine_names()
    assert "webgpu" not in training_engines()
    with pytest.raises(InputError, match="engine: webgpu does not compute on device cuda"):
        resolve_device("cuda", "webgpu")
    with pytest.raises(InputError, match="engine"):
        replace(etsplat.TrainConfig(), engine="webgpu")
