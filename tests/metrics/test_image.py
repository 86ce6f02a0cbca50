import hashlib
import math
import pickle
import warnings

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.ndimage import correlate

from etsplat.core.errors import InputError
from etsplat.metrics import image as image_metrics
from etsplat.metrics.image import Lpips, colors_fitted, find_lpips_weights, psnr, silhouette_iou, ssim
from helpers.torch_threads import on_each_count


@pytest.fixture
def pair():
    """A smooth picture and a noisy, darker copy of it."""
    generator = torch.Generator().manual_seed(5)
    y, x = torch.meshgrid(torch.linspace(0, 6, 37), torch.linspace(0, 5, 29), indexing="ij")
    truth = torch.stack([torch.sin(x + y), torch.cos(2 * x - y), torch.sin(3 * y)], dim=-1) / 2 + 0.5
    return (0.9 * truth + 0.1 * torch.rand(truth.shape, generator=generator)).clamp(0, 1), truth


@pytest.fixture(scope="module")
def weights():
    """Random weights of the right names and shapes, the linear ones positive; the convolutions keep the scale."""
    generator = torch.Generator().manual_seed(7)
    entries = {}
    for key, value in Lpips().state_dict().items():
        random = torch.randn(value.shape, generator=generator)
        entries[key] = random.abs() if key.startswith("lin") else random * (2 / max(value[0].numel(), 1)) ** 0.5
    return entries


def test_colors_are_fitted_where_an_affine_map_explains_them() -> None:
    """The map is undone; what does not count or lies behind has no say, and the background stays."""
    rng = torch.Generator().manual_seed(3)
    image, matrix, shift = torch.rand((9, 8, 3), generator=rng), torch.eye(3) + 0.1, torch.tensor([0.02, 0.0, 0.05])
    truth = 0.6 * image @ matrix.T + shift
    torch.testing.assert_close(colors_fitted(image, truth), truth, atol=1e-5, rtol=0)
    counts, wrong = torch.ones(9, 8), truth.clone()
    counts[:4], wrong[:4] = 0, 1.0
    torch.testing.assert_close(colors_fitted(image, wrong, counts=counts), truth, atol=1e-5, rtol=0)

    coverage, behind = torch.rand((9, 8, 1), generator=rng), torch.tensor([0.9, 0.2, 0.4])
    seen, photo = (coverage * picture + (1 - coverage) * behind for picture in (image, truth))
    fitted = colors_fitted(seen, photo, coverage=coverage[..., 0], background=behind)
    torch.testing.assert_close(fitted, photo, atol=1e-5, rtol=0)
    black = torch.zeros(4, 4, 3)
    assert torch.equal(colors_fitted(black, black), black)
    assert psnr(colors_fitted(image, image.flip(0)), image.flip(0)) >= psnr(image, image.flip(0))
    with pytest.raises(ValueError, match="shape"):
        colors_fitted(image, truth[:4])


def test_silhouette_iou_counts_pixels_covered_by_half() -> None:
    """Two of four covered pixels in common; equal and empty silhouettes give 1."""
    ours = torch.tensor([[1.0, 0.6, 0.5], [0.4, 0.0, 0.0]])
    theirs = torch.tensor([[1.0, 0.5, 0.0], [1.0, 0.0, 0.0]])
    assert silhouette_iou(ours, theirs) == 0.5
    assert silhouette_iou(ours, ours) == 1.0
    assert silhouette_iou(torch.zeros(2, 2), torch.zeros(2, 2)) == 1.0


def test_psnr_is_minus_10_log10_of_the_mean_squared_error(pair):
    image, truth = pair
    error = np.mean((image.numpy().astype(np.float64) - truth.numpy()) ** 2)
    assert psnr(image, truth) == pytest.approx(10 * math.log10(1 / error), abs=1e-9)
    assert psnr(torch.full((4, 4, 3), 0.6), torch.full((4, 4, 3), 0.5)) == pytest.approx(20, abs=1e-4)
    assert psnr(truth, truth) == math.inf


def ssim_map(a, b):
    """SSIM of one channel by its definition, in float64 numpy, with a full 2-D window and zeros outside."""
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()

    def mean(values):
        return correlate(values, window, mode="constant")

    mean_a, mean_b = mean(a), mean(b)
    variance_a, variance_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
    return luminance * (2 * covariance + 9e-4) / (variance_a + variance_b + 9e-4)


def test_ssim_agrees_with_its_definition_whole_and_interior(pair):
    image, truth = (value.numpy().astype(np.float64) for value in pair)
    maps = np.stack([ssim_map(image[..., c], truth[..., c]) for c in range(3)])
    assert ssim(*pair) == pytest.approx(maps.mean(), abs=1e-12)
    assert ssim(*pair, interior=True) == pytest.approx(maps[:, 5:-5, 5:-5].mean(), abs=1e-12)


def test_ssim_is_one_for_equal_images_symmetric_and_falls_with_noise(pair):
    image, truth = pair
    assert ssim(truth, truth) == pytest.approx(1, abs=1e-12)
    assert ssim(image, truth) == pytest.approx(ssim(truth, image), abs=1e-12)
    noise = 0.3 * torch.rand(truth.shape, generator=torch.Generator().manual_seed(0))
    assert ssim(truth + noise, truth) < ssim(image, truth) < 1


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_shapes_that_do_not_fit_are_refused(metric, pair):
    with pytest.raises(ValueError, match="truth: expected the image's shape"):
        metric(pair[0], pair[1][:-1])
    with pytest.raises(ValueError, match=r"image: expected shape \(H, W, C\)"):
        metric(pair[0][None], pair[1][None])
    with pytest.raises(ValueError, match="image must be of floating-point numbers"):
        metric(pair[0].byte(), pair[1])
    with pytest.raises(ValueError, match="image: expected a pixel or more"):
        metric(pair[0][:0], pair[1][:0])
    with pytest.raises(ValueError, match="at least 11 pixels"):
        ssim(pair[0][:8], pair[1][:8], interior=True)


def straightforward_lpips(entries, image, truth, rescale):
    """The formula of the paper written out in float64: convolutions by hand-listed names, layer by layer."""
    convolutions = [[0, 2], [5, 7], [10, 12, 14], [17, 19, 21], [24, 26, 28]]
    entries = {key: value.double() for key, value in entries.items()}

    def features(picture):
        x = picture.double().permute(2, 0, 1)[None]
        if rescale:
            x = x * 2 - 1
        x = torch.stack([(x[:, 0] + 0.030) / 0.458, (x[:, 1] + 0.088) / 0.448, (x[:, 2] + 0.188) / 0.450], dim=1)
        stages = []
        for stage, names in enumerate(convolutions):
            if stage > 0:
                x = torch.nn.functional.max_pool2d(x, 2)
            for name in names:
                weight, bias = entries[f"features.{name}.weight"], entries[f"features.{name}.bias"]
                x = torch.relu(torch.nn.functional.conv2d(x, weight, bias, padding=1))
            stages.append(x / (x.pow(2).sum(1, keepdim=True).sqrt() + 1e-10))
        return stages

    total = 0.0
    for stage, (a, b) in enumerate(zip(features(image), features(truth), strict=True)):
        weight = entries[f"lin{stage}.model.1.weight"].view(1, -1, 1, 1)
        total += float(((a - b) ** 2 * weight).sum(1).mean())
    return total


@pytest.mark.parametrize("rescale", [True, False])
def test_lpips_agrees_with_the_formula_in_float64(tmp_path, weights, pair, rescale):
    save_file(weights, tmp_path / "w.safetensors")
    lpips = Lpips.from_weights(tmp_path / "w.safetensors")
    expected = straightforward_lpips(weights, *pair, rescale)
    assert float(lpips(*pair, rescale=rescale)) == pytest.approx(expected, rel=1e-4)
    assert float(lpips(pair[1], pair[1], rescale=rescale)) == 0


def test_lpips_reads_one_file_or_the_two_usual_ones_and_ignores_other_entries(tmp_path, weights, pair):
    trunk = {key: value for key, value in weights.items() if key.startswith("features")}
    linear = {key: value for key, value in weights.items() if key.startswith("lin")}
    torch.save(weights, tmp_path / "all.pth")
    torch.save(trunk | {"classifier.0.bias": torch.zeros(3)}, tmp_path / "vgg16.pth")
    torch.save(linear, tmp_path / "vgg.pth")
    one = Lpips.from_weights(tmp_path / "all.pth")
    two = Lpips.from_weights(tmp_path / "vgg16.pth", tmp_path / "vgg.pth")
    assert float(one(*pair)) == float(two(*pair)) > 0


def test_unusable_weights_are_one_line_input_errors(tmp_path, weights):
    with pytest.raises(InputError, match="no such file"):
        Lpips.from_weights(tmp_path / "absent.pth")
    (tmp_path / "text.pth").write_text("not weights")
    (tmp_path / "letter.pth").write_text("hi\n")
    (tmp_path / "text.safetensors").write_text("not weights")
    (tmp_path / "code.pth").write_bytes(pickle.dumps(print, protocol=2))
    torch.save([1, 2], tmp_path / "list.pth")
    torch.save({key: value for key, value in weights.items() if "lin3" not in key}, tmp_path / "part.pth")
    torch.save(weights | {"lin0.model.1.weight": torch.ones(1, 3, 1, 1)}, tmp_path / "shape.pth")
    data = (tmp_path / "part.pth").read_bytes()
    (tmp_path / "cut.pth").write_bytes(data[: len(data) // 2])
    for name, message in [
        ("text.pth", "not a readable"),
        ("letter.pth", "not a readable"),
        ("text.safetensors", "not a readable"),
        ("code.pth", "not a readable"),
        ("cut.pth", "not a readable"),
        ("list.pth", "not a state dict"),
        ("part.pth", r"missing \(first: lin3"),
        ("shape.pth", r"lin0\.model\.1\.weight has shape"),
    ]:
        with pytest.raises(InputError, match=message) as raised:
            Lpips.from_weights(tmp_path / name)
        assert "\n" not in str(raised.value)


def test_weights_are_looked_for_in_torchs_cache_and_absence_is_a_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    found = find_lpips_weights(None)
    assert found.paths == ()
    assert "vgg16-397923af.pth" in (found.reason or "")
    (tmp_path / "checkpoints").mkdir()
    for name in ("vgg16-397923af.pth", "vgg.pth"):
        (tmp_path / "checkpoints" / name).write_bytes(b"x")
    assert [path.name for path in find_lpips_weights(None).paths] == ["vgg16-397923af.pth", "vgg.pth"]
    with pytest.raises(InputError, match="no such file"):
        find_lpips_weights(tmp_path / "absent.pth")


def test_download_fetches_into_the_cache_what_is_meant_and_nothing_else(tmp_path, monkeypatch):
    """Served from local files; a source that is not there fails as a missing network does. Another file than the one
    that is meant is refused, and one that is in the cache replaced."""

    def source(name, meant):
        return (tmp_path / name).as_uri(), hashlib.sha256(meant).hexdigest()

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "cache"))
    monkeypatch.setattr(image_metrics, "_WEIGHTS", {"1.pth": source("a", b"trunk"), "2.pth": source("b", b"linear")})
    (tmp_path / "a").write_bytes(b"trunk")
    with pytest.raises(InputError, match="cannot be downloaded"):
        find_lpips_weights("download")
    (tmp_path / "b").write_bytes(b"junk")
    with pytest.raises(InputError, match="is another file now"):
        find_lpips_weights("download")
    assert [path.name for path in (tmp_path / "cache" / "checkpoints").iterdir()] == ["1.pth"]
    (tmp_path / "b").write_bytes(b"linear")
    (tmp_path / "cache" / "checkpoints" / "2.pth").write_bytes(b"junk of an earlier version")
    found = find_lpips_weights("download")
    assert [path.read_bytes() for path in found.paths] == [b"trunk", b"linear"]
    (tmp_path / "b").unlink()
    assert find_lpips_weights("download") == found  # without a network


def test_lpips_refuses_images_too_small_for_its_five_stages_and_weights_at_random(weights):
    lpips = Lpips()
    with pytest.raises(ValueError, match="Lpips has no weights"):
        lpips(torch.zeros(16, 16, 3), torch.zeros(16, 16, 3))
    lpips.load_state_dict(weights)
    assert float(lpips(torch.zeros(16, 16, 3), torch.zeros(16, 16, 3))) == 0
    with pytest.raises(ValueError, match="at least 16 pixels"):
        lpips(torch.zeros(8, 30, 3), torch.zeros(8, 30, 3))


def test_silhouettes_of_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"truth must have the coverage's shape \(5, 6\), got \(5, 1\)"):
        silhouette_iou(torch.rand(5, 6), torch.rand(5, 1))


def test_equal_bits_on_any_number_of_torchs_threads(rng):
    """Of pictures large enough that torch shares their sums out."""
    image, truth = (torch.rand(401, 403, 3, generator=rng) for _ in range(2))
    found = on_each_count(lambda: (psnr(image, truth), ssim(image, truth), ssim(image, truth, interior=True)))
    assert len(set(found)) == 1


@pytest.mark.parametrize("measure", [psnr, ssim])
def test_pictures_of_other_programs_are_told_apart(measure):
    """Channels first had an SSIM of 32 channels along 3 rows; bytes as floats a PSNR below 0."""
    picture = torch.rand(32, 32, 3)
    with pytest.raises(ValueError, match=r"image: expected shape \(H, W, C\), got \(3, 32, 32\): pass image\.permute"):
        measure(picture.permute(2, 0, 1), picture.permute(2, 0, 1))
    with pytest.raises(ValueError, match=r"truth: expected values in \[0, 1\], got others; divide by 255"):
        measure(picture, 255 * picture)
    assert math.isfinite(measure(255 * picture, picture))  # as an optimization may leave it


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_pictures_that_require_gradients_are_measured_without_a_warning(metric, pair):
    """As they come from a renderer, before a step; torch warns where such a tensor becomes a number."""
    image, truth = pair
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert metric(image.clone().requires_grad_(), truth) == metric(image, truth)
