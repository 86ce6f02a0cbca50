"""Surfaces of revolution: vessels whose hollows are known."""

import math

import torch


def revolved(profile: list[tuple[float, float]], rounds: int = 96) -> tuple[torch.Tensor, torch.Tensor]:
    """A closed mesh from a polyline of (radius, height), whose ends lie on the axis, about y."""
    angles = 2 * math.pi * torch.arange(rounds) / rounds
    rings = [torch.stack([r * angles.sin(), torch.full_like(angles, y), r * angles.cos()], 1) for r, y in profile[1:-1]]
    vertices = torch.cat([torch.tensor([[0.0, profile[0][1], 0.0], [0.0, profile[-1][1], 0.0]]), *rings])
    k = torch.arange(rounds)
    following = (k + 1) % rounds
    faces = [torch.stack([torch.zeros_like(k), 2 + following, 2 + k], 1)]
    for ring in range(len(rings) - 1):
        a, b = 2 + ring * rounds, 2 + (ring + 1) * rounds
        faces.append(torch.stack([a + k, a + following, b + following], 1))
        faces.append(torch.stack([a + k, b + following, b + k], 1))
    last = 2 + (len(rings) - 1) * rounds
    faces.append(torch.stack([torch.ones_like(k), last + k, last + following], 1))
    return vertices, torch.cat(faces)


def line(start: tuple[float, float], end: tuple[float, float], parts: int = 16) -> list[tuple[float, float]]:
    return [tuple(a + (b - a) * i / parts for a, b in zip(start, end, strict=True)) for i in range(parts)]  # type: ignore[misc]


BOWL = [
    (0.0, -0.5),
    *line((0.04, -0.5), (0.7, -0.5)),
    *line((0.7, -0.5), (0.7, 0.4)),
    *line((0.7, 0.4), (0.58, 0.4), 3),
    *line((0.58, 0.4), (0.58, -0.2)),
    *line((0.58, -0.2), (0.04, -0.2)),
    (0.0, -0.2),
]
VASE = [
    (0.0, -0.9),
    *line((0.04, -0.9), (0.35, -0.9)),
    *line((0.35, -0.9), (0.5, -0.3)),
    *line((0.5, -0.3), (0.2, 0.5)),
    *line((0.2, 0.5), (0.3, 0.9)),
    *line((0.3, 0.9), (0.26, 0.9)),
    *line((0.26, 0.9), (0.16, 0.5)),
    *line((0.16, 0.5), (0.46, -0.3)),
    *line((0.46, -0.3), (0.31, -0.85)),
    *line((0.31, -0.85), (0.04, -0.85)),
    (0.0, -0.85),
]
CAN = [
    (0.0, -0.5),
    *line((0.04, -0.5), (0.7, -0.5)),
    *line((0.7, -0.5), (0.7, 0.4)),
    *line((0.7, 0.4), (0.04, 0.4)),
    (0.0, 0.4),
]
MUG_WALL = 0.1
"""Thickness of the walls and of the bottom of `MUG`."""

MUG = [
    (0.0, -0.7),
    *line((0.04, -0.7), (0.5, -0.7)),
    *line((0.5, -0.7), (0.5, 0.6)),
    *line((0.5, 0.6), (0.5 - MUG_WALL, 0.6), 3),
    *line((0.5 - MUG_WALL, 0.6), (0.5 - MUG_WALL, -0.7 + MUG_WALL)),
    *line((0.5 - MUG_WALL, -0.7 + MUG_WALL), (0.04, -0.7 + MUG_WALL)),
    (0.0, -0.7 + MUG_WALL),
]
