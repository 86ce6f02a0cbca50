"""Differentiable z-buffer rasterization of a mesh with antialiased silhouettes (Laine et al. 2020).

A pixel shows the nearest triangle at its centre, in the colour of the face, interpolated between its vertices with
perspective-correct barycentrics, or of a texture at coordinates that are. That image is a step function of the
vertices, so silhouettes are blended: where two neighbouring pixels see different triangles, and a silhouette edge of
the nearer one crosses the segment between their centres at the fraction d, seen from its own pixel, then

    d < 1/2:  the own pixel gets (1/2 - d) (other colour - own colour)
    d > 1/2:  the other pixel gets (d - 1/2) (own colour - other colour)

An edge is a silhouette if no face across it lies on its other side of the screen (or none at all), and it counts for
a horizontal pair if it is at least as steep as the diagonal, for a vertical pair if at most. d moves with the two ends
of the edge: that is where vertices get gradients from; vertex colours and textures give them more through the
barycentrics. Edges within the surface give none, so the mesh must be welded. A triangle too small to own a pixel has no
silhouette.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.backgrounds import for_each_view
from etsplat.core.cameras import Cameras, check_views, view_arguments
from etsplat.core.connectivity import HOW_CONNECTED, MeshConnectivity
from etsplat.core.precision import as_given
from etsplat.core.rasterization import Rasterization, joined
from etsplat.core.validation import check_device, check_finite, check_kind, check_like, check_shape
from etsplat.engines.choice import engine_for
from etsplat.ops.rasterize import LARGEST_COLOR, one_kind_of_colors
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.ops.texture import texture_at_pixels


@as_given
def rasterize_antialiased(
    vertices: Float[Tensor, "V 3"],
    *,
    connectivity: MeshConnectivity,
    face_colors: Float[Tensor, "F C"] | None = None,
    vertex_colors: Float[Tensor, "V C"] | None = None,
    texture: Float[Tensor, "H W C"] | None = None,
    face_uvs: Float[Tensor, "F 3 2"] | None = None,
    max_level: int | None = None,
    viewmats: Float[Tensor, "B 4 4"] | None = None,
    Ks: Float[Tensor, "B 3 3"] | None = None,
    width: int | None = None,
    height: int | None = None,
    cameras: Cameras | None = None,
    backgrounds: Float[Tensor, " C"] | Float[Tensor, "B C"] | None = None,
    near_plane: float = 0.01,
    validate: bool | None = None,
) -> Rasterization:
    """Picture of an opaque mesh, differentiable by vertices, colours, texture, backgrounds and cameras.

    Args:
        vertices: (V, 3) of a welded mesh, world space.
        connectivity: its faces and which of them share edges; ``MeshTopology.connectivity``.
        face_colors: (F, C), one colour per face. Exactly one of this, ``vertex_colors`` and ``texture`` is given.
        vertex_colors: (V, C), interpolated perspective-correctly.
        texture: (H, W, C), row by row from the top, as in ``sample_texture``. A pixel's level of detail follows from
            how far the texture coordinates move to the next pixels, and has no gradient.
        face_uvs: (F, 3, 2) texture coordinates of each face's corners, with ``texture``: (0, 0) is its upper left
            corner, (1, 1) its lower right one. Faces share none, so that they may lie in the texture anywhere.
        max_level: The coarsest level of the texture that is used, as in ``sample_texture``; 0 for textures whose parts
            belong to faces apart, which coarser levels would mix.
        viewmats: (B, 4, 4) world to camera, OpenCV axes.
        Ks: (B, 3, 3) intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
        cameras: All of the four above in one.
        backgrounds: (C,) behind all views, or (B, C); None is black.
        near_plane: Triangles with a vertex at this depth or nearer are dropped; > 0.
        validate: Raise on colours and backgrounds that are not finite, or beyond 1e30, whose products in the gradients
            overflow; None means on the CPU.

    Returns:
        The picture as colour (B, H, W, C), and what ``rasterize_opaque`` gives, without gradients. The native engines'
        images and gradients are the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype, device or values; the message names the argument.

    Example:
        >>> vertices, faces = etsplat.icosphere(2)
        >>> topology = etsplat.MeshTopology.from_faces(faces, len(vertices))
        >>> picture = etsplat.rasterize_antialiased(
        ...     vertices.requires_grad_(),
        ...     connectivity=topology.connectivity,
        ...     face_colors=torch.ones(len(faces), 3),
        ...     cameras=etsplat.orbit_cameras(32, 32, elevations=(0.0,), azimuths=1),
        ... )
        >>> picture.color.mean().backward()  # through the outline alone: all faces are white
        >>> bool(vertices.grad.abs().sum() > 0)
        True
    """
    viewmats, Ks, width, height = view_arguments(cameras, viewmats, Ks, width, height)
    check_kind("connectivity", connectivity, MeshConnectivity, HOW_CONNECTED)
    check_shape("vertices", vertices, (connectivity.num_vertices, 3))
    check_views(viewmats, Ks, "vertices", vertices)
    check_device("connectivity", connectivity.faces, "vertices", vertices)
    if sum(given is not None for given in (face_colors, vertex_colors, texture)) != 1:
        raise ValueError("exactly one of face_colors, vertex_colors and texture must be given")
    if texture is not None:
        name, colors = "texture", texture
        _check_texture(texture, face_uvs, vertices, connectivity)
    else:
        _refuse_without_texture(face_uvs=face_uvs, max_level=max_level)
        name, colors = one_kind_of_colors(face_colors, vertex_colors, None, connectivity.faces)
        check_shape(name, colors, (len(vertices) if face_colors is None else len(connectivity.faces), "C"))
    check_like(name, colors, "vertices", vertices)
    if backgrounds is None:
        backgrounds = vertices.new_zeros(colors.shape[-1])
    backgrounds = for_each_view(backgrounds, len(viewmats))
    channels = colors.shape[-1]
    check_shape("backgrounds", backgrounds, (channels,), (len(viewmats), channels))
    check_like("backgrounds", backgrounds, "vertices", vertices)
    if validate or (validate is None and vertices.is_cpu):
        check_finite(name, colors, LARGEST_COLOR)
        check_finite("backgrounds", backgrounds, LARGEST_COLOR)
    if torch.is_grad_enabled() and (viewmats.requires_grad or Ks.requires_grad):
        return joined(
            [
                rasterize_antialiased(
                    moved,
                    connectivity=connectivity,
                    face_colors=face_colors,
                    vertex_colors=vertex_colors,
                    texture=texture,
                    face_uvs=face_uvs,
                    max_level=max_level,
                    cameras=Cameras(torch.eye(4).to(viewmats)[None], Ks[view : view + 1].detach(), width, height),
                    backgrounds=backgrounds[view],
                    near_plane=near_plane,
                    validate=False,
                )
                for view, moved in enumerate(_seen_from(vertices, viewmats, Ks))
            ]
        )
    seen = rasterize_opaque(
        vertices, viewmats=viewmats, Ks=Ks, width=width, height=height, faces=connectivity.faces, near_plane=near_plane
    )
    assert seen.triangle is not None
    assert seen.barycentrics is not None
    assert seen.depth is not None
    colors_of = "faces" if vertex_colors is None else "vertices"
    if texture is not None and face_uvs is not None:
        colors_of = "pixels"
        colors = texture_at_pixels(vertices, texture, face_uvs, max_level, viewmats, Ks, connectivity.faces, seen)
    found = seen.triangle, seen.barycentrics, seen.depth[..., 0]
    seen.color = engine_for(vertices).antialias(
        vertices, colors, backgrounds, viewmats, Ks, *found, near_plane, colors_of, connectivity
    )
    return seen


def _seen_from(vertices: Tensor, viewmats: Tensor, Ks: Tensor) -> list[Float[Tensor, "V 3"]]:
    """The vertices before each camera, which project by its K without gradients to where they do by its own.

    Engines have no gradient to cameras, but to vertices.
    """
    points = vertices @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    focal, middle, fixed = Ks[:, None, [0, 1], [0, 1]], Ks[:, None, :2, 2], Ks.detach()
    shifted = focal * points[..., :2] + (middle - fixed[:, None, :2, 2]) * points[..., 2:]
    return list(torch.cat([shifted / fixed[:, None, [0, 1], [0, 1]], points[..., 2:]], dim=-1))


def _check_texture(texture: Tensor, face_uvs: Tensor | None, vertices: Tensor, connectivity: MeshConnectivity) -> None:
    check_shape("texture", texture, ("H", "W", "C"))
    if 0 in texture.shape[:2]:
        raise ValueError(f"texture must have a texel, got shape {tuple(texture.shape)}")
    if face_uvs is None:
        raise ValueError("face_uvs must be given with texture: where the corners of each face are in it")
    check_shape("face_uvs", face_uvs, (len(connectivity.faces), 3, 2))
    check_like("face_uvs", face_uvs, "vertices", vertices)


def _refuse_without_texture(**given: object) -> None:
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"{name} must be None without texture")
