"""Parts of a closed surface replaced by discs: what was a handle, or a bundle of them, is none any more."""

import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from etsplat.geometry.films import film
from etsplat.geometry.topology import connected


def with_discs(
    vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"], removed: Bool[Tensor, " F"]
) -> tuple[Float[Tensor, "V2 3"], Int64[Tensor, "F2 3"]]:
    """A closed, oriented manifold without some of its faces, and with a disc over each loop that they leave open.

    A region with b loops around it and Euler characteristic x gives way to b discs: the sum of the genera falls by
    (b - x) / 2, less what falls apart. Discs have triangles as large as the edges of their loops, and are films of soap
    (`geometry.films`).

    Args:
        vertices: (V, 3).
        faces: (F, 3), a closed, oriented manifold.
        removed: (F,) the faces that go.

    Returns:
        A closed, oriented manifold: vertices, those that no face uses left out, and faces, first those that stay.
    """
    source, kept, border = cut_open(faces[~removed], len(vertices))
    places = vertices[source]
    parts, triangles, count = [places], [kept], len(places)
    for loop in _loops(border):
        own = torch.tensor(loop)
        inner, disc = _disc(places[own])
        number = torch.cat([own, count + torch.arange(len(inner))])
        parts.append(inner)
        triangles.append(number[disc])
        count += len(inner)
    found, joined = torch.cat(parts), torch.cat(triangles)
    return film(found, joined, torch.arange(count) >= len(places)), joined


def cut_open(
    kept: Int64[Tensor, "F 3"], num_vertices: int
) -> tuple[Int64[Tensor, " V2"], Int64[Tensor, "F 3"], Int64[Tensor, "B 2"]]:
    """What is left of a closed, oriented manifold, as a manifold with a border.

    Args:
        kept: (F, 3) the faces that stay.
        num_vertices: of the manifold.

    Returns:
        source (V2,): the old vertex of each new one, of which there is one for each fan of faces around it; the faces
        with these; and the edges (B, 2) at which they end, head first.
    """
    tail, head = kept.reshape(-1), kept.roll(-1, dims=1).reshape(-1)
    edge = torch.minimum(tail, head) * num_vertices + torch.maximum(tail, head)
    order = torch.argsort(edge, stable=True)
    pair = (edge[order][1:] == edge[order][:-1]).nonzero()[:, 0]
    first, second = order[pair], order[pair + 1]
    following = torch.arange(len(tail)).reshape(-1, 3).roll(-1, dims=1).reshape(-1)
    turns = torch.cat([torch.stack([first, following[second]], 1), torch.stack([second, following[first]], 1)])
    count, fan = connected(turns, len(tail))
    corner = torch.full((count,), len(tail)).scatter_reduce(0, fan, torch.arange(len(tail)), "amin")
    apart, alone = fan.reshape(-1, 3), torch.ones(len(tail), dtype=torch.bool)
    alone[torch.cat([first, second])] = False
    border = torch.stack([apart.roll(-1, dims=1).reshape(-1)[alone], fan[alone]], dim=1)
    return tail[corner], apart, border


def _loops(border: Tensor) -> list[list[int]]:
    """The cycles of edges each of whose vertices begins one and ends one."""
    following = dict(border.tolist())
    loops = []
    while following:
        start = min(following)
        loop = [start]
        while (place := following.pop(loop[-1])) != start:
            loop.append(place)
        loops.append(loop)
    return loops


def _disc(loop: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "M 3"], Int64[Tensor, "K 3"]]:
    """Vertices in rings within a loop, down to its middle, and triangles of the loop's N vertices and these."""
    count, middle = len(loop), loop.mean(dim=0)
    edge = (loop - loop.roll(1, dims=0)).norm(dim=1).mean()
    radius = float((loop - middle).norm(dim=1).mean() / edge)
    around, rings = min(count, 2 * math.pi * radius), max(1, round(radius))
    points, triangles, outer, total = [], [], list(range(count)), count
    for ring in range(1, rings):
        width = 1 - ring / rings
        size = max(3, round(around * width))
        place = torch.arange(size) * (count / size)
        before, part = place.long(), (place % 1)[:, None]
        points.append(middle + width * (loop[before].lerp(loop[(before + 1) % count], part) - middle))
        inner = list(range(total, total + size))
        triangles += _between(outer, inner)
        outer, total = inner, total + size
    points.append(middle[None])
    triangles += [(a, b, total) for a, b in zip(outer, outer[1:] + outer[:1], strict=True)]
    return torch.cat(points), torch.tensor(triangles)


def _between(outer: list[int], inner: list[int]) -> list[tuple[int, int, int]]:
    """Triangles between two rings, along the outer one."""
    n, m, i, j = len(outer), len(inner), 0, 0
    triangles = []
    while i < n or j < m:
        if j == m or (i < n and (i + 1) * m <= (j + 1) * n):
            triangles.append((outer[i % n], outer[(i + 1) % n], inner[j % m]))
            i += 1
        else:
            triangles.append((outer[i % n], inner[(j + 1) % m], inner[j % m]))
            j += 1
    return triangles
