"""Pictures of a mesh: the same call in training and when a finished mesh is measured."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.antialias import rasterize_antialiased
from etsplat.ops.rasterize import rasterize
from etsplat.ops.rasterize_hard import render_opaque


@dataclass(frozen=True)
class MeshAppearance:
    """How the numbers of a mesh become pictures.

    Attributes:
        kernel: "elastic", "bilateral", "single_sided", or None for opaque triangles with antialiased silhouettes.
        distance: "barycentric" or "sdf".
        backend: whose antialiased rasterizer draws opaque triangles.
    """

    kernel: str | None = "elastic"
    distance: str = "barycentric"
    backend: Literal["etsplat", "nvdiffrast"] = "etsplat"


def render_mesh(
    mesh: TriangleMesh,
    cameras: Cameras,
    appearance: MeshAppearance,
    *,
    backgrounds: Float[Tensor, "B 3"] | None = None,
) -> Float[Tensor, "B H W 3"]:
    """A differentiable picture for each camera.

    Args:
        mesh: soft if the appearance has a kernel, opaque otherwise.
        cameras: B cameras.
        appearance: how it is drawn.
        backgrounds: (B, 3); None is black.

    Returns:
        (B, H, W, 3), not clamped: blended silhouettes can leave [0, 1] by a little.
    """
    view = (cameras.viewmats, cameras.Ks, cameras.width, cameras.height)
    if appearance.kernel is None:
        draw = rasterize_antialiased
        if appearance.backend == "nvdiffrast":
            from etsplat.ops.antialias_nvdiffrast import rasterize_nvdiffrast as draw
        return draw(
            mesh.vertices,
            mesh.topology.connectivity,
            *view,
            **mesh.named(mesh.colors),
            backgrounds=backgrounds,
        )
    return rasterize(
        mesh.vertices,
        None if mesh.vertex_colored else mesh.colors,
        mesh.opacities,
        mesh.sigma,
        *view,
        faces=mesh.faces,
        corner_colors=mesh.colors if mesh.vertex_colored else None,
        kernel=appearance.kernel,
        distance=appearance.distance,
        backgrounds=backgrounds,
        validate=False,  # the loop checks the loss at every step, and the parameters before each checkpoint
    ).color


def render_exported(mesh: TriangleMesh, cameras: Cameras, *, supersampling: int) -> Float[Tensor, "B H W 4"]:
    """What a mesh viewer shows: opaque triangles in display colours, premultiplied RGBA."""
    return render_opaque(
        mesh.vertices.detach(),
        cameras.viewmats,
        cameras.Ks,
        cameras.width,
        cameras.height,
        faces=mesh.faces,
        **mesh.named(mesh.display_colors),
        supersampling=supersampling,
    )
