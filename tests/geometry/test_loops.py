"""Loops on a ring, of which the shortest are known."""

import math

import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.loops import short_loops


def ring(radius: float, thickness: float, around: int = 48, across: int = 16) -> tuple[torch.Tensor, torch.Tensor]:
    """A torus about the z axis."""
    u, v = torch.meshgrid(torch.arange(around), torch.arange(across), indexing="ij")
    a, b = 2 * math.pi * u / around, 2 * math.pi * v / across
    out = radius + thickness * b.cos()
    vertices = torch.stack([out * a.cos(), out * a.sin(), thickness * b.sin()], dim=2).reshape(-1, 3)

    def at(i: int, j: int) -> torch.Tensor:
        return ((u + i) % around * across + (v + j) % across).reshape(-1)

    faces = torch.cat([torch.stack([at(0, 0), at(1, 0), at(1, 1)], 1), torch.stack([at(0, 0), at(1, 1), at(0, 1)], 1)])
    return vertices, faces


def lengths(vertices: torch.Tensor, loops: list[list[int]]) -> list[float]:
    return [float((vertices[loop] - vertices[loop].roll(1, dims=0)).norm(dim=1).sum()) for loop in loops]


def test_a_ball_has_none() -> None:
    assert short_loops(*icosphere(2)) == []


def test_of_a_ring_one_goes_around_it_and_one_through_its_hole() -> None:
    vertices, faces = ring(1.0, 0.2)
    loops = short_loops(vertices, faces)
    found = lengths(vertices, loops)
    assert found == sorted(found)
    assert 0.95 < found[0] / (2 * math.pi * 0.2) < 1.05
    shortest_along = min(
        length for length, loop in zip(found, loops, strict=True) if vertices[loop].mean(dim=0).norm() < 0.5
    )
    assert 0.95 < shortest_along / (2 * math.pi * 0.8) < 1.25


def test_loops_are_closed_and_have_no_vertex_twice() -> None:
    vertices, faces = ring(1.0, 0.3)
    edges = {frozenset(edge) for face in faces.tolist() for edge in zip(face, face[1:] + face[:1], strict=True)}
    for loop in short_loops(vertices, faces):
        assert len(set(loop)) == len(loop)
        assert all(frozenset(pair) in edges for pair in zip(loop, loop[1:] + loop[:1], strict=True))


def test_each_of_two_rings_has_its_own() -> None:
    vertices, faces = ring(1.0, 0.2)
    both = torch.cat([vertices, vertices + torch.tensor([5.0, 0.0, 0.0])])
    loops = short_loops(both, torch.cat([faces, faces + len(vertices)]))
    sides = [bool(both[loop, 0].amin() > 2.5) for loop in loops]
    assert any(sides)
    assert not all(sides)
    assert all(bool((both[loop, 0] > 2.5).all()) == side for loop, side in zip(loops, sides, strict=True))
