"""What is behind the triangles of an opaque picture: the picture that a mesh has without them.

Triangles are dealt into parts by their index. Each pixel of the second picture is that of the mesh without the part
that the pixel's nearest triangle belongs to; where no triangle is, it is the background.
"""

from dataclasses import replace
from functools import cached_property

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


class WithBehind:
    """Draws separate opaque triangles with colours of corners, and what is behind them, without gradients."""

    def __init__(self, mesh: TriangleMesh) -> None:
        """Takes a mesh whose faces share no edges, and which does not change meanwhile."""
        assert mesh.vertex_colored
        assert len(mesh.topology.connectivity.face_pairs) == 0, "an edge would be a silhouette without the other face"
        self._mesh = mesh

    @torch.no_grad()
    def render(self, cameras: Cameras, backgrounds: Float[Tensor, "1 3"]) -> tuple[Rasterization, Rasterization]:
        """A picture as `TriangleMesh.render` gives it, and colour and alpha of what is behind.

        Args:
            cameras: a single one.
            backgrounds: (1, 3).
        """
        mesh = self._mesh
        together = engine_for(mesh.vertices).rasterize_behind
        if together is None:
            return self.by_parts(cameras, backgrounds)
        found = together(mesh.vertices, mesh.colors, backgrounds, cameras, _NEAR_PLANE, mesh.topology.connectivity)
        color, triangle, barycentrics, depth = (images.split(1) for images in found)
        alpha = [(shown >= 0).to(mesh.vertices.dtype)[..., None] for shown in triangle]
        seen = {"triangle": triangle[0], "barycentrics": barycentrics[0]}
        nearest = Rasterization(color[0], alpha[0], depth[0][..., None], **seen)
        return nearest, Rasterization(color[1], alpha[1])

    @torch.no_grad()
    def by_parts(self, cameras: Cameras, backgrounds: Float[Tensor, "1 3"]) -> tuple[Rasterization, Rasterization]:
        """The same by one picture more of what each part leaves."""
        nearest = self._mesh.render(cameras, backgrounds=backgrounds)
        assert nearest.triangle is not None
        part = torch.where(nearest.triangle < 0, -1, nearest.triangle % PARTS)[..., None]
        color, alpha = backgrounds[:, None, None].expand_as(nearest.color), torch.zeros_like(nearest.alpha)
        for left_out, rest in enumerate(self._rests):
            seen = rest.render(cameras, backgrounds=backgrounds)
            color = torch.where(part == left_out, seen.color, color)
            alpha = torch.where(part == left_out, seen.alpha, alpha)
        return nearest, Rasterization(color, alpha)

    @cached_property
    def _rests(self) -> list[TriangleMesh]:
        """What each part leaves: once for all pictures, as how faces hang together is found out on the CPU."""
        faces, count = self._mesh.faces, len(self._mesh.vertices)
        part = torch.arange(len(faces), device=faces.device) % PARTS
        topologies = (MeshTopology.from_faces(faces[part != left_out], count) for left_out in range(PARTS))
        return [replace(self._mesh, topology=topology) for topology in topologies]
