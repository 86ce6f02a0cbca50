import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.io.images import save_image
from etsplat.metrics.flip import flip
from etsplat.metrics.image import colors_fitted, psnr, ssim
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.opened_runs import SoupRun
from etsplat.tasks.scoring import evaluate_run
from helpers.captures import write_colmap, write_photo


@pytest.fixture
def soup(rng):
    return TriangleSoup.from_triangles(
        torch.randn(40, 1, 3, generator=rng) * 0.3 + torch.randn(40, 3, 3, generator=rng) * 0.5,
        torch.rand(40, 3, generator=rng),
        opacity=0.9,
        sigma=0.3,
        sh_degree=0,
    )


def test_numbers_are_the_metrics_of_each_view_and_their_mean(tmp_path, soup):
    write_colmap(tmp_path / "scene", [(33, 24)] * 9)
    run = SoupRun(tmp_path, soup, load_dataset(tmp_path / "scene"))
    found = evaluate_run(run, pictures=tmp_path / "pictures")
    assert [row["name"] for row in found["views"]] == ["0000", "0008"]
    for row, view in zip(found["views"], (0, 8), strict=True):
        photo = run.capture.images[view].float() / 255
        image = soup.render(run.capture.cameras[view]).color[0].detach().clamp(0, 1)
        opaque = soup.render_opaque(run.capture.cameras[view])[0, ..., :3]
        assert row["psnr"] == pytest.approx(psnr(image, photo))
        assert row["psnr_8bit"] == pytest.approx(psnr(image, photo), abs=0.02)
        assert row["ssim"] == pytest.approx(ssim(image, photo))
        assert row["ssim_interior"] == pytest.approx(ssim(image, photo, interior=True))
        assert row["flip"] == pytest.approx(float(flip(image, photo)))
        assert row["flip_opaque"] == pytest.approx(float(flip(opaque, photo)))
        assert row["psnr_opaque"] == pytest.approx(psnr(opaque, photo))
        assert row["psnr_affine"] == pytest.approx(psnr(colors_fitted(image, photo), photo))
        assert row["psnr_affine"] > row["psnr"]
    assert found["psnr"] == pytest.approx(np.mean([row["psnr"] for row in found["views"]]))
    assert found["fps"] == pytest.approx(1e3 / found["ms_per_frame"])
    assert found["ms_per_million"] == pytest.approx(found["ms_per_frame"] * 25_000)
    assert (found["lpips"] is None) == (found["lpips_reason"] is not None)
    assert Image.open(tmp_path / "pictures" / "0000.png").size == (4 * 33, 24)


def test_masked_pixels_do_not_count(tmp_path, soup):
    """With a mask that excludes everything the photograph stands in for the render."""
    write_colmap(tmp_path / "scene", [(33, 24)] * 2)
    for index in range(2):
        write_photo(tmp_path / "scene" / "masks" / f"{index:04d}.png", 33, 24)
        save_image(tmp_path / "scene" / "masks" / f"{index:04d}.png", torch.zeros(24, 33, 1))
    found = evaluate_run(SoupRun(tmp_path, soup, load_dataset(tmp_path / "scene")))
    assert found["psnr"] == float("inf")
    assert found["ssim"] == pytest.approx(1.0)


def test_without_test_views_there_is_nothing_to_measure(tmp_path, soup):
    write_colmap(tmp_path / "scene", [(33, 24)] * 2)
    capture = load_dataset(tmp_path / "scene")
    capture.test.clear()
    with pytest.raises(InputError, match="no test views"):
        evaluate_run(SoupRun(tmp_path, soup, capture))
