"""One colour behind all views is three numbers; what is neither that nor one for each view is named."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import etsplat

CAMERAS = etsplat.orbit_cameras(12, 8, elevations=(0.0,), azimuths=3)
VERTICES, FACES = etsplat.icosphere(1)
CONNECTIVITY = etsplat.MeshTopology.from_faces(FACES, len(VERTICES)).connectivity
WHITE = torch.ones(80, 3)


def _soup() -> etsplat.TriangleSoup:
    return etsplat.TriangleSoup.from_triangles(VERTICES[FACES], 0.5, opacity=0.5, sigma=0.5, sh_degree=0)


def _mesh(**given: Any) -> etsplat.TriangleMesh:
    return etsplat.TriangleMesh.from_mesh(VERTICES, FACES, colors=0.5, **{"opacity": 0.9, "sigma": 0.3, **given})


def _textured() -> etsplat.TexturedMesh:
    return etsplat.TexturedMesh.from_mesh(VERTICES, FACES, torch.rand(8, 8, 3), torch.rand(80, 3, 2))


def _culling() -> etsplat.TriangleSoup:
    soup = _soup()
    soup.appearance = etsplat.SoupAppearance(cull_large=1.0)
    return soup


def _loss(backgrounds: Tensor) -> Tensor:
    photo = torch.zeros(3, 8, 12, 4)
    return etsplat.photometric_loss(torch.ones(3, 8, 12, 3), photo, 0.2, backgrounds=backgrounds)


DRAW: dict[str, Callable[[Tensor], Tensor]] = {
    "rasterize": lambda behind: (
        etsplat.rasterize(
            VERTICES,
            faces=FACES,
            face_colors=WHITE,
            opacities=0.5 * torch.ones(80),
            sigma=0.5,
            cameras=CAMERAS,
            backgrounds=behind,
        ).color
    ),
    "rasterize_antialiased": lambda behind: (
        etsplat.rasterize_antialiased(
            VERTICES, connectivity=CONNECTIVITY, face_colors=WHITE, cameras=CAMERAS, backgrounds=behind
        ).color
    ),
    "photometric_loss": _loss,
    "soup": lambda behind: _soup().render(CAMERAS, backgrounds=behind).color,
    "culling soup": lambda behind: _culling().render(CAMERAS, backgrounds=behind).color,
    "mesh": lambda behind: _mesh().render(CAMERAS, backgrounds=behind).color,
    "opaque mesh": lambda behind: _mesh(opacity=None, sigma=None).render(CAMERAS, backgrounds=behind).color,
    "textured mesh": lambda behind: _textured().render(CAMERAS, backgrounds=behind).color,
}


@pytest.mark.parametrize("name", DRAW)
def test_one_colour_is_behind_all_views(name: str) -> None:
    color = torch.tensor([0.2, 0.4, 0.8])
    torch.manual_seed(0)
    one = DRAW[name](color)
    torch.manual_seed(0)
    assert one.equal(DRAW[name](color.repeat(3, 1)))


@pytest.mark.parametrize("name", [name for name in DRAW if name != "photometric_loss"])
def test_it_is_learned_from_all_of_them(name: str) -> None:
    color, each = torch.zeros(3, requires_grad=True), torch.zeros(3, 3, requires_grad=True)
    DRAW[name](color).sum().backward()
    DRAW[name](each).sum().backward()
    assert color.grad is not None
    assert each.grad is not None
    torch.testing.assert_close(color.grad, each.grad.sum(dim=0))
    assert color.grad.all()


@pytest.mark.parametrize("name", DRAW)
@pytest.mark.parametrize("shape", [(2, 3), (4, 3), (1, 3), (4,), (), (3, 8, 12, 3)])
def test_other_shapes_are_named(name: str, shape: tuple[int, ...]) -> None:
    """A soup that leaves triangles out by view took four colours for three views."""
    with pytest.raises(ValueError, match=r"backgrounds must have shape \((C|3),\) or \((B|3), (C|3)\).*, got"):
        DRAW[name](torch.zeros(shape))
