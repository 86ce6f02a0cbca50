"""What the native rasterizers share below autograd: their inputs, outputs, and what a render is made of."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from etsplat.core.rasterization import Cutoffs, RasterizeSettings, TriangleStatistics
from etsplat.core.validation import dense
from etsplat.engines.native.pool import copied_indices, empty


class PerInput(NamedTuple):
    """Something for each tensor of a render: the tensor itself, its gradient, or whether that is needed."""

    vertices: Any
    flat: Any
    corner: Any
    opacities: Any
    sigma: Any
    viewmats: Any
    Ks: Any
    backgrounds: Any


class Inputs(PerInput):
    """The tensors of a render; shapes as in ``etsplat.rasterize``.

    Flat channels are (N, F) or (B, N, F), corner channels (N, 3, K) or (B, N, 3, K), and backgrounds (B, F + K); each
    may be None.
    """

    @property
    def channels(self) -> tuple[int, int]:
        """F, K; 0 for none."""
        return channel_count(self.flat), channel_count(self.corner)

    @property
    def flat_per_view(self) -> bool:
        """Whether each view has flat channels of its own."""
        return self.flat is not None and self.flat.dim() == 3

    @property
    def corner_per_view(self) -> bool:
        """Whether each view has corner channels of its own."""
        return self.corner is not None and self.corner.dim() == 4


class Geometry:
    """Triangles, and a copy of their ``faces`` as int32, which nobody else can change before the backward pass."""

    def __init__(self, vertices: Tensor, faces: Tensor | None) -> None:
        self.vertex_count = vertices.shape[0]
        self.count = vertices.shape[0] if faces is None else faces.shape[0]
        self.faces = None if faces is None else copied_indices(dense(faces, "faces"))

    @cached_property
    def corners(self) -> tuple[Tensor, Tensor]:
        """With faces, where each vertex is used: offsets (V + 1,) and places 3 face + corner, ascending for each."""
        assert self.faces is not None
        ordered, places = torch.sort(self.faces.view(-1), stable=True)
        ends = torch.arange(self.vertex_count + 1, dtype=torch.int32, device=self.faces.device)
        return torch.searchsorted(ordered, ends, out_int32=True), places.to(torch.int32)


@dataclass
class Plan:
    """What the autograd function needs besides tensors; it leaves the statistics here."""

    render: "type[Render]"
    settings: RasterizeSettings
    geometry: Geometry
    views: int
    statistics: TriangleStatistics | None = None


class Images(NamedTuple):
    """What the backward pass reads of the outputs."""

    color: Tensor
    alpha: Tensor
    distortion: Tensor | None
    distortion_totals: Tensor | None


class Outputs:
    """Uninitialised output images of a batch, None where not asked for; native code writes every element."""

    def __init__(self, plan: Plan, inputs: Inputs) -> None:
        settings, near = plan.settings, inputs.vertices
        image = (plan.views, settings.height, settings.width)
        self.images = Images(
            color=empty(near, *image, sum(inputs.channels)),
            alpha=empty(near, *image, 1),
            distortion=empty(near, *image, 1) if settings.wants("distortion") else None,
            distortion_totals=empty(near, *image, 2) if settings.wants("distortion") else None,
        )
        self.median_triangle = None
        if settings.wants("median_depth"):
            self.median_triangle = torch.empty(image, dtype=torch.int32, device=near.device)
        self.statistics = None
        if settings.wants("statistics"):
            values = torch.empty(3, plan.views, plan.geometry.count, device=near.device)
            visible = torch.empty(values.shape[1:], dtype=torch.bool, device=near.device)
            self.statistics = TriangleStatistics(values[0], values[1], values[2], visible)


class Render(Protocol):
    """An engine's forward pass over a batch, and what its backward pass needs of it.

    It relies on no address of the inputs and outputs: autograd may hand ``backward`` copies that lie elsewhere, and
    free what ``__init__`` has seen (checkpointing, hooks on saved tensors).
    """

    most_channels: int | None  # of one pass; more are rendered in several

    def __init__(self, plan: Plan, inputs: Inputs, outputs: Outputs, keep: bool) -> None:
        """Renders, and with ``keep`` keeps what ``backward`` needs. All tensors are contiguous."""

    @staticmethod
    def per_corner(values: Tensor, faces: Tensor, geometry: Geometry) -> Tensor:
        """Values (V, C) of vertices at the corners (N, 3, C) of faces, differentiable."""
        ...

    def backward(
        self,
        inputs: Inputs,
        images: Images,
        cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
        needed: PerInput,
    ) -> PerInput:
        """Gradients, None where not ``needed``, from those of colour, alpha and distortion."""
        ...


def indexed_corners(values: Tensor, faces: Tensor, geometry: Geometry) -> Tensor:
    """``Render.per_corner`` by torch's own indexing, which devices do well."""
    return values[faces.long()]


def alpha_limits(cutoffs: Cutoffs) -> tuple[float, float]:
    """The least and the largest alpha that is drawn on a GPU, with the cut-offs off, too.

    Where alpha is 0 x^(2/sigma) may have overflowed, and the backward pass divides by 1 - alpha.
    """
    return max(cutoffs.alpha_min, torch.finfo(torch.float32).tiny), min(cutoffs.alpha_max, 1.0 - 1e-6)


def channel_count(tensor: Tensor | None) -> int:
    """0 for None."""
    return 0 if tensor is None else tensor.shape[-1]
