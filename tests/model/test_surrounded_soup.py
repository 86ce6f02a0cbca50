"""Triangles that learn among others: pictures are of all, everything else is of those that learn."""

from dataclasses import replace

import pytest
import torch

from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.model.surrounded_soup import SurroundedSoup
from etsplat.model.triangle_soup import TriangleSoup


@pytest.fixture
def soups(rng: torch.Generator) -> tuple[TriangleSoup, TriangleSoup]:
    """Thirty triangles about the origin, in two parts."""
    vertices = 0.6 * torch.randn(30, 1, 3, generator=rng) + 0.4 * torch.randn(30, 3, 3, generator=rng)
    whole = TriangleSoup.from_triangles(vertices, torch.rand(30, 3, generator=rng), opacity=0.6, sigma=0.7, sh_degree=1)
    whole.appearance = replace(whole.appearance, cull_large=0.8)
    first = torch.arange(30) < 18
    return whole.kept(first).learnable(), whole.kept(~first)


def cameras(count: int) -> Cameras:
    eyes = torch.tensor([[0.0, 0.5, 4.0], [3.0, 1.0, 2.5]])[:count]
    viewmats = torch.cat([look_at(eye[None], torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])) for eye in eyes])
    return Cameras(viewmats, intrinsics(50.0, 40, 30).expand(count, 3, 3), 40, 30)


@pytest.mark.parametrize("count", [1, 2])
def test_pictures_and_gradients_are_those_of_one_soup(soups: tuple[TriangleSoup, TriangleSoup], count: int) -> None:
    own, rest = soups
    together = own.joined(rest)
    among = SurroundedSoup.among(own, rest)
    outputs = ("color", "statistics")
    one, other = together.render(cameras(count), outputs=outputs), among.render(cameras(count), outputs=outputs)
    assert torch.equal(one.color, other.color)
    assert one.statistics is not None
    assert other.statistics is not None
    for name, values in vars(other.statistics).items():
        assert torch.equal(values, getattr(one.statistics, name)[:, :18])
    one.color.square().sum().backward()
    other.color.square().sum().backward()
    for name, parameter in among.parameters().items():
        gradient, wanted = parameter.grad, together.parameters()[name].grad
        assert gradient is not None
        assert wanted is not None
        assert torch.equal(gradient, wanted[:18])
    assert all(tensor.grad is None for tensor in rest.parameters().values())
    assert torch.equal(together.render_opaque(cameras(count)), among.render_opaque(cameras(count)))


def test_the_rest_is_drawn_as_it_is_whatever_squeezes_the_others(soups: tuple[TriangleSoup, TriangleSoup]) -> None:
    own, rest = soups
    among = SurroundedSoup.among(own, rest)
    among.appearance = replace(own.appearance, opacity_floor=0.9, sigma_ceiling=0.1)
    drawn = among.drawn(cameras(1), culls=False)
    assert float(drawn.opacities[:18].detach().min()) > 0.9
    assert torch.allclose(drawn.opacities[18:], torch.full((12,), 0.6))
    finished = among.finished()
    assert isinstance(finished, SurroundedSoup)
    assert torch.allclose(finished.render(cameras(1)).color, among.render(cameras(1)).color, atol=1e-5)


def test_count_state_and_files_are_of_those_that_learn(soups: tuple[TriangleSoup, TriangleSoup], tmp_path) -> None:
    own, rest = soups
    among = SurroundedSoup.among(own, rest)
    assert among.count == 18
    assert all(len(tensor) == 18 for tensor in among.state().values())
    among.save(tmp_path / "soup.safetensors")
    assert len(TriangleSoup.load(tmp_path / "soup.safetensors")) == 18
    moved = among.to(torch.device("cpu"))
    assert torch.equal(moved.render(cameras(1)).color, among.render(cameras(1)).color)
    assert len(among.everything()) == 30


def test_plain_colors_of_the_rest_learn_where_that_is_asked_for(soups: tuple[TriangleSoup, TriangleSoup]) -> None:
    """With the gradient that they have in one soup; everything else of the rest stays, the rest itself too."""
    own, rest = soups
    given = rest.sh_dc.clone()
    together, among = own.joined(rest), SurroundedSoup.among(own, rest, recolored=True)
    for soup in (together, among):
        soup.render(cameras(1)).color.square().sum().backward()
    assert list(among.parameters()) == [*TriangleSoup.RATES, "rest_dc"]
    assert among.rest_dc is not None
    assert among.rest_dc.grad is not None
    assert together.sh_dc.grad is not None
    assert torch.equal(among.rest_dc.grad, together.sh_dc.grad[18:])
    with torch.no_grad():
        among.rest_dc += 0.5
    assert torch.equal(rest.sh_dc, given)
    assert torch.equal(among.everything().sh_dc[18:], given + 0.5)
    assert torch.equal(among.finished().render(cameras(1)).color, among.everything().render(cameras(1)).color)
    few = among.kept(torch.arange(18) < 4)
    assert isinstance(few, SurroundedSoup)
    assert len(few) == 4
    assert torch.equal(few.everything().sh_dc[4:], given + 0.5)
