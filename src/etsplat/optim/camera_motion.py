"""Small motions of cameras: how they turn and shift a camera, in which units they are learned, which ones nobody sees.

A motion is six numbers (w, s) in the camera's own axes: turn it about its centre by w, then shift it by s. What a
camera sees at x it sees at Q(w) (x - s) afterwards, where Q(w) is Cayley's rotation

    Q(w) = I + 4 / (4 + |w|^2) (K + K^2 / 2),   K x = w x x,

about the axis w by 2 atan(|w| / 2): by |w| where that is small, and smooth at zero.

Turning to the left and shifting to the left look nearly alike, so motions are not learned as they are. With the 6 x 6
matrix H = mean J^T J of how pixels move, in units of the picture's longer side, a motion is (H + d diag H)^-1/2 v:
all directions of v are worth about the same, and |v| is how far the picture moves (Park et al. 2023, CamP).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.engines.threads import one_torch_thread

DAMPING = 0.3
"""d: with less, directions in which pictures hardly move drift, with more they stay (research/results.md)."""

NEAREST = 0.1
"""Points nearer than this part of the median depth count as if they were there: what floats before a lens says little
of it."""

MOST_POINTS = 10_000
"""So many points are looked at at most."""


def moved(camera: Cameras, motion: Float[Tensor, "6"]) -> Cameras:
    """One camera after a motion; differentiable by it."""
    turn, shift = motion.to(camera.viewmats.dtype).split(3)
    identity = torch.eye(3, dtype=turn.dtype, device=turn.device)
    K = torch.linalg.cross(identity, turn.expand(3, 3), dim=1)
    rotation = identity + 4 / (4 + turn.square().sum()) * (K + K @ K / 2)
    viewmat = camera.viewmats[0]
    top = torch.cat([rotation @ viewmat[:3, :3], (rotation @ (viewmat[:3, 3] - shift))[:, None]], dim=1)
    return Cameras(torch.cat([top, viewmat[3:]])[None], camera.Ks, camera.width, camera.height)


def zoomed(camera: Cameras, lens: Float[Tensor, "3"]) -> Cameras:
    """One camera with its focal lengths times e^z and its principal point shifted, both parts of the longer side.

    Args:
        camera: one.
        lens: z, and the shift to the right and down; differentiable.
    """
    lens, side = lens.to(camera.Ks.dtype), max(camera.width, camera.height)
    K = camera.Ks[0]
    focal = torch.stack([K[0, 0], K[1, 1]]) * lens[0].exp()
    center = K[:2, 2] + side * lens[1:]
    skewed = K - torch.diag_embed(torch.diagonal(K))
    rows = torch.cat([skewed[:2, :2] + torch.diag_embed(focal), center[:, None]], dim=1)
    return Cameras(camera.viewmats, torch.cat([rows, K[2:]])[None], camera.width, camera.height)


@torch.no_grad()
def unit_motions(points: Float[Tensor, "N 3"], camera: Cameras) -> Float[Tensor, "6 6"]:
    """The matrix that makes motions of what is learned, float64 on the CPU.

    Args:
        points: on what the camera shows, in world space.
        camera: one; of the points those count that it has in its frame.
    """
    camera = camera.to("cpu", torch.float64)
    at = _in_frame(points, camera)
    if not len(at):  # nothing is known of depths: as if all that it shows were at its distance from the origin
        depth = camera.centers.norm().clamp_min(1e-6)
        at = torch.tensor([[x, y, 1.0] for x in (-0.3, 0.0, 0.3) for y in (-0.3, 0.0, 0.3)]).double() * depth
    x, y, z = at.unbind(dim=1)
    z = z.clamp_min(NEAREST * float(z.median()))
    x, y, zero = x / z, y / z, torch.zeros_like(z)
    # Of x / z: turning moves a point by w x p, shifting by -s.
    across = torch.stack([-x * y, 1 + x * x, -y, -1 / z, zero, x / z], dim=1)
    down = torch.stack([-1 - y * y, x * y, x, zero, -1 / z, y / z], dim=1)
    J = torch.cat([camera.Ks[0, 0, 0] * across, camera.Ks[0, 1, 1] * down]) / max(camera.width, camera.height)
    H = 2 * J.T @ J / len(J)
    H = H + DAMPING * torch.diag_embed(torch.diagonal(H))
    values, vectors = torch.linalg.eigh(H)
    return vectors @ torch.diag_embed(values.rsqrt()) @ vectors.T


@torch.no_grad()
def distance_shown(points: Float[Tensor, "N 3"], camera: Cameras) -> float:
    """Median distance of the points that one camera has in its frame; of the origin if it has none."""
    camera = camera.to("cpu", torch.float64)
    at = _in_frame(points, camera)
    return float(at.norm(dim=1).median() if len(at) else camera.centers.norm())


def _in_frame(points: Float[Tensor, "N 3"], camera: Cameras) -> Float[Tensor, "M 3"]:
    """In the axes of the camera."""
    points = points.detach()[:: max(1, len(points) // MOST_POINTS)].cpu().double()
    at = points @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
    at = at[at[:, 2] > 0]
    pixel = (at @ camera.Ks[0].T)[:, :2] / at[:, 2:]
    return at[((pixel >= 0) & (pixel <= torch.tensor([camera.width, camera.height]))).all(dim=1)]


@torch.no_grad()
@one_torch_thread()
def common_motions(viewmats: Float[Tensor, "P 4 4"], units: Float[Tensor, "P 6 6"]) -> Float[Tensor, "6P k"]:
    """What moves, turns or scales all cameras together, which no photo shows: an orthonormal basis, k at most 7.

    Args:
        viewmats: float64, as given.
        units: from `unit_motions`.

    Returns:
        Of what is learned, one view after the other.
    """
    rotations = viewmats[:, :3, :3]
    centers = -torch.einsum("bji,bj->bi", rotations, viewmats[:, :3, 3])
    offsets = centers - centers.mean(dim=0)
    none = torch.zeros_like(offsets)
    motions = []
    for axis in torch.eye(3, dtype=viewmats.dtype):
        along = axis.expand_as(offsets)
        motions.append((none, along))
        motions.append((-along, torch.linalg.cross(along, offsets)))
    motions.append((none, offsets))
    columns = []
    for turn, shift in motions:
        own = torch.cat([torch.einsum("bij,bj->bi", rotations, each) for each in (turn, shift)], dim=1)
        column = torch.linalg.solve(units, own[..., None]).flatten()
        columns.append(column / column.norm().clamp_min(1e-30))
    basis, sizes, _ = torch.linalg.svd(torch.stack(columns, dim=1), full_matrices=False)
    return basis[:, sizes > 1e-6 * sizes[0]]
