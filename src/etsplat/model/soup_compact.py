"""Soups and opaque meshes as compact soups (`etsplat.io.compact_soups`), and back."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.core.kernels import KERNELS
from etsplat.core.rasterization import SOUP_SIGMA_FLOOR
from etsplat.core.spelling import either
from etsplat.io.compact_soups import CompactSoup, enlargement, read_compact
from etsplat.io.json_text import parse_json
from etsplat.model.solid_soup import SolidSoup
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.triangle_soup import TriangleSoup

CUT_SHORT = "cut_short"
"""Note of a soup from a file of which the end is missing: how much of it is there."""

_LEAST = 1e-3
"""Opacity of what is written as 0: below 1/255 nothing is drawn."""

_STAYING, _FEWEST = 0.7, 0.06
"""In each round of `ranks` this share of the triangles stays; it is the last where fewer than that of all would."""


@torch.no_grad()
def importance(soup: TriangleSoup, cameras: Sequence[Cameras] = ()) -> Float[Tensor, " N"]:
    """How much pictures would lose without each triangle, roughly; (N,) at least 0, on the soup's device.

    Args:
        soup: of N triangles.
        cameras: single ones: the sum over them of the largest blend weight in any pixel times the size on the image.
            Without any it is opacity times size, as seen from the middle of the soup, so that a sky is not before
            everything.
    """
    vertices = soup.vertices.detach()
    total = torch.zeros(len(soup), device=vertices.device)
    for camera in (camera.to(total.device) for camera in cameras):
        seen = soup.render(camera, outputs=("statistics",)).statistics
        assert seen is not None
        total += seen.max_weight[0] * seen.inradius[0] * seen.screen_size[0]
    if cameras:
        return total
    middles = vertices.mean(dim=1)
    middle = middles.median(dim=0).values
    spread = (middles - middle).norm(dim=1).median()
    distance2 = (middles - middle).square().sum(dim=1) + spread.square().clamp_min(1e-30)
    sides = vertices[:, 1:] - vertices[:, :1]
    return soup.drawn_opacities.detach() * torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1) / distance2


@torch.no_grad()
def ranks(soup: TriangleSoup, cameras: Sequence[Cameras] = ()) -> Float[Tensor, " N"]:
    """How early each triangle is to be sent: of those with the highest ranks, however few, pictures show most.

    Found from the end: what of the triangles that are left matters least (`importance`), drawn as large as a file that
    is cut short draws them, goes, round by round. Those that stand alone where others went come to matter more.

    Args:
        soup: of N triangles.
        cameras: single ones; without any ranks are those of `importance`.

    Returns:
        (N,) float64, on the soup's device.
    """
    count = len(soup)
    left, gone = torch.arange(count, device=soup.vertices.device), []
    while True:
        scores = importance(_enlarged(soup.kept(left), enlargement(len(left) / count)), cameras)
        left = left[scores.argsort(descending=True, stable=True)]
        kept = int(_STAYING * len(left))
        if not cameras or kept < _FEWEST * count:
            break
        gone.append(left[kept:])
        left = left[:kept]
    found = torch.empty(count, dtype=torch.float64, device=left.device)
    found[torch.cat([left, *gone[::-1]])] = torch.arange(count, 0, -1, dtype=torch.float64, device=left.device)
    return found


def _enlarged(soup: TriangleSoup, factor: float) -> TriangleSoup:
    middles = soup.vertices.mean(dim=1, keepdim=True)
    return replace(soup, vertices=middles + factor * (soup.vertices - middles))


def compact_of(soup: TriangleSoup, order: Float[Tensor, " N"], most: int | None = None) -> CompactSoup:
    """A soup, or the faces of an opaque mesh, as what a compact file holds.

    Args:
        soup: of at least one triangle.
        order: (N,) how important each is; the most important come first.
        most: so many at most.

    Raises:
        InputError: it is drawn with a kernel that was registered from Python, of which such files hold nothing.
    """
    look = soup.appearance
    if KERNELS[look.kernel].table is not None:
        other = either("with --format safetensors", "to a path that ends in .safetensors")
        raise InputError(
            f"kernel {look.kernel!r}: was registered from Python, and compact files hold no kernels; export {other}"
        )
    whole = soup.finished() if not isinstance(soup, SolidSoup) else soup
    rows = order.argsort(descending=True, stable=True)[:most]
    chosen = whole.kept(rows)
    said = parse_json(chosen.appearance.to_json())
    if isinstance(chosen, SolidSoup):
        colors = _array(chosen.corner_colors.clamp(0, 1))
        return CompactSoup(_array(chosen.vertices), corner_colors=colors, appearance=said, notes=chosen.notes)
    return CompactSoup(
        _array(chosen.vertices),
        opacities=_array(chosen.opacities),
        sigma=_array(chosen.sigma),
        harmonics=_array(torch.cat([chosen.sh_dc, chosen.sh_rest], dim=1)),
        appearance=said,
        notes=chosen.notes,
    )


def open_compact(path: Path) -> TriangleSoup:
    """The soup of a compact file; of one that was cut short what is there, and a note that says so.

    Raises:
        InputError: it cannot be read.
    """
    found = read_compact(path)
    try:
        look = SoupAppearance.from_json(json.dumps(found.appearance))
    except ValueError as error:
        raise InputError(f"soup {path}: cannot be read ({error}); export it again") from error
    if look.kernel not in KERNELS:
        raise InputError(f"soup {path}: is drawn with kernel {look.kernel!r:.40}, which is not registered")
    notes = dict(found.notes)
    if found.left_out:
        notes[CUT_SHORT] = f"{len(found):,} of {len(found) + found.left_out:,} triangles"
    vertices = torch.from_numpy(found.vertices)
    if found.corner_colors is not None:
        return SolidSoup.of_corners(vertices, torch.from_numpy(found.corner_colors), look, notes)
    assert found.opacities is not None
    assert found.sigma is not None
    assert found.harmonics is not None
    harmonics = torch.from_numpy(found.harmonics)
    opacities = torch.from_numpy(found.opacities).double().clamp(_LEAST, 1 - 2.0**-24)
    sigma = torch.from_numpy(found.sigma).double()
    return TriangleSoup(
        vertices,
        torch.logit(opacities).float(),
        (sigma - SOUP_SIGMA_FLOOR).clamp_min(1e-6).log().float(),
        harmonics[:, :1].contiguous(),
        harmonics[:, 1:].contiguous(),
        appearance=look,
        notes=notes,
    )


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
