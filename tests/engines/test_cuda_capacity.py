"""What does not fit into the kernels' numbers is refused before anything is launched."""

import pytest
import torch

from etsplat import rasterize
from etsplat.engines.cuda import capacity, channels
from etsplat.engines.cuda.capacity import check_numbers, check_summed
from helpers.engines import on
from helpers.operations import CASES
from helpers.scenes import soup

BITS_30, BITS_25 = 1 << 30, 1 << 25


def test_triangles_and_tiles_of_all_views_have_30_bits():
    check_numbers(1, BITS_30 - 1, BITS_30 - 1)
    check_numbers(64, BITS_30 // 64 - 1, 1)
    for views, triangles, tiles in ((1, BITS_30, 1), (64, BITS_30 // 64, 1), (1 << 20, 1, 1 << 10)):
        with pytest.raises(ValueError, match=r"rasterize: \d+ views of \d+ (triangles|tiles of pixels) are more than"):
            check_numbers(views, triangles, tiles)


def test_sums_over_pixels_have_room_for_25_bits():
    """A value is 38 bits wide; 2^25 of them would reach the sign of 64."""
    check_summed("any", BITS_25 - 1, 1)
    check_summed("any", 4096 * 2160, 3)
    for pixels, values in ((BITS_25, 1), (BITS_25 // 3 + 1, 3)):
        with pytest.raises(ValueError, match=rf"any: a view has {pixels} pixels, .* over \d+ at most"):
            check_summed("any", pixels, values)


def test_a_picture_that_is_too_large_for_its_gradients_is_refused():
    """Of one number that is repeated, so that nothing of its size is made."""
    chosen = torch.zeros(1, dtype=torch.int32).expand(1, 1 << 13, 1 << 13)
    with pytest.raises(ValueError, match="pick_values: a view has 67108864 pixels"):
        channels._pick(True, torch.rand(1, 5), chosen)


def test_operations_ask_before_they_launch(cuda_engine, rng, monkeypatch):
    """With smaller numbers, as if these were what fits."""
    scene = soup(rng, 40)
    on(cuda_engine, rasterize, **scene)
    monkeypatch.setattr(capacity, "_MOST", len(scene["viewmats"]) * 40 - 1)
    with pytest.raises(ValueError, match="views of 40 triangles are more than"):
        on(cuda_engine, rasterize, **scene)
    monkeypatch.setattr(capacity, "_MOST_SUMMED", 3 * 24 * 20 - 1)
    leaves, run = CASES["rasterize_antialiased/face_colors"](rng, cuda_engine)
    run(**leaves)  # without gradients
    with pytest.raises(ValueError, match="rasterize_antialiased: a view has"):
        run(**{key: leaf.requires_grad_() for key, leaf in leaves.items()})
