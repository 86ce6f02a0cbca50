"""What an engine is: one method for each operation of `etsplat.ops`, which has checked the arguments.

Tensors come as the public functions describe them, on one device and in one precision, but not always contiguous.
Results are differentiable wherever the public function says so. Operations are static: an engine has no state but what
its device has.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

import torch
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.connectivity import MeshConnectivity
from etsplat.core.rasterization import (
    OpaqueView,
    Rasterization,
    RasterizeSettings,
    RasterizeTensors,
    TriangleStatistics,
)

AdamGroup = tuple[Tensor, Tensor, Tensor, Tensor]
"""A parameter, its gradient and both moments, contiguous."""


def step_rates(learning_rates: Sequence[float], betas: tuple[float, float], step_count: int) -> list[float]:
    """The step size of each parameter, lr / (1 - beta1^t), then sqrt(1 - beta2^t)."""
    first, second = (1 - beta**step_count for beta in betas)
    return [*(rate / first for rate in learning_rates), second**0.5]


class Engine(Protocol):
    """One way to compute every operation.

    Attributes:
        name: by which it is chosen: `with etsplat.engine(name)`.
        device: type of the devices on which it is chosen by itself, for float32; None if it never is.
        queued: how steps are queued on it, None where each step returns to the host.
    """

    name: str
    device: str | None
    queued: "QueuedSteps | None"

    @property
    def queues_steps(self) -> bool:
        """Whether steps can run one after the other without the host looking in between."""
        return self.queued is not None

    def check(self, tensor: Tensor) -> None:
        """Raises ValueError where it does not compute with tensors of this device or dtype."""
        ...

    def home(self) -> torch.device:
        """Where a task puts its tensors if nobody says where.

        Raises:
            EngineUnavailableError: It cannot run here.
        """
        ...

    def looping(self) -> AbstractContextManager[None]:
        """What a loop of steps runs in."""
        ...

    # Pictures

    @staticmethod
    def rasterize(tensors: RasterizeTensors, settings: RasterizeSettings) -> Rasterization:
        """See `etsplat.rasterize`."""
        ...

    @staticmethod
    def rasterize_opaque(
        points: Tensor,
        triangles: Tensor,
        view: OpaqueView,
        triangle: Tensor,
        barycentrics: Tensor,
        depth: Tensor,
    ) -> None:
        """Fill the three images of one view: contiguous points (V, 3) and int32 triangles (F, 3)."""
        ...

    @staticmethod
    def render_opaque(
        points: Tensor,
        triangles: Tensor,
        view: OpaqueView,
        colors: Tensor,
        per_face: bool,
        supersampling: int,
        cull_backfaces: bool,
        image: Tensor,
    ) -> None:
        """Fill the image (H, W, C + 1) of one view; colours are contiguous."""
        ...

    @staticmethod
    def antialias(
        vertices: Tensor,
        colors: Tensor,
        backgrounds: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        triangle: Tensor,
        barycentrics: Tensor,
        depth: Tensor,
        near_plane: float,
        per_face: bool,
        connectivity: MeshConnectivity,
    ) -> Tensor:
        """Shade and blend what `rasterize_opaque` has seen: (B, H, W, C)."""
        ...

    # What pictures are made of

    @staticmethod
    def soup_activation(
        vertices: Tensor,
        opacity_logits: Tensor,
        sigma_raw: Tensor,
        limits: tuple[float, float] | Tensor,
        camera: Cameras | None,
        smallest: float,
        largest: float,
    ) -> tuple[Tensor, Tensor]:
        """See `etsplat.ops.soup_activation`."""
        ...

    @staticmethod
    def soup_colors(vertices: Tensor, sh_dc: Tensor, sh_rest: Tensor, centers: Tensor, degree: int) -> Tensor:
        """See `etsplat.ops.soup_colors`."""
        ...

    @staticmethod
    def spherical_harmonics(coefficients: Tensor, directions: Tensor, degree: int) -> Tensor:
        """See `etsplat.ops.spherical_harmonics`."""
        ...

    @staticmethod
    def triangle_channels(corners: Tensor, viewmats: Tensor, depth: bool, normals: bool) -> Tensor:
        """See `etsplat.ops.triangle_channels`."""
        ...

    @staticmethod
    def pick_values(values: Tensor, chosen: Tensor) -> Tensor:
        """See `etsplat.ops.pick_values`."""
        ...

    # What is minimised

    @staticmethod
    def photometric_loss(
        color: Tensor,
        target: Tensor,
        mask: Tensor | None,
        backgrounds: Tensor | None,
        dssim_weight: float,
        squared: bool,
    ) -> Tensor:
        """See `etsplat.ops.photometric`."""
        ...

    @staticmethod
    def mesh_energies(
        vertices: Tensor, connectivity: MeshConnectivity, edge_power: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """L_e, L_n and L_lap of `etsplat.ops.mesh_energies`."""
        ...

    @staticmethod
    def normal_consistency(normals: Tensor, depth: Tensor, alpha: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
        """See `etsplat.ops.normal_consistency`."""
        ...

    @staticmethod
    def mean_area(vertices: Tensor) -> Tensor:
        """See `etsplat.ops.triangle_area`."""
        ...

    @staticmethod
    def weighted_sum(
        first: Tensor,
        values: Sequence[Tensor],
        weights: Sequence[float],
        powers: Sequence[int],
        scale: float | Tensor,
    ) -> Tensor:
        """See `etsplat.ops.weighted_sum`; at least one value."""
        ...

    # Steps

    @staticmethod
    def adam_step(
        groups: Sequence[AdamGroup],
        learning_rates: Sequence[float],
        betas: tuple[float, float],
        eps: float,
        step_count: int,
    ) -> None:
        """Update the parameters and their moments in place; see `etsplat.ops.adam`."""
        ...

    @staticmethod
    def update_statistics(records: Sequence[Tensor], view: TriangleStatistics, views: int, epoch_starts: bool) -> None:
        """Update the records in place; see `etsplat.ops.soup_statistics`."""
        ...


class QueuedSteps(Protocol):
    """Steps that a device repeats by itself; what changes from one to the next is read from its memory.

    `halted` is () int32 in device memory: where it is not 0, nothing is updated.
    """

    def memory_pool(self) -> Any:
        """Memory that steps of several kinds can share."""
        ...

    def repeated(self, body: Callable[[], None], pool: Any) -> Callable[[], None]:
        """What queues the work of `body` each time it is called, by and by without calling `body`."""
        ...

    def verdict(self, loss: Tensor, position: Tensor, losses: Tensor, halted: Tensor) -> None:
        """Queue: keep the loss at `position`, move on if the step counts, and halt otherwise."""
        ...

    def repair(self, device: torch.device) -> bool:
        """Whether a step found too little room, which the next ones will have. Waits for the device."""
        ...

    @staticmethod
    def adam_step(
        groups: Sequence[AdamGroup],
        rates: Tensor,
        betas: tuple[float, float],
        eps: float,
        halted: Tensor,
    ) -> None:
        """As `Engine.adam_step`, with `Adam.rates` (P + 1,) float32 in device memory."""
        ...

    @staticmethod
    def update_statistics(
        records: Sequence[Tensor], view: TriangleStatistics, views: int, epoch_starts: Tensor, halted: Tensor
    ) -> None:
        """As `Engine.update_statistics`, with `epoch_starts` (1,) float32 in device memory, 0 or 1."""
        ...
