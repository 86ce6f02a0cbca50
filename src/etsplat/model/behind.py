"""What is behind the triangles of an opaque picture: the picture that a mesh has without them.

Triangles are dealt into parts by their index. Each pixel of the second picture is that of the mesh without the part
that the pixel's nearest triangle belongs to; where no triangle is, it is the background.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat import _native
from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import Rasterization
from etsplat.engines.choice import engine_for
from etsplat.geometry.topology import MeshTopology
from etsplat.model.triangle_mesh import TriangleMesh

PARTS: int = _native.OPAQUE_PARTS
"""If more than a third of the triangles were left out at a time, what is behind one would lack triangles, too."""

_NEAR_PLANE = 0.01
"""That of `rasterize_antialiased`."""


@torch.no_grad()
def render_with_behind(
    mesh: TriangleMesh, cameras: Cameras, backgrounds: Float[Tensor, "1 3"]
) -> tuple[Rasterization, Rasterization]:
    """A picture of separate opaque triangles with colours of corners, and what is behind them, without gradients.

    Args:
        mesh: whose faces share no edges.
        cameras: a single one.
        backgrounds: (1, 3).

    Returns:
        The picture as `TriangleMesh.render` gives it, and colour and alpha of what is behind.
    """
    connectivity = mesh.topology.connectivity
    assert mesh.vertex_colored
    assert len(connectivity.face_pairs) == 0, "an edge would be a silhouette without the other face"
    together = engine_for(mesh.vertices).rasterize_behind
    if together is None:
        return by_parts(mesh, cameras, backgrounds)
    found = together(mesh.vertices, mesh.colors, backgrounds, cameras, _NEAR_PLANE, connectivity)
    color, triangle, barycentrics, depth = (images.split(1) for images in found)
    alpha = [(shown >= 0).to(mesh.vertices.dtype)[..., None] for shown in triangle]
    nearest = Rasterization(color[0], alpha[0], depth[0][..., None], triangle=triangle[0], barycentrics=barycentrics[0])
    return nearest, Rasterization(color[1], alpha[1])


def by_parts(
    mesh: TriangleMesh, cameras: Cameras, backgrounds: Float[Tensor, "1 3"]
) -> tuple[Rasterization, Rasterization]:
    """The same by one picture more of what each part leaves."""
    nearest = mesh.render(cameras, backgrounds=backgrounds)
    assert nearest.triangle is not None
    part = torch.where(nearest.triangle < 0, -1, nearest.triangle % PARTS)[..., None]
    color, alpha = backgrounds[:, None, None].expand_as(nearest.color), torch.zeros_like(nearest.alpha)
    number = torch.arange(mesh.count, device=mesh.vertices.device)
    for left_out in range(PARTS):
        kept = mesh.faces[number % PARTS != left_out]
        rest = replace(mesh, topology=MeshTopology.from_faces(kept, len(mesh.vertices)))
        seen = rest.render(cameras, backgrounds=backgrounds)
        color = torch.where(part == left_out, seen.color, color)
        alpha = torch.where(part == left_out, seen.alpha, alpha)
    return nearest, Rasterization(color, alpha)
