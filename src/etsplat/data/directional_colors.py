"""Whether photos show a surface in colours that follow the direction: gloss, and light that moves with the camera.

Colours that are the same from all sides cannot explain those, and a shape that is fitted to photos makes dents instead,
whose sides turn to those who see them so. What differs from photo to photo for other reasons does not follow the
direction smoothly: a surface that is not quite where it is thought to be shows each photo another place of its texture.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.data.agreement import Looked
from etsplat.data.same_colors import colors_at, squarely

_ROUNDS = 10
"""In which means of places and of photos are taken away in turn: each photo sees other places."""

_AROUND = 6
"""Rounds in which what photos show is averaged over neighbours: texture in the wrong place averages out."""

_SPARE = 5
"""Photos that see a place, beyond the four numbers that are fitted there."""

_QUANTILE = 0.75
"""Of the places: gloss is on some of them."""


@torch.no_grad()
def directional_deviation(looked: Looked) -> float:
    """The part of the colours of a surface, as a standard deviation, that depends linearly on the direction.

    That is what a fit of four numbers explains at a place more than it would of noise; three quarters of the places
    have less. By how much a photo as a whole is brighter or darker than others does not count.

    Args:
        looked: from `looked_at`.

    Returns:
        In [0, 1], as colours; 0 where too few photos see each place.
    """
    seen = squarely(looked)
    weights = seen.to(looked.vertices)[..., None]
    colors = colors_at(looked.photos, looked.vertices)
    for _ in range(_ROUNDS):
        colors = _without_means(_without_means(colors, weights, dim=0), weights, dim=1)
    colors = _averaged(colors, weights, looked.topology.edges.long())
    towards = torch.stack([normalize(photo.center - looked.vertices, dim=1) for photo in looked.photos])
    basis = torch.cat([torch.ones_like(weights), towards], dim=2)
    enough = seen.sum(dim=0) >= basis.shape[2] + _SPARE
    if not bool(enough.any()):
        return 0.0
    explained = _explained(colors[:, enough], basis[:, enough], weights[:, enough])
    return float(explained.quantile(_QUANTILE).clamp_min(0).sqrt())


def _without_means(colors: Float[Tensor, "B N 3"], weights: Float[Tensor, "B N 1"], dim: int) -> Tensor:
    """Less their means over photos or places; 0 where the weights are."""
    return weights * (colors - (weights * colors).sum(dim, keepdim=True) / weights.sum(dim, keepdim=True).clamp_min(1))


def _averaged(values: Float[Tensor, "B N 3"], weights: Float[Tensor, "B N 1"], edges: Tensor) -> Tensor:
    """Over neighbours that the same photo sees."""
    source, target = torch.cat([edges, edges.flip(1)]).T
    sums, counts = values, weights
    for _ in range(_AROUND):
        sums = sums.index_add(1, target, sums[:, source]) / 4
        counts = counts.index_add(1, target, counts[:, source]) / 4
    return weights * sums / counts.clamp_min(torch.finfo(counts.dtype).tiny)


def _explained(
    colors: Float[Tensor, "B N 3"], basis: Float[Tensor, "B N K"], weights: Float[Tensor, "B N 1"]
) -> Float[Tensor, " N"]:
    """The variance of a channel that the best combination explains, less what it would of noise."""
    colors, basis = _without_means(colors, weights, dim=0).double(), (weights * basis).double()
    count, numbers = weights.sum(dim=0).double(), basis.shape[2]
    normal = torch.einsum("bnk,bnl->nkl", basis, basis) + 1e-3 * torch.eye(numbers, dtype=torch.float64)
    best = torch.linalg.solve(normal, torch.einsum("bnk,bnc->nkc", basis, colors))
    fitted = torch.einsum("bnk,nkc->bnc", basis, best)
    total, left = colors.square().sum(dim=0), (colors - fitted).square().sum(dim=0)
    return (total / (count - 1) - left / (count - numbers)).mean(dim=1)
