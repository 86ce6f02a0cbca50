"""Whether photos show the same colour where they see the same place: what shading tells of things that are plain.

Patches without texture cannot be compared, and those of smooth shading are alike wherever they are. But what lies on a
surface has one colour from all sides, but for gloss, while a lid over a hollow shows each photo something else behind
it. So the variance between photos of a place is compared with that of all (intraclass correlation, Fisher 1925).
Exposures must be about the same.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from etsplat.data.agreement import COMPARED, SMOOTH, Looked, averaged, largest_patch, witnesses
from etsplat.data.photos import Photo
from etsplat.geometry.measures import vertex_normals

_SLANT = 0.3
"""Cosine of the angle to the normal, below which a photo is not asked: it may see past a place on a coarse surface."""

_AROUND = 8
"""Rounds in which variances are summed over neighbours."""

_DIFFERS = 0.15
"""Sameness on a lid, at most: what is glossy has more, mostly."""

_PLAIN = 0.01
"""Standard deviation of colours below which nothing is known: what differs is less than what sampling does."""


def colors_at(photos: list[Photo], points: Float[Tensor, "N 3"]) -> Float[Tensor, "B N 3"]:
    """What each photo shows at points, whether it sees them or not."""
    return torch.stack([photo.look_up(photo.pixels[:, :3], photo.project(points)[0][None])[:, 0].T for photo in photos])


def sameness(colors: Float[Tensor, "B N 3"], seen: Bool[Tensor, "B N"]) -> float:
    """1 if each place has one colour for all who see it; about 0 where those differ as much as all do, or all is plain.

    Args:
        colors: from `colors_at`.
        seen: which photo sees which place. Places that fewer than two see say nothing.
    """
    return float(_one_less(_moments(colors, seen).sum(dim=0)).nan_to_num())


@torch.no_grad()
def local_sameness(looked: Looked) -> Float[Tensor, " V"]:
    """The same around each vertex of a surface; NaN where too few photos see it, or all there is plain."""
    edges = looked.topology.edges.long()
    moments = _moments(colors_at(looked.photos, looked.vertices), squarely(looked), COMPARED)
    source, target = torch.cat([edges, edges.flip(1)]).T
    for _ in range(_AROUND):
        moments = moments.index_add(0, target, moments[source]) / 4
    return _one_less(moments)


@torch.no_grad()
def surface_sameness(looked: Looked) -> float:
    """The same of all of a surface."""
    return sameness(colors_at(looked.photos, looked.vertices), squarely(looked))


@torch.no_grad()
def differing_share(looked: Looked) -> float:
    """The largest patch of a surface whose places have different colours in photos, as a fraction of its area.

    What few of them see, as in a hollow, does not count.
    """
    enough = looked.seen.sum(dim=0) >= witnesses(len(looked.photos))
    patch = (local_sameness(looked) < _DIFFERS) & enough
    return largest_patch(patch, looked.vertices, looked.faces, looked.topology.edges.long())


def _within_outline(photo: Photo) -> Float[Tensor, "1 1 H W"]:
    """Where a photo shows the object, and not beside its outline, where it shows what is behind, too."""
    return 1 - max_pool2d((photo.pixels[:, 3:] < 0.95).float(), 3, stride=1, padding=1)


def squarely(looked: Looked) -> Bool[Tensor, "B V"]:
    """Which photos see which vertices within its outline, and not at a slant."""
    vertices, edges = looked.vertices, looked.topology.edges.long()
    normals = averaged(vertex_normals(vertices, looked.faces), edges, SMOOTH)
    rows = []
    for photo, seen in zip(looked.photos, looked.seen, strict=True):
        within = photo.look_up(_within_outline(photo), photo.project(vertices)[0][None], "nearest")[0, 0] > 0.5
        rows.append(seen & within & ((normalize(photo.center - vertices, dim=1) * normals).sum(dim=1) > _SLANT))
    return torch.stack(rows)


def _moments(colors: Tensor, seen: Tensor, fewest: int = 2) -> Float[Tensor, "N 7"]:
    """Of each place: photos that see it and one less, the sums of their colours, of squares, and of those within it."""
    count = seen.sum(dim=0)
    weight = (seen & (count >= fewest))[..., None].to(colors)
    count = weight.sum(dim=0)
    sums, squares = (weight * colors).sum(dim=0), (weight * colors.square()).sum(dim=(0, 2))[:, None]
    within = squares - sums.square().sum(dim=1, keepdim=True) / count.clamp_min(1)
    return torch.cat([count, (count - 1).clamp_min(0), sums, squares, within.clamp_min(0)], dim=1).double()


def _one_less(moments: Float[Tensor, "*N 7"]) -> Float[Tensor, "*N"]:
    """1 less the variance within places as a part of that of all; NaN where it is too little."""
    count, free, sums, squares, within = moments.split([1, 1, 3, 1, 1], dim=-1)
    total = (squares - sums.square().sum(dim=-1, keepdim=True) / count) / (3 * count)
    found = (1 - within / (3 * free) / total).squeeze(-1)
    return torch.where((total > _PLAIN**2).squeeze(-1) & (free > 0).squeeze(-1), found, torch.nan).float()
