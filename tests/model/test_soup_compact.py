"""Soups go into compact files and come back, the most important triangles first."""

from dataclasses import replace

import pytest
import torch

import etsplat
from etsplat.core.errors import InputError
from etsplat.core.kernels import KERNELS
from etsplat.io.compact_soups import CHUNK, encode_compact, enlargement
from etsplat.metrics.image import psnr
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.soup_compact import CUT_SHORT, compact_of, importance, ranks
from etsplat.model.soup_import import load_soup
from etsplat.model.triangle_soup import TriangleSoup

CAMERA = etsplat.orbit_cameras(64, 48, azimuths=1)[0]


def make_soup(rng, count=200, degree=3, **appearance):
    made = TriangleSoup.from_triangles(
        torch.randn(count, 1, 3, generator=rng) * 0.5 + torch.randn(count, 3, 3, generator=rng) * 0.15,
        torch.rand(count, 3, generator=rng),
        opacity=0.5,
        sigma=0.5,
        sh_degree=degree,
    )
    state = made.state()
    state["opacity_logits"] = torch.randn(count, generator=rng) * 2
    state["sigma_raw"] = torch.randn(count, generator=rng) * 0.5 - 0.5
    state["sh_rest"] = torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=rng) * 0.1
    return TriangleSoup(**state, appearance=SoupAppearance(**appearance), notes={"focal": "60.0"})


def written(soup, path, order=None):
    path.write_bytes(encode_compact(compact_of(soup, importance(soup) if order is None else order)))
    return load_soup(path)


@pytest.mark.parametrize(
    "appearance",
    [
        {"kernel": "elastic"},
        {"kernel": "bilateral", "background": (0.2, 0.5, 0.9), "sh_degree": 1},
        {"kernel": "single_sided", "distance": "sdf", "cull_large": 2.0},
        {"opacity_floor": 0.4, "sigma_ceiling": 0.3},
    ],
    ids=str,
)
def test_what_comes_back_looks_the_same(tmp_path, rng, appearance):
    soup = make_soup(rng, **appearance)
    found = written(soup, tmp_path / "soup.etz")
    assert found.appearance == soup.appearance.structure
    assert found.notes == soup.notes
    picture, again = soup.render(CAMERA).color, found.render(CAMERA).color
    assert float(picture.mean()) > 0.02
    assert float(psnr(again[0].clamp(0, 1), picture[0].clamp(0, 1))) > 45


def test_what_shows_most_comes_first(rng):
    """Drawn by a camera: a large one before a small one before one that is hidden, faint or behind it."""
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    eye = CAMERA.centers[0]
    towards = torch.nn.functional.normalize(eye, dim=0)
    frame = CAMERA.viewmats[0, :3, :3].T
    facing = corners @ frame.T
    places = [0.6 * facing, 0.1 * facing + 1.2 * towards, 0.2 * facing - 0.5 * towards, 0.6 * facing + 3 * eye]
    soup = TriangleSoup.from_triangles(torch.stack(places), torch.ones(4, 3), opacity=0.99, sigma=0.1, sh_degree=0)
    scores = importance(soup, [CAMERA])
    assert scores.argsort(descending=True)[:2].tolist() == [0, 1]
    assert float(scores[3]) == 0
    alone = importance(soup)
    assert alone.shape == (4,)
    assert bool((alone > 0).all())


def test_parts_show_more_by_ranks_and_enlarged():
    """Spheres of triangles that lie over each other: 2 dB by the size, something by the order too."""
    shown = torch.tensor([decibels_of_parts(torch.Generator().manual_seed(seed)) for seed in range(4)]).mean(dim=0)
    as_they_are, enlarged, ranked = shown.tolist()
    assert enlarged > as_they_are + 2
    assert ranked > enlarged + 0.1


def decibels_of_parts(rng):
    """Of the 90 most important of 600 triangles as they are and enlarged, and of the 90 first by rank, enlarged."""
    middles = torch.nn.functional.normalize(torch.randn(600, 1, 3, generator=rng), dim=-1)
    corners = 0.8 * middles * (1 + 0.02 * torch.randn(600, 1, 1, generator=rng))
    corners = corners + 0.12 * torch.randn(600, 3, 3, generator=rng)
    colors = 0.3 * torch.rand(600, 3, generator=rng) + 0.5
    soup = TriangleSoup.from_triangles(corners, colors, opacity=0.6, sigma=0.5, sh_degree=0)
    by_importance, by_rank = importance(soup, [CAMERA]), ranks(soup, [CAMERA])
    assert sorted(by_rank.tolist()) == list(range(1, 601))
    whole = picture_of(soup)
    return [
        float(psnr(picture_of(soup.kept(order.argsort(descending=True)[:90]), factor), whole))
        for order, factor in ((by_importance, 1.0), (by_importance, enlargement(0.15)), (by_rank, enlargement(0.15)))
    ]


@torch.no_grad()
def picture_of(soup, factor=1.0):
    middles = soup.vertices.mean(dim=1, keepdim=True)
    return replace(soup, vertices=middles + factor * (soup.vertices - middles)).render(CAMERA).color[0].clamp(0, 1)


def test_without_cameras_ranks_are_those_of_importance(rng):
    soup = make_soup(rng)
    assert ranks(soup).argsort().tolist() == importance(soup).argsort().tolist()


def test_a_part_of_a_soup_says_that_it_is_one(tmp_path, rng):
    soup = make_soup(rng, CHUNK + 10, degree=0)
    written(soup, path := tmp_path / "soup.etz")
    path.write_bytes(path.read_bytes()[:-1])
    found = load_soup(path)
    assert len(found) == CHUNK
    assert found.notes[CUT_SHORT] == f"{CHUNK:,} of {CHUNK + 10:,} triangles"
    lowest = importance(soup).sort(descending=True).values[CHUNK - 1]
    assert float(importance(found).median()) > float(lowest)
    assert len(compact_of(soup, importance(soup), most=7)) == 7


def test_a_kernel_from_python_is_refused(rng):
    etsplat.register_kernel("for_compact", lambda x, sigma: torch.sigmoid((1 - x) / (0.25 * sigma)))
    try:
        soup = make_soup(rng, 5, kernel="for_compact")
        with pytest.raises(
            InputError, match=r"'for_compact': was registered from Python.*export to a path that ends in \.safetensors"
        ):
            compact_of(soup, importance(soup))
    finally:
        del KERNELS["for_compact"]


@pytest.mark.parametrize(
    ("appearance", "message"),
    [
        ({"kernel": "mine"}, "kernel 'mine', which is not registered"),
        ({"near_plane": -1}, "appearance has near_plane = -1"),
    ],
)
def test_an_appearance_that_cannot_be_drawn_is_refused(tmp_path, rng, appearance, message):
    soup = make_soup(rng, 5)
    compact = replace(compact_of(soup, importance(soup)), appearance=appearance)
    (tmp_path / "soup.etz").write_bytes(encode_compact(compact))
    with pytest.raises(InputError, match=message):
        load_soup(tmp_path / "soup.etz")
