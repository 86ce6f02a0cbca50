"""What the native rasterizers share below autograd: their inputs, outputs, and what a render is made of."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.rasterization import RasterizeSettings, TriangleStatistics
from etsplat.core.validation import dense
from etsplat.ops.pool import empty_image


class Inputs(NamedTuple):
    """The tensors of a render; shapes as in ``etsplat.rasterize``."""

    vertices: Tensor
    flat: Tensor | None  # (N, F) or (B, N, F)
    corner: Tensor | None  # (N, 3, K) or (B, N, 3, K)
    opacities: Tensor
    sigma: Tensor
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor | None  # (B, F + K)

    @property
    def channels(self) -> tuple[int, int]:
        """F, K; 0 for none."""
        return channel_count(self.flat), channel_count(self.corner)

    @property
    def flat_per_view(self) -> bool:
        return self.flat is not None and self.flat.dim() == 3

    @property
    def corner_per_view(self) -> bool:
        return self.corner is not None and self.corner.dim() == 4


class PerInput(NamedTuple):
    """Something for each of the inputs: its gradient, or whether that is needed."""

    vertices: Any
    flat: Any
    corner: Any
    opacities: Any
    sigma: Any
    viewmats: Any
    Ks: Any
    backgrounds: Any


class Geometry:
    """Triangles, and a copy of their ``faces`` as int32, which nobody else can change before the backward pass."""

    def __init__(self, vertices: Tensor, faces: Tensor | None) -> None:
        self.vertex_count = vertices.shape[0]
        self.count = vertices.shape[0] if faces is None else faces.shape[0]
        self.faces = None if faces is None else dense(faces, "faces").to(torch.int32, copy=True)

    @cached_property
    def corners(self) -> tuple[Tensor, Tensor]:
        """With faces, where each vertex is used: offsets (V + 1,) and places 3 face + corner, ascending for each."""
        assert self.faces is not None
        flat, device = self.faces.view(-1), self.faces.device
        if device.type == "cpu":
            offsets, places = flat.new_empty(self.vertex_count + 1), torch.empty_like(flat)
            outputs = offsets.data_ptr(), places.data_ptr()
            _native.group_indices(flat.data_ptr(), len(flat), self.vertex_count, *outputs)
            return offsets, places
        ordered, places = torch.sort(flat, stable=True)
        ends = torch.arange(self.vertex_count + 1, dtype=torch.int32, device=device)
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
    distortion: Tensor  # empty unless asked for
    distortion_totals: Tensor | None


class Outputs:
    """Uninitialised output images of a batch; native code writes every element."""

    def __init__(self, plan: Plan, inputs: Inputs) -> None:
        settings, device = plan.settings, inputs.vertices.device
        image = (plan.views, settings.height, settings.width)
        self.images = Images(
            color=_empty(device, *image, sum(inputs.channels)),
            alpha=_empty(device, *image, 1),
            distortion=_empty(device, *image, 1) if settings.distortion else _empty(device, 0),
            distortion_totals=_empty(device, *image, 2) if settings.distortion else None,
        )
        median_shape = image if settings.median_depth else (0,)
        self.median_triangle = torch.empty(median_shape, dtype=torch.int32, device=device)
        self.statistics = None
        if settings.statistics:
            values = torch.empty(3, plan.views, plan.geometry.count, device=device)
            visible = torch.empty(values.shape[1:], dtype=torch.bool, device=device)
            self.statistics = TriangleStatistics(values[0], values[1], values[2], visible)


class Render(Protocol):
    """An engine's forward pass over a batch, and what its backward pass needs of it.

    It relies on no address of the inputs and outputs: autograd may hand ``backward`` copies that lie elsewhere, and
    free what ``__init__`` has seen (checkpointing, hooks on saved tensors).
    """

    most_channels: int | None  # of one pass; more are rendered in several

    def __init__(self, plan: Plan, inputs: Inputs, outputs: Outputs, keep: bool) -> None:
        """Renders, and with ``keep`` keeps what ``backward`` needs. All tensors are contiguous."""

    def backward(
        self,
        inputs: Inputs,
        images: Images,
        cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
        needed: PerInput,
    ) -> PerInput:
        """Gradients, None where not ``needed``, from those of colour, alpha and distortion."""
        ...


def channel_count(tensor: Tensor | None) -> int:
    return 0 if tensor is None else tensor.shape[-1]


def _empty(device: torch.device, *shape: int) -> Tensor:
    return empty_image(*shape) if device.type == "cpu" else torch.empty(shape, device=device)
