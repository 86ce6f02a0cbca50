"""The rasterizer as the paper writes it, in plain PyTorch: any precision, gradients by autograd.

A view is rendered in two steps. ``_project`` picks the visible triangles and brings them to the image in drawing order;
invisible ones are dropped here, before any arithmetic that has a gradient, so that nothing of theirs can turn into NaN.
``_composite`` evaluates equation (1) of the paper for a block of pixels against the triangles that can reach it. Blocks
are checkpointed: the backward pass recomputes them one at a time, and memory stays that of one block.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from etsplat.core.forward_mode import refuse_forward_mode
from etsplat.core.kernels import KERNELS, Kernel
from etsplat.core.rasterization import (
    DISTORTION_FAR,
    DISTORTION_NEAR,
    OUTPUTS,
    Rasterization,
    RasterizeSettings,
    RasterizeTensors,
    TriangleStatistics,
    joined,
)

_BLOCK = 32  # pixels along a side of a block
# Beyond these, squares and products leave the range of float32; alike in every engine.
_FARTHEST_PIXEL = 1e15
_LARGEST = 1e30  # of depths, and of squared lengths in pixels


def rasterize(tensors: RasterizeTensors, settings: RasterizeSettings) -> Rasterization:
    """See `etsplat.rasterize`."""
    triangles, colors = tensors.corners, tensors.face_colors
    if tensors.vertex_colors is not None and tensors.faces is not None:
        colors = tensors.vertex_colors[tensors.faces.long()]
    elif tensors.corner_colors is not None:
        colors = tensors.corner_colors
    assert colors is not None
    opacities, viewmats, Ks = tensors.opacities, tensors.viewmats, tensors.Ks
    per_view = tensors.face_colors is not None and colors.ndim == 3
    sigma = tensors.sigma.expand(opacities.shape)
    views = []
    for view in range(viewmats.shape[0]):
        view_colors = colors[view] if per_view else colors
        projected = _project(triangles, view_colors, opacities, sigma, viewmats[view], Ks[view], settings)
        channels, max_weight = _render(projected, settings)
        background = None if tensors.backgrounds is None else tensors.backgrounds[view, None, None, None]
        result = _assemble(channels[None], background, settings)
        if settings.wants("statistics"):
            result.statistics = _statistics(projected, max_weight, len(opacities))
        views.append(result)
    return joined(views)


@dataclass
class _Projected:
    """The M visible triangles of one view, in drawing order.

    Attributes:
        index: (M,) which of the N triangles.
        corners: (M, 3, 2) projected vertices in pixels.
        corner_depths: (M, 3) view-space z of the vertices.
        depth: (M,) view-space z of the centroid.
        normal: (M, 3) unit normal in world space, towards the camera.
        colors: (M, C), or (M, 3, C) of the corners.
        opacity: (M,).
        sigma: (M,).
        box: (M, 4) left, top, right, bottom of the visible support in pixels.
        screen_size: (M,) pixels.
        inradius: (M,) pixels.
    """

    index: Tensor
    corners: Tensor
    corner_depths: Tensor
    depth: Tensor
    normal: Tensor
    colors: Tensor
    opacity: Tensor
    sigma: Tensor
    box: Tensor
    screen_size: Tensor
    inradius: Tensor


def _project(
    triangles: Tensor,
    colors: Tensor,
    opacities: Tensor,
    sigma: Tensor,
    viewmat: Tensor,
    K: Tensor,
    settings: RasterizeSettings,
) -> _Projected:
    """Cull, sort by the depth of the centroid (ties by index), and project."""
    with torch.no_grad():
        corners, corner_depths = to_screen(triangles, viewmat, K)
        centre, inradius, screen_size = _shape(corners, settings.distance)
        support = KERNELS[settings.kernel].support(opacities, sigma, settings.cutoffs.alpha_min)
        reach = support.clamp(max=settings.cutoffs.x_max)
        scaled = centre[:, None] + reach[:, None, None] * (corners - centre[:, None])
        box = torch.cat([scaled.amin(dim=1), scaled.amax(dim=1)], dim=-1)
        everywhere = box.new_tensor([-torch.inf, -torch.inf, torch.inf, torch.inf])
        box = torch.where(reach[:, None].isinf(), everywhere, box)  # also along an axis without extent
        visible = _has_area(corners) & (corner_depths > settings.near_plane).all(dim=-1)
        visible &= (corner_depths < _LARGEST).all(dim=-1)
        visible &= (opacities >= settings.cutoffs.alpha_min) & (sigma > 0)
        visible &= (box[:, 0] <= settings.width) & (box[:, 2] >= 0) & (box[:, 1] <= settings.height) & (box[:, 3] >= 0)
        for data in (triangles, corner_depths, colors, opacities, sigma):
            visible &= data.isfinite().flatten(start_dim=1).all(dim=-1) if data.ndim > 1 else data.isfinite()
        candidates = visible.nonzero()[:, 0]
        order = torch.argsort(corner_depths[candidates].mean(dim=-1), stable=True)
        index = candidates[order]

    corners, corner_depths = to_screen(triangles[index], viewmat, K)
    return _Projected(
        index=index,
        corners=corners,
        corner_depths=corner_depths,
        depth=corner_depths.mean(dim=-1),
        normal=_facing_normal(triangles[index], viewmat),
        colors=colors[index],
        opacity=opacities[index],
        sigma=sigma[index],
        box=box[index],
        screen_size=screen_size[index],
        inradius=inradius[index],
    )


def to_screen(triangles: Tensor, viewmat: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel coordinates (..., 2) and view-space z of world points (..., 3)."""
    in_view = triangles @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = in_view[..., 2]
    return in_view[..., :2] / z[..., None] * K.diagonal()[:2] + K[:2, 2], z


def _shape(corners: Tensor, distance: str) -> tuple[Tensor, Tensor, Tensor]:
    """Centre of the level sets of x, inradius and screen size of projected triangles."""
    lengths = _edge_lengths(corners)
    perimeter = lengths.sum(dim=-1)
    mean = corners.mean(dim=-2)
    incentre = (lengths[..., None] * corners).sum(dim=-2) / perimeter[:, None]
    screen_size = (corners - mean[:, None]).norm(dim=-1).amax(dim=-1)
    return (mean if distance == "barycentric" else incentre), doubled_area(corners).abs() / perimeter, screen_size


def doubled_area(corners: Tensor) -> Tensor:
    """Twice the signed area (..., ) of 2-D triangles (..., 3, 2)."""
    return cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Of 2-D vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _edge_lengths(corners: Tensor) -> Tensor:
    """Length (..., 3) of the edge opposite to each corner."""
    return (corners.roll(-2, dims=-2) - corners.roll(-1, dims=-2)).norm(dim=-1)


def _has_area(corners: Tensor) -> Tensor:
    """Whether the projected triangle is wide enough to have a well-defined x, and small enough for float32 sums."""
    longest = (corners - corners.roll(1, dims=-2)).square().sum(dim=-1).amax(dim=-1)
    doubled = doubled_area(corners).abs()
    in_range = (corners.abs() < _FARTHEST_PIXEL).all(dim=-1).all(dim=-1) & (longest < _LARGEST)
    return (doubled > (1e-6 * longest).clamp(min=1e-12)) & in_range


def unit_normals(triangles: Tensor) -> Tensor:
    """Unit normals (N, 3) of triangles (N, 3, 3) by the right-hand rule; 0 for one without area or too long."""
    edges = triangles[:, 1:] - triangles[:, :1]
    # Brought near 1 first: the squares of very long or short edges leave the range of float32.
    size = edges.detach().abs().amax(dim=(1, 2), keepdim=True)
    usable = (size > 0) & size.isfinite()
    edges = torch.where(usable, edges, 0.0) / torch.where(usable, size, 1.0)
    normal = torch.linalg.cross(edges[:, 0], edges[:, 1])
    length = normal.norm(dim=-1, keepdim=True)
    return torch.where(length > 0, normal / length.clamp(min=torch.finfo(normal.dtype).tiny), 0.0)


def _facing_normal(triangles: Tensor, viewmat: Tensor) -> Tensor:
    """Unit normals (M, 3) in world space with n . (centroid - camera centre) <= 0."""
    normal = unit_normals(triangles)
    with torch.no_grad():
        camera = -viewmat[:3, :3].T @ viewmat[:3, 3]
        away = (normal * (triangles.mean(dim=1) - camera)).sum(dim=-1, keepdim=True) > 0
    return torch.where(away, -normal, normal)


def _render(projected: _Projected, settings: RasterizeSettings) -> tuple[Tensor, Tensor]:
    """All channels (H, W, K) of one view, and the largest blend weight (M,) of each triangle."""
    max_weight = torch.zeros_like(projected.opacity.detach())
    rows = []
    for top in range(0, settings.height, _BLOCK):
        bottom = min(top + _BLOCK, settings.height)
        row = []
        for left in range(0, settings.width, _BLOCK):
            right = min(left + _BLOCK, settings.width)
            box = projected.box
            near = ((box[:, 0] <= right) & (box[:, 2] >= left) & (box[:, 1] <= bottom) & (box[:, 3] >= top)).nonzero()[
                :, 0
            ]
            y = torch.arange(top, bottom, dtype=box.dtype, device=box.device) + 0.5
            x = torch.arange(left, right, dtype=box.dtype, device=box.device) + 0.5
            pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
            channels, weights = checkpoint(
                _composite, pixels, projected, near, settings, use_reentrant=False, preserve_rng_state=False
            )
            row.append(channels.reshape(bottom - top, right - left, -1))
            max_weight[near] = torch.maximum(max_weight[near], weights)
        rows.append(torch.cat(row, dim=1))
    return torch.cat(rows, dim=0), max_weight


def _composite(
    pixels: Tensor, triangles: _Projected, near: Tensor, settings: RasterizeSettings
) -> tuple[Tensor, Tensor]:
    """Front-to-back compositing of P pixels (paper, equation (1)) over the triangles ``near`` in drawing order.

    Returns:
        (P, K) channels in the order of ``_assemble``, and (len(near),) largest weights without gradient.
    """
    barycentric = barycentrics(pixels[:, None], triangles.corners[near])
    x = _distance(barycentric, triangles.corners[near], settings)
    gain = _KernelValue.apply(x, triangles.sigma[near].expand_as(x), KERNELS[settings.kernel])
    cutoffs = settings.cutoffs
    # clamp has zero gradient where it acts: there, alpha depends on neither the opacity nor the distance.
    alpha = (triangles.opacity[near] * gain).clamp(max=cutoffs.alpha_max)
    alpha = torch.where((alpha >= cutoffs.alpha_min) & (x <= cutoffs.x_max), alpha, 0.0)
    # The pixel dies at the first triangle that would bring T below the minimum, undrawn, with all behind it.
    alive = _transmittance(alpha.detach())[:, 1:] >= cutoffs.transmittance_min
    alpha = torch.where(alive, alpha, 0.0)
    transmittance = _transmittance(alpha)
    before, after = transmittance[:, :-1], transmittance[:, 1:]
    weight = alpha * before

    z_weights = perspective_weights(barycentric, triangles.corner_depths[near])
    colors = triangles.colors[near]
    if colors.ndim == 2:
        channels = [weight @ colors]
    else:
        channels = [(weight[..., None] * z_weights).flatten(start_dim=1) @ colors.flatten(end_dim=1)]
    channels.append(transmittance[:, -1:])
    if settings.depth_of == "centroid":
        z = triangles.depth[near].expand_as(weight)
    else:
        z = (z_weights * triangles.corner_depths[near]).sum(dim=-1)
    if settings.wants("depth"):
        channels.append((weight * z).sum(dim=1, keepdim=True))
    if settings.wants("median_depth"):
        crossing = (before > 0.5) & (after <= 0.5)
        channels.append(torch.where(crossing, z, 0.0).sum(dim=1, keepdim=True))
    if settings.wants("normal"):
        channels.append(weight @ triangles.normal[near])
    if settings.wants("distortion"):
        channels.append(_distortion(weight, z))
    return torch.cat(channels, dim=1), weight.detach().amax(dim=0)


def barycentrics(pixels: Tensor, corners: Tensor) -> Tensor:
    """Affine screen-space barycentrics (..., 3) of points (..., 2) in triangles (..., 3, 2).

    Signed areas opposite to each corner over the triangle's.
    """
    return edge_functions(pixels, corners) / doubled_area(corners)[..., None]


def edge_functions(pixels: Tensor, corners: Tensor) -> Tensor:
    """Twice the signed areas (..., 3) that points (..., 2) span with the edges opposite to each corner (..., 3, 2)."""
    to_corners = corners - pixels[..., None, :]
    return cross(to_corners.roll(-1, dims=-2), to_corners.roll(-2, dims=-2))


def _distance(barycentric: Tensor, corners: Tensor, settings: RasterizeSettings) -> Tensor:
    """Normalised distance x (P, M): 0 at the centre, 1 on the edge.

    "barycentric" is x = 1 - 3 min_k a_k; "sdf" is x = 1 + max_k L_k / inradius with the signed distance L_k = -a_k h_k
    to edge line k, where h_k is the height over that edge. Of equal candidates the first counts.
    """
    if settings.distance == "barycentric":
        return 1.0 + _first_max(-3.0 * barycentric)
    doubled = doubled_area(corners).abs()
    lengths = _edge_lengths(corners)
    inradius = doubled / lengths.sum(dim=-1)
    if settings.freeze_inradius:
        inradius = inradius.detach()
    signed_distance = -barycentric * (doubled[:, None] / lengths)
    return 1.0 + _first_max(signed_distance) / inradius


def _first_max(values: Tensor) -> Tensor:
    """Maximum over the last axis; all of the gradient goes to the first of equal values."""
    return values.gather(-1, values.argmax(dim=-1, keepdim=True))[..., 0]


class _KernelValue(torch.autograd.Function):
    """G(x) with the closed-form derivatives of the registry, which carry its floors."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, sigma: Tensor, kernel: Kernel) -> Tensor:
        ctx.save_for_backward(x, sigma)
        ctx.kernel = kernel
        return kernel.value(x, sigma)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, None]:
        (grad,) = grad_outputs
        x, sigma = ctx.saved_tensors
        dx, dsigma = ctx.kernel.gradient(x, sigma)
        return grad * dx, grad * dsigma, None

    jvp = staticmethod(refuse_forward_mode)


def _transmittance(alpha: Tensor) -> Tensor:
    """T before the first triangle, and after each: (P, M) -> (P, M + 1)."""
    return torch.cat([alpha.new_ones(len(alpha), 1), torch.cumprod(1.0 - alpha, dim=1)], dim=1)


def perspective_weights(barycentric: Tensor, corner_depths: Tensor) -> Tensor:
    """Weights (..., 3) of the corners' attributes; clamped, so that nothing extrapolates outside of the triangle."""
    over_z = barycentric.clamp(min=0.0) / corner_depths
    return over_z / over_z.sum(dim=-1, keepdim=True)


def _distortion(weight: Tensor, z: Tensor) -> Tensor:
    """Sum over pairs of w_i w_j (m_i - m_j)^2, written as W sum_i w_i (m_i - mean)^2 to avoid cancellation."""
    m = DISTORTION_FAR / (DISTORTION_FAR - DISTORTION_NEAR) * (1.0 - DISTORTION_NEAR / z)
    total = weight.sum(dim=1, keepdim=True)
    mean = (weight * m).sum(dim=1, keepdim=True) / total.clamp(min=torch.finfo(z.dtype).tiny)
    return total * (weight * (m - mean).square()).sum(dim=1, keepdim=True)


def _statistics(projected: _Projected, max_weight: Tensor, count: int) -> TriangleStatistics:
    def scatter(values: Tensor) -> Tensor:
        return values.new_zeros(1, count).index_copy(1, projected.index, values[None])

    return TriangleStatistics(
        max_weight=scatter(max_weight),
        screen_size=scatter(projected.screen_size),
        inradius=scatter(projected.inradius),
        visible=scatter(torch.ones_like(projected.index, dtype=torch.bool)),
    )


def _assemble(channels: Tensor, background: Tensor | None, settings: RasterizeSettings) -> Rasterization:
    """Split the channels (1, H, W, K) of a view into images."""
    depths, median, normals, distorted = (settings.wants(name) for name in OUTPUTS[2:6])
    extra = [depths, median, 3 * normals, distorted]
    colors = channels.shape[-1] - 1 - sum(extra)
    color, transmittance, depth, median_depth, normal, distortion = channels.split([colors, 1, *extra], dim=-1)
    if background is not None:
        color = color + transmittance * background
    alpha = 1.0 - transmittance
    return Rasterization(
        color=color,
        alpha=alpha,
        depth=depth / alpha.clamp(min=1e-8) if depths else None,
        median_depth=median_depth if median else None,
        normal=normal if normals else None,
        distortion=distortion if distorted else None,
    )
