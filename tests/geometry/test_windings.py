"""Around which places surfaces go, as they are seen from one side."""

import math

import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.windings import winds_around


def strip(turns: float, steps: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """A strip around the origin, so many turns long, closed after one."""
    angle = 2 * math.pi * turns * torch.arange(steps + 1) / steps
    ring = torch.stack([angle.cos(), angle.sin()], dim=1)
    number = torch.arange(steps + 1)
    if turns == 1:
        number[-1] = 0
    inner, outer = 2 * number, 2 * number + 1
    edges = [(inner[:-1], inner[1:]), (outer[:-1], outer[1:]), (inner[:-1], outer[:-1]), (inner[:-1], outer[1:])]
    places = torch.stack([0.5 * ring, ring], dim=1).reshape(-1, 2)
    return places, torch.cat([torch.stack(each, dim=1) for each in edges])


def test_a_ring_goes_around_its_hole_alone() -> None:
    places, edges = strip(1)
    assert winds_around(places, edges, torch.tensor([0.01, 0.02]))
    assert not winds_around(places, edges, torch.tensor([1.5, 0.0]))


def test_a_ring_that_is_cut_does_not_though_its_ends_overlap() -> None:
    places, edges = strip(1.2)
    assert not winds_around(places, edges, torch.tensor([0.01, 0.02]))


def test_a_ball_goes_around_nothing() -> None:
    vertices, faces = icosphere(2)
    edges = MeshTopology.from_faces(faces, len(vertices)).edges.long()
    assert not winds_around(vertices[:, :2], edges, torch.tensor([1.2, 0.0]))
