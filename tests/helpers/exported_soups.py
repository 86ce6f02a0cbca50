"""Soups to export, and what comes back of them."""

from dataclasses import replace

import torch

from etsplat import intrinsics, look_at
from etsplat.core.cameras import Cameras
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.opened_runs import SoupRun

UP_AXIS = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
CAMERA = Cameras(
    look_at(torch.tensor([[0.5, 0.8, 4.0]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])),
    intrinsics(45, 64, 48)[None],
    64,
    48,
)


def odd_soup(rng):
    """Triangles of many opacities, softnesses and colours that depend on the direction."""
    count = 60
    made = TriangleSoup.from_triangles(
        torch.randn(count, 1, 3, generator=rng) * 0.7 + torch.randn(count, 3, 3, generator=rng) * 0.3,
        torch.rand(count, 3, generator=rng),
        opacity=0.5,
        sigma=0.5,
        sh_degree=2,
    )
    return TriangleSoup(
        made.vertices.detach(),
        torch.randn(count, generator=rng) * 2,
        torch.randn(count, generator=rng) * 0.3 - 1,
        made.sh_dc.detach(),
        torch.randn(count, 8, 3, generator=rng) * 0.1,
    )


def run_of(soup, **appearance):
    drawn = replace(soup, appearance=SoupAppearance(**appearance))
    return SoupRun(path=None, soup=drawn, capture=None)  # pyright: ignore


def flat(soup):
    """The soup with colours that are the same from every side, as a file without harmonics holds them."""
    return TriangleSoup(
        soup.vertices, soup.opacity_logits, soup.sigma_raw, soup.sh_dc, soup.sh_rest[:, :0].contiguous()
    )


def difference(a, b):
    return float((a - b).abs().max())
