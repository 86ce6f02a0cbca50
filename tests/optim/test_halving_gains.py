"""Which faces photos agree to halve: corrections of halves, tried on photos that they do not know."""

import pytest
import torch

from etsplat.optim.halving_gains import HalvingGains

PHOTOS, PIXELS = 8, 40
CORNERS = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 3, 0]], [[0.0, 0, 5], [4, 0, 5], [0, 3, 5]]])
"""The longest edge of each runs from its second to its third corner."""


def barycentrics_of(generator: torch.Generator) -> torch.Tensor:
    """Anywhere in a face."""
    b = torch.rand(PIXELS, 3, generator=generator) + 0.01
    return b / b.sum(dim=1, keepdim=True)


def expected_gain(photos: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]) -> float:
    """By least squares with a row a pixel and three for the ridge, in float64: (b, lacking, counted) by photo."""

    def fitted(b: torch.Tensor, y: torch.Tensor, w: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
        rows = torch.cat([w.sqrt()[:, None] * b, torch.eye(3).double()])
        sought = torch.cat([w.sqrt()[:, None] * (y - b @ start), torch.zeros(3, 3).double()])
        return start + torch.linalg.lstsq(rows, sought).solution

    gain, none = 0.0, torch.zeros(3, 3).double()
    data = [tuple(each.double() for each in photo) for photo in photos]
    for left_out in range(4):
        known = [data[i] for i in range(len(data)) if i % 4 != left_out]
        tried = [data[i] for i in range(len(data)) if i % 4 == left_out]
        b, y, w = (torch.cat(each) for each in zip(*known, strict=True))
        whole = fitted(b, y, w, none)
        second = b[:, 2] > b[:, 1]
        halves = [fitted(b[rows], y[rows], w[rows], whole) for rows in (~second, second)]
        for b, y, w in tried:
            second = b[:, 2] > b[:, 1]
            of_half = torch.where(second[:, None], b @ halves[1], b @ halves[0])
            left = ((y - b @ whole).square() - (y - of_half).square()).sum(dim=1)
            gain += float((w * left).sum())
    return gain


def test_gains_are_those_of_least_squares_on_photos_left_out() -> None:
    """Of two faces, with pixels that count in part and others in which no face is; to float32's digits."""
    generator = torch.Generator().manual_seed(0)
    gains, photos = HalvingGains(CORNERS), ([], [])
    for photo in range(PHOTOS):
        face = torch.randint(-1, 2, (PIXELS,), generator=generator)
        b, lacking = barycentrics_of(generator), torch.randn(PIXELS, 3, generator=generator)
        counted = torch.rand(PIXELS, generator=generator)
        gains.add(photo, face, b, lacking, counted)
        for number, own in enumerate(photos):
            own.append((b[face == number], lacking[face == number], counted[face == number]))
    found = gains.gains()
    assert found.dtype == torch.float64
    for number, own in enumerate(photos):
        assert float(found[number]) == pytest.approx(expected_gain(own), rel=1e-4, abs=1e-3)


def test_photos_agree_on_an_edge_and_not_on_noise() -> None:
    """What every photo lacks in one half is gained; what each lacks elsewhere is not, though each would fit it."""
    generator = torch.Generator().manual_seed(1)
    gains = HalvingGains(CORNERS)
    for photo in range(PHOTOS):
        b = barycentrics_of(generator)
        edge = torch.where(b[:, 2:] > b[:, 1:2], 0.3, -0.3).expand(PIXELS, 3)
        gains.add(photo, torch.zeros(PIXELS, dtype=torch.int64), b, edge, torch.ones(PIXELS))
        few = slice(0, 2)
        noise = 0.3 * torch.randn(1, 3, generator=generator).expand(2, 3)
        gains.add(photo, torch.ones(2, dtype=torch.int64), b[few], noise, torch.ones(2))
    agreed, alone = gains.gains().tolist()
    assert agreed > 0.5 * PHOTOS * PIXELS * 3 * 0.3**2 * 0.25  # a linear correction explains three quarters of an edge
    assert alone < 0


def test_a_single_photo_decides_nothing() -> None:
    """There is none to try on what it says, and nothing is gained in faces that none shows."""
    gains = HalvingGains(CORNERS)
    b = barycentrics_of(torch.Generator().manual_seed(2))
    gains.add(
        0,
        torch.zeros(PIXELS, dtype=torch.int64),
        b,
        torch.where(b[:, 2:] > b[:, 1:2], 0.3, -0.3) * torch.ones(3),
        torch.ones(PIXELS),
    )
    assert gains.gains().tolist() == [0.0, 0.0]
