"""What the native rasterizers share below autograd: their inputs, outputs, and what a render is made of."""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from etsplat.core.rasterization import RasterizeSettings, TriangleStatistics
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
    """Triangles with the index arrays that native code wants: int32 faces, and the corners at each vertex.

    The places 3 face + corner of vertex v are ``corner_indices[corner_offsets[v]:corner_offsets[v + 1]]``.
    """

    def __init__(self, vertices: Tensor, faces: Tensor | None) -> None:
        self.vertex_count = vertices.shape[0]
        self.count = vertices.shape[0] if faces is None else faces.shape[0]
        self.faces, self.corner_offsets, self.corner_indices = _face_arrays(faces, vertices.shape[0])


def _face_arrays(faces: Tensor | None, vertices: int) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Kept on the tensor."""
    if faces is None:
        return None, None, None
    key = (faces._version, vertices)
    cached = getattr(faces, "_etsplat_face_arrays", None)
    if cached is None or cached[0] != key:
        faces32 = faces.to(torch.int32).contiguous()
        ordered, indices = torch.sort(faces32.reshape(-1), stable=True)
        ends = torch.arange(vertices + 1, dtype=torch.int32, device=faces.device)
        offsets = torch.searchsorted(ordered, ends, out_int32=True)
        cached = (key, faces32, offsets, indices.to(torch.int32))
        setattr(faces, "_etsplat_face_arrays", cached)  # noqa: B010
    return cached[1], cached[2], cached[3]


@dataclass
class Plan:
    """What the autograd function needs besides tensors; it leaves the statistics here."""

    render: "type[Render]"
    settings: RasterizeSettings
    geometry: Geometry
    views: int
    statistics: TriangleStatistics | None = None


class Outputs:
    """Uninitialised output images of a batch; native code writes every element."""

    def __init__(self, plan: Plan, inputs: Inputs) -> None:
        settings, device = plan.settings, inputs.vertices.device
        image = (plan.views, settings.height, settings.width)
        self.color = _empty(device, *image, sum(inputs.channels))
        self.alpha = _empty(device, *image, 1)
        self.distortion = _empty(device, *image, 1) if settings.distortion else _empty(device, 0)
        self.distortion_totals = _empty(device, *image, 2) if settings.distortion else None
        median_shape = image if settings.median_depth else (0,)
        self.median_triangle = torch.empty(median_shape, dtype=torch.int32, device=device)
        self.statistics = None
        if settings.statistics:
            values = torch.empty(3, plan.views, plan.geometry.count, device=device)
            visible = torch.empty(values.shape[1:], dtype=torch.bool, device=device)
            self.statistics = TriangleStatistics(values[0], values[1], values[2], visible)


class Render(Protocol):
    """An engine's forward pass over a batch, and what its backward pass needs of it.

    The object may hold addresses of the inputs and outputs; the autograd function keeps the tensors.
    """

    most_channels: int | None  # of one pass; more are rendered in several

    def __init__(self, plan: Plan, inputs: Inputs, outputs: Outputs, keep: bool) -> None:
        """Renders, and with ``keep`` keeps what ``backward`` needs. All tensors are contiguous."""

    def backward(
        self, inputs: Inputs, cotangents: tuple[Tensor | None, Tensor | None, Tensor | None], needed: PerInput
    ) -> PerInput:
        """Gradients, None where not ``needed``, from those of colour, alpha and distortion."""
        ...


def contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.detach().contiguous()


def channel_count(tensor: Tensor | None) -> int:
    return 0 if tensor is None else tensor.shape[-1]


def _empty(device: torch.device, *shape: int) -> Tensor:
    return empty_image(*shape) if device.type == "cpu" else torch.empty(shape, device=device)
