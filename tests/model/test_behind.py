"""Opaque pictures and what is behind their triangles, drawn at once and one by one."""

import pytest
import torch

import etsplat
from etsplat import orbit_cameras
from etsplat.geometry.topology import MeshTopology
from etsplat.model.behind import PARTS, WithBehind
from etsplat.model.triangle_mesh import TriangleMesh


def separate(corners: torch.Tensor, colors: torch.Tensor) -> TriangleMesh:
    faces = torch.arange(len(corners) * 3).reshape(-1, 3)
    return TriangleMesh.from_mesh(
        corners.reshape(-1, 3), faces, colors=colors, opacity=None, sigma=None, vertex_colored=True
    )


@pytest.mark.sanitize
@pytest.mark.parametrize("count", [0, 2, 300])
def test_drawn_at_once_it_is_the_same_bits(count: int) -> None:
    """Of triangles that cross, lie on each other and are behind the camera; more rows than a band and a tile have."""
    generator = torch.Generator().manual_seed(count)
    middles = torch.randn(count, 1, 3, generator=generator) * 0.8
    corners = middles + torch.randn(count, 3, 3, generator=generator) * 0.3
    corners[1::4] = corners[: len(corners[1::4])]  # equally near
    mesh = separate(corners, torch.rand(3 * count, 3, generator=generator))
    background = torch.tensor([[0.2, 0.5, 0.9]])
    seen_behind, drawn = 0, WithBehind(mesh)
    for camera in orbit_cameras(150, 70, elevations=(20.0,), azimuths=3):
        nearest, behind = drawn.render(camera, background)
        expected, expected_behind = drawn.by_parts(camera, background)
        for name in ("color", "alpha", "triangle", "barycentrics"):
            assert torch.equal(getattr(nearest, name), getattr(expected, name)), name
        assert torch.equal(behind.color, expected_behind.color)
        assert torch.equal(behind.alpha, expected_behind.alpha)
        seen_behind += int(behind.alpha.sum())
    assert (seen_behind > 3000) == (count == 300)


def test_behind_a_triangle_is_the_nearest_of_another_part() -> None:
    """The second of its own part is left out with it; where there is none, and no triangle at all, it is background."""
    large = torch.tensor([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]])
    depths = torch.arange(PARTS + 2.0)[:, None, None]
    order = [0, PARTS, 1, 2, PARTS + 1]  # by depth: the second is of the part of the first
    corners = torch.empty(PARTS + 2, 3, 3)
    corners[order] = large - depths * torch.tensor([0.0, 0, 1])
    colors = torch.arange(PARTS + 2.0)[:, None].repeat_interleave(3, dim=0).expand(-1, 3) / 10
    camera = orbit_cameras(9, 9, elevations=(0.0,), azimuths=1)
    mesh = separate(corners, colors)
    nearest, behind = WithBehind(mesh).render(camera, torch.ones(1, 3))
    assert nearest.triangle is not None
    front = int(nearest.triangle[0, 4, 4])
    following = order[2] if front == order[0] else order[order.index(front) - 1]
    torch.testing.assert_close(behind.color[0, 4, 4], torch.full((3,), following / 10))
    alone = separate(corners[:1] * 0.05, colors[:3])
    nearest, behind = WithBehind(alone).render(camera, torch.ones(1, 3))
    assert nearest.triangle is not None
    assert nearest.triangle.max() == 0
    assert bool((behind.color == 1).all())
    assert not behind.alpha.any()


def test_how_faces_hang_together_is_found_out_once_for_all_pictures(
    simt: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a GPU, whose engine draws what each part leaves: it took most of the time of the opaque mesh beside a soup."""
    found: list[int] = []
    original = MeshTopology.from_faces

    def counted(faces: torch.Tensor, num_vertices: int) -> MeshTopology:
        found.append(len(faces))
        return original(faces, num_vertices)

    mesh = separate(torch.randn(9, 3, 3), torch.rand(27, 3))
    monkeypatch.setattr(MeshTopology, "from_faces", counted)
    with etsplat.engine("cuda"):
        drawn = WithBehind(mesh)
        for camera in orbit_cameras(9, 9, elevations=(0.0,), azimuths=3):
            drawn.render(camera, torch.ones(1, 3))
    assert found == [6] * PARTS
