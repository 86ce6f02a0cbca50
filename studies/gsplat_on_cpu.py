r"""`python -m studies.nvs` with the peers 3dgs and 2dgs where there is no GPU: small pictures, a second or so a step.

    python -m studies.gsplat_on_cpu --methods elastic 3dgs 2dgs --set width=80,iterations=1000 \
        --scenes data/scenes/fox:indoor --out runs/peers

What runs is gsplat 1.5.3 itself, its densification included, but for what it compiles for a GPU: projection and
harmonics are replaced by its own PyTorch twins, the compositing by the functions below (equations of 3DGS and 2DGS,
gsplat's thresholds).
"""

import importlib
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from etsplat.core.errors import InputError
from studies.peers import settings

VERSION = "1.5.3"
"""Of gsplat; what is replaced is not part of its interface."""
LEAST_ALPHA, MOST_ALPHA, LEAST_TRANSMITTANCE = 1 / 255, 0.999, 1e-4
DRAWN_AHEAD = 1.0
"""So far beyond the near plane Gaussians behind a camera are put, for finite gradients; they have no radius."""


def replacements() -> Iterator[tuple[Any, str, Any]]:
    """What takes the place of gsplat's compiled part: module, name, value."""
    try:
        gsplat = importlib.import_module("gsplat")
    except ImportError as error:
        raise InputError("drawing Gaussians needs gsplat: pip install --group studies") from error
    if gsplat.__version__ != VERSION:
        raise SystemExit(f"gsplat {gsplat.__version__}: this needs {VERSION}; pip install gsplat=={VERSION}")
    wrapper = importlib.import_module("gsplat.cuda._wrapper")
    compositing = _Compositing()
    for name, function in (
        ("_FullyFusedProjection", _project),
        ("_FullyFusedProjection2DGS", _project_disks),
        ("_SphericalHarmonics", _harmonics),
        ("_RasterizeToPixels", compositing.draw),
        ("_RasterizeToPixels2DGS", compositing.draw_disks),
    ):
        yield wrapper, name, SimpleNamespace(apply=function)
    yield wrapper, "_make_lazy_cuda_func", compositing.compiled
    yield importlib.import_module("gsplat.rendering"), "torch", _TorchOnCpu("torch")


def load_gsplat_on_cpu() -> tuple[Any, torch.device]:
    """gsplat, with its compiled part replaced in this process, and the CPU.

    Raises:
        InputError: it is not installed.
    """
    for module, name, value in replacements():
        setattr(module, name, value)
    return importlib.import_module("gsplat"), torch.device("cpu")


class _TorchOnCpu(ModuleType):
    """torch for gsplat.rendering, which names the device "cuda" in one place."""

    def __getattr__(self, name: str) -> Any:
        if name == "zeros_like":
            return lambda tensor, device=None, **options: torch.zeros_like(tensor, **options)
        return getattr(torch, name)


def _in_front(means: Tensor, viewmats: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """(N, 3) means, those behind the near plane moved before it, and (N,) whether they were in front of it."""
    front = means @ viewmats[0, 2, :3] + viewmats[0, 2, 3] > near
    camera = torch.linalg.inv(viewmats[0])
    ahead = camera[:3, 3] + camera[:3, 2] * (near + DRAWN_AHEAD)
    return torch.where(front[:, None], means, ahead), front


def _project(
    means: Tensor,
    covars: None,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float,
    near: float,
    far: float,
    radius_clip: float,
    compensations: bool,
    model: str,
    opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
    assert covars is None
    assert (len(viewmats), radius_clip, compensations) == (1, 0.0, False)
    twins = importlib.import_module("gsplat.cuda._torch_impl")
    moved, front = _in_front(means, viewmats, near)
    covariances, _ = twins._quat_scale_to_covar_preci(quats, scales, True, False, False)
    arguments = (moved, covariances, viewmats, Ks, width, height, eps2d, near, far, False, model)
    radii, means2d, depths, conics, _ = twins._fully_fused_projection(*arguments)
    drawn = front & (opacities.detach() >= LEAST_ALPHA)
    return radii * drawn[None, :, None].int(), means2d, depths, conics, None


def _project_disks(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float,
    near: float,
    far: float,
    radius_clip: float,
) -> tuple[Tensor, ...]:
    assert (len(viewmats), radius_clip) == (1, 0.0)
    twins = importlib.import_module("gsplat.cuda._torch_impl_2dgs")
    moved, front = _in_front(means, viewmats, near)
    # The compiled projection takes 1 for the third scale; the twin takes it as it is, for the normal.
    flat = torch.cat([scales[:, :2], torch.ones_like(scales[:, 2:])], dim=1)
    arguments = (moved, quats, flat, viewmats, Ks, width, height, near, far)
    radii, *rest = twins._fully_fused_projection_2dgs(*arguments)
    return radii * front[None, :, None].int(), *rest


def _harmonics(degree: int, directions: Tensor, coefficients: Tensor, masks: Tensor | None) -> Tensor:
    colors = importlib.import_module("gsplat.cuda._torch_impl")._spherical_harmonics(degree, directions, coefficients)
    return colors if masks is None else torch.where(masks[..., None], colors, 0.0)


class _Gradient2dgs(torch.autograd.Function):
    """Gives the strategy of 2DGS what it densifies by: the gradient of a disk's centre on screen times its depth."""

    @staticmethod
    def forward(ctx: Any, transforms: Tensor, densify: Tensor) -> Tensor:
        """Passes the transforms (1, N, 3, 3) on; `densify` (1, N, 2) only receives a gradient."""
        ctx.save_for_backward(transforms)
        return transforms.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        """Of both."""
        (transforms,) = ctx.saved_tensors
        (gradient,) = gradients
        return gradient, gradient[..., :2, 2] * transforms[..., 2, 2, None]


class _Compositing:
    """Draws all pairs of a Gaussian and a pixel of its box at once, sorted by pixel and depth."""

    _radii: Tensor
    _depths: Tensor

    def compiled(self, name: str) -> Any:
        """For gsplat's look-up of compiled functions: tiles are not needed, but what is sorted into them is."""

        def intersect_tile(means2d: Tensor, radii: Tensor, depths: Tensor, *rest: object) -> tuple[Tensor, ...]:
            self._radii, self._depths = radii[0], depths[0].detach()
            none = torch.zeros(0, dtype=torch.int32)
            return torch.zeros(radii.shape[:-1], dtype=torch.int32), none.long(), none

        def intersect_offset(ids: Tensor, images: int, across: int, down: int) -> Tensor:
            return torch.zeros(images, down, across, dtype=torch.int32)

        return {"intersect_tile": intersect_tile, "intersect_offset": intersect_offset}[name]

    def draw(
        self,
        means2d: Tensor,
        conics: Tensor,
        colors: Tensor,
        opacities: Tensor,
        backgrounds: Tensor | None,
        masks: None,
        width: int,
        height: int,
        *tiles: object,
    ) -> tuple[Tensor, Tensor]:
        """Colours (1, H, W, C) and alpha (1, H, W, 1) of 3D Gaussians."""
        gaussian, pixel = self._pairs(means2d[0], width, height)
        dx, dy = (_centers(pixel, width) - means2d[0, gaussian]).unbind(dim=1)
        xx, xy, yy = conics[0, gaussian].unbind(dim=1)
        exponent = 0.5 * (xx * dx**2 + yy * dy**2) + xy * dx * dy
        alpha = (opacities[0, gaussian] * torch.exp(-exponent)).clamp_max(MOST_ALPHA)
        kept = (alpha >= LEAST_ALPHA) & (exponent >= 0)
        gaussian, pixel, alpha = gaussian[kept], pixel[kept], alpha[kept]
        return _over(backgrounds, *_composite(alpha, pixel, colors[0, gaussian], width, height))

    def draw_disks(
        self,
        means2d: Tensor,
        transforms: Tensor,
        colors: Tensor,
        opacities: Tensor,
        normals: Tensor,
        densify: Tensor,
        backgrounds: Tensor | None,
        masks: None,
        width: int,
        height: int,
        *tiles: object,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Colours, alpha, normals, and nothing for distortion and median depth, of 2D Gaussians."""
        transforms = _Gradient2dgs.apply(transforms, densify)
        gaussian, pixel = self._pairs(means2d[0], width, height)
        centers, rows = _centers(pixel, width), transforms[0, gaussian]
        planes = (rows[:, 2] * centers[:, i, None] - rows[:, i] for i in (0, 1))
        crossing = torch.linalg.cross(*planes)  # where the ray of the pixel meets the disk
        kept = crossing[:, 2] != 0
        gaussian, pixel, crossing, centers = gaussian[kept], pixel[kept], crossing[kept], centers[kept]
        on_disk = (crossing[:, :2] / crossing[:, 2:]).square().sum(dim=1)
        on_screen = 2 * (centers - means2d[0, gaussian]).square().sum(dim=1)
        exponent = 0.5 * torch.minimum(on_disk, on_screen)
        alpha = (opacities[0, gaussian] * torch.exp(-exponent)).clamp_max(MOST_ALPHA)
        kept = alpha >= LEAST_ALPHA
        gaussian, pixel, alpha = gaussian[kept], pixel[kept], alpha[kept]
        values = torch.cat([colors[0, gaussian], normals[0, gaussian]], dim=1)
        drawn, covered = _composite(alpha, pixel, values, width, height)
        color, covered = _over(backgrounds, drawn[..., :-3], covered)
        nothing = torch.zeros_like(covered)
        return color, covered, drawn[..., -3:], nothing, nothing

    @torch.no_grad()
    def _pairs(self, means2d: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
        """(P,) Gaussian and pixel of each pair, by pixel and from near to far."""
        seen = (self._radii > 0).all(dim=-1).nonzero()[:, 0]
        seen = seen[self._depths[seen].argsort(stable=True)]
        size = torch.tensor([width, height])
        low = torch.minimum((means2d[seen] - self._radii[seen]).floor().clamp_min(0).long(), size)
        high = torch.minimum((means2d[seen] + self._radii[seen]).ceil().clamp_min(0).long(), size)
        across, down = (high - low).unbind(dim=1)
        count = across * down
        box = torch.repeat_interleave(count)
        place = torch.arange(len(box)) - (count.cumsum(0) - count)[box]
        pixel = (low[box, 1] + place // across[box]) * width + low[box, 0] + place % across[box]
        order = pixel.argsort(stable=True)
        return seen[box[order]], pixel[order]


def _centers(pixel: Tensor, width: int) -> Tensor:
    """(P, 2) centres of the pixels."""
    return torch.stack([pixel % width, pixel // width], dim=1) + 0.5


def _composite(alpha: Tensor, pixel: Tensor, values: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Sums over each pixel's pairs, front to back, of values (P, D) and of 1, by their weights: (1, H, W, D or 1)."""
    logs = torch.log1p(-alpha.double())
    before = logs.cumsum(0) - logs
    first = torch.ones_like(pixel, dtype=torch.bool)
    first[1:] = pixel[1:] != pixel[:-1]
    start = torch.where(first, torch.arange(len(pixel)), 0).cummax(dim=0).values
    transmittance = (before - before[start]).exp()
    ended = (transmittance * (1 - alpha.double()) <= LEAST_TRANSMITTANCE).detach()
    weights = (alpha * torch.where(ended, 0.0, transmittance)).float()[:, None]
    values = torch.cat([values, torch.ones_like(weights)], dim=1)
    total = torch.zeros(width * height, values.shape[1]).index_add(0, pixel, weights * values)
    total = total.view(1, height, width, -1)
    return total[..., :-1], total[..., -1:]


def _over(backgrounds: Tensor | None, colors: Tensor, covered: Tensor) -> tuple[Tensor, Tensor]:
    """Colours over the background, and alpha as it is."""
    if backgrounds is not None:
        colors = colors + backgrounds[:, None, None, :] * (1 - covered)
    return colors, covered


if __name__ == "__main__":
    from studies import gsplat_on_cpu  # under its own name, by which the processes of a grid find the function

    gsplat_on_cpu.load_gsplat_on_cpu()
    settings.load_gsplat = gsplat_on_cpu.load_gsplat_on_cpu

    from studies.nvs import Nvs

    Nvs.main()
