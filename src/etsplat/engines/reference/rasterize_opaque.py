"""Z-buffer rasterization in plain PyTorch: one triangle after the other, by edge functions in float64."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.rasterization import OpaqueView
from etsplat.engines.reference.rasterize import doubled_area, edge_functions

# Samples held at a time.
_STRIP_SAMPLES = 4_000_000


def rasterize_opaque(
    points: Float[Tensor, "V 3"],
    triangles: Int[Tensor, "F 3"],
    view: OpaqueView,
    triangle: Int[Tensor, "H W"],
    barycentrics: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
) -> None:
    """Fill the three images of one view: contiguous points and int32 triangles."""
    corners, inverse_depths, drawn = _project(points, triangles, view)
    owner, inverse_depth = _z_buffer(corners, inverse_depths, drawn, view.width, view.height)
    triangle.copy_(owner)
    depth.copy_(torch.where(owner >= 0, 1 / inverse_depth, 0))
    barycentrics.copy_(_barycentrics(corners, inverse_depths, owner))


def render_opaque(
    points: Float[Tensor, "V 3"],
    triangles: Int[Tensor, "F 3"],
    view: OpaqueView,
    colors: Float[Tensor, "F C"] | Float[Tensor, "V C"],
    per_face: bool,
    supersampling: int,
    cull_backfaces: bool,
    image: Float[Tensor, "H W C1"],
) -> None:
    """Fill the image of one view, strip by strip; colours are contiguous."""
    corners, inverse_depths, drawn = _project(points, triangles, view)
    if cull_backfaces:
        drawn &= doubled_area(corners) < 0  # y points down: counter-clockwise is negative
    rows = max(1, _STRIP_SAMPLES // (view.width * supersampling**2))
    for top in range(0, view.height, rows):
        bottom = min(top + rows, view.height)
        samples = supersampling * (corners - corners.new_tensor([0, top]))
        owner, _ = _z_buffer(samples, inverse_depths, drawn, supersampling * view.width, supersampling * (bottom - top))
        covered = owner >= 0
        chosen = owner[covered].long()
        if per_face:
            shown = colors[chosen].double()
        else:
            weights = _barycentrics(samples, inverse_depths, owner)[covered]
            shown = (weights[..., None] * colors[triangles[chosen].long()]).sum(dim=-2)
        layers = corners.new_zeros((*owner.shape, colors.shape[1] + 1))
        layers[covered] = torch.nn.functional.pad(shown, (0, 1), value=1.0)  # the coverage
        grid = layers.view(bottom - top, supersampling, view.width, supersampling, -1)
        image[top:bottom] = grid.mean(dim=(1, 3))


def _project(points: Tensor, triangles: Tensor, view: OpaqueView) -> tuple[Tensor, Tensor, Tensor]:
    """Corners (F, 3, 2) in pixels, their 1/z (F, 3), both float64, and which triangles can be drawn (F,)."""
    viewmat, K = view.viewmat.double(), view.K.double()
    camera = points.double() @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = camera[:, 2]
    inverse_depth = 1 / z
    screen = camera[:, :2] * K.diagonal()[:2] * inverse_depth[:, None] + K[:2, 2]
    usable = (z > view.near_plane) & screen.isfinite().all(dim=1) & z.isfinite()
    chosen = triangles.long()
    corners = screen[chosen]
    area = doubled_area(corners)
    return corners, inverse_depth[chosen], usable[chosen].all(dim=1) & (area != 0) & area.isfinite()


def _z_buffer(corners: Tensor, inverse_depths: Tensor, drawn: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Owner (H, W) int32, -1 where empty, and its 1/z, 0 where empty."""
    nearest = corners.new_zeros((height, width))
    owner = torch.full((height, width), -1, dtype=torch.int32, device=corners.device)
    limits = corners.new_tensor([width, height])
    low = (corners.amin(dim=1) - 0.5).ceil().clamp(min=0).minimum(limits)
    high = (corners.amax(dim=1) - 0.5).floor().add(1).clamp(min=0).minimum(limits)
    drawn = drawn & (low < high).all(dim=1)
    for f in drawn.nonzero()[:, 0].tolist():
        (x0, y0), (x1, y1) = low[f].int().tolist(), high[f].int().tolist()
        x = torch.arange(x0, x1, dtype=corners.dtype, device=corners.device) + 0.5
        y = torch.arange(y0, y1, dtype=corners.dtype, device=corners.device) + 0.5
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        triangle, depths = corners[f], inverse_depths[f]
        if doubled_area(triangle) < 0:
            triangle, depths = triangle.flip(0), depths.flip(0)
        areas = edge_functions(pixels, triangle)
        edge = triangle.roll(-2, 0) - triangle.roll(-1, 0)
        top_left = (edge[:, 1] < 0) | ((edge[:, 1] == 0) & (edge[:, 0] > 0))
        inside = ((areas > 0) | ((areas == 0) & top_left)).all(dim=-1)
        inverse_depth = (areas * depths).sum(dim=-1) / doubled_area(triangle)
        box = (slice(y0, y1), slice(x0, x1))
        nearer = inside & (inverse_depth > nearest[box])  # strictly: the smaller index wins a tie
        nearest[box] = torch.where(nearer, inverse_depth, nearest[box])
        owner[box] = torch.where(nearer, f, owner[box])
    return owner, nearest


def _barycentrics(corners: Tensor, inverse_depths: Tensor, owner: Tensor) -> Tensor:
    """Perspective-correct b_k = (a_k / z_k) / sum_j (a_j / z_j), a clamped at 0; (H, W, 3), 0 where empty."""
    height, width = owner.shape
    result = corners.new_zeros((height, width, 3))
    y, x = (owner >= 0).nonzero(as_tuple=True)
    chosen = owner[y, x].long()
    areas = edge_functions(torch.stack([x, y], dim=-1).to(corners.dtype) + 0.5, corners[chosen])
    weights = (areas * doubled_area(corners[chosen]).sign()[:, None]).clamp(min=0) * inverse_depths[chosen]
    result[y, x] = weights / weights.sum(dim=-1, keepdim=True)
    return result
