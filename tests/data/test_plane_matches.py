"""The best planes by native code and by torch."""

import math
from collections.abc import Iterator

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat import _native
from etsplat.data.plane_matches import AGREEING, Matches, Neighbour, best_matches, matches_in_torch
from etsplat.engines.threads import num_threads, set_num_threads


@pytest.fixture(params=_native.available_instruction_sets())
def instruction_set(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each compiled path in turn."""
    _native.set_instruction_set(request.param)
    yield request.param
    _native.set_instruction_set("")


def painted(x: Float[Tensor, "h w"], y: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Waves that are a few pixels long."""
    waves = (0.9 * x + 0.3 * y).sin() + (0.5 * y - 0.7 * x).sin() + (1.3 * y + 0.2 * x).cos()
    return 0.5 + waves / 8


def pair(height: int, width: int, shift: float = 8.0) -> tuple[Float[Tensor, "h w"], list[Neighbour]]:
    """A photo of a plane at depth 1, and neighbours that see it moved by up to `shift` pixels times the inverse depth.

    Of other sizes than the photo; the last of them looks away.
    """
    row, column = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    grey, neighbours = painted(column, row), []
    for number, (across, down) in enumerate([(shift, 0.0), (0.0, shift), (-shift, -shift / 2), (shift, shift)]):
        h, w = height + 3 * number, width - 2 * number
        there_row, there_column = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
        rays, start = torch.eye(3, dtype=torch.float64), torch.tensor([across, down, 0.0], dtype=torch.float64)
        rays[2, 2] = -1.0 if number == 3 else 1.0
        neighbours.append(Neighbour(painted(there_column - across, there_row - down), rays, start))
    return grey, neighbours


def planes(count: int = 33) -> Float[Tensor, " D"]:
    """Around inverse depth 1, which is the middle one and a quarter."""
    return 1.0 + (torch.arange(count) - count // 2 - 0.25) * 0.05


@pytest.mark.sanitize
@pytest.mark.parametrize(("height", "width"), [(40, 53), (7, 16), (3, 8), (33, 64)])
def test_native_code_finds_what_torch_finds(instruction_set: str, height: int, width: int) -> None:
    """For photos of any size, smaller than a window too."""
    grey, neighbours = pair(height, width)
    here, there = best_matches(grey, neighbours, planes()), matches_in_torch(grey, neighbours, planes())
    torch.testing.assert_close(here.best, there.best, rtol=0, atol=1e-4)
    assert torch.equal(here.contrast, there.contrast)
    same = (here.place - there.place).abs() < 0.01
    assert float(same.float().mean()) > 0.99  # two planes may be as good, but for rounding
    torch.testing.assert_close(here.elsewhere[same], there.elsewhere[same], rtol=0, atol=1e-4)


def test_the_true_plane_is_found(instruction_set: str) -> None:
    """With its fraction, where the neighbours show it, and clearly better than others."""
    grey, neighbours = pair(48, 64)
    found = best_matches(grey, neighbours, planes())
    inner = (slice(12, -12), slice(12, -12))
    assert float((found.place[inner] - 16.25).abs().quantile(0.95)) < 0.1
    assert float(found.best[inner].quantile(0.05)) > 0.98
    assert float((found.best - found.elsewhere)[inner].median()) > 0.1


def test_the_best_neighbours_judge(instruction_set: str) -> None:
    """Others may show anything."""
    grey, neighbours = pair(48, 64)
    generator = torch.Generator().manual_seed(0)
    noise = [each._replace(grey=torch.rand(each.grey.shape, generator=generator)) for each in neighbours]
    found = best_matches(grey, [noise[0], *neighbours[:AGREEING], noise[2]], planes())
    alone = best_matches(grey, neighbours[:AGREEING], planes())
    assert torch.equal(found.best.maximum(alone.best), found.best)
    inner = (slice(12, -12), slice(12, -12))
    assert float((found.place[inner] - 16.25).abs().quantile(0.9)) < 0.1


def test_what_no_neighbour_shows_matches_nothing(instruction_set: str) -> None:
    """Behind them, or beside what they show."""
    grey, neighbours = pair(24, 32)
    away = [each._replace(start=torch.tensor([1e3, 0.0, 0.0], dtype=torch.float64)) for each in neighbours[:2]]
    behind = [each._replace(rays=-each.rays, start=-each.start) for each in neighbours[:2]]
    for some in (away, behind):
        found = best_matches(grey, some, planes())
        assert (found.best == -1).all()
        assert (found.place == -1).all()


def test_the_first_and_last_planes_have_no_place() -> None:
    """For what is beyond them nobody knows."""
    grey, neighbours = pair(48, 64)
    inner = (slice(12, -12), slice(12, -12))
    for end in (slice(16, None), slice(None, 17)):
        ended = best_matches(grey, neighbours, planes()[end]).place[inner]
        assert float((ended == -1).float().mean()) > 0.9


def test_bits_do_not_depend_on_threads(instruction_set: str) -> None:
    grey, neighbours = pair(40, 53)
    before, found = num_threads(), list[Matches]()
    for threads in (1, 3):
        set_num_threads(threads)
        found.append(best_matches(grey, neighbours, planes()))
    set_num_threads(before)
    for first, second in zip(*found, strict=True):
        assert torch.equal(first, second)


def test_too_few_neighbours_are_refused() -> None:
    grey, neighbours = pair(8, 8)
    with pytest.raises(ValueError, match="too few or too many neighbours"):
        best_matches(grey, neighbours[:1], planes())


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_finds_what_the_cpu_finds() -> None:
    grey, neighbours = pair(48, 64)
    moved = [Neighbour(*(each.to("cuda") for each in neighbour)) for neighbour in neighbours]
    there = best_matches(grey.to("cuda"), moved, planes().to("cuda"))
    here = best_matches(grey, neighbours, planes())
    torch.testing.assert_close(there.best.cpu(), here.best, rtol=0, atol=1e-4)
    assert math.isclose(float(there.place.cpu().median()), float(here.place.median()), abs_tol=0.01)
