"""What an engine is: one method for each operation of `etsplat.ops`, which has checked the arguments."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Protocol

import torch
from torch import Tensor

from etsplat.core.rasterization import TriangleStatistics
from etsplat.engines.reference.adam import AdamGroup, adam_step
from etsplat.engines.reference.antialias import antialias
from etsplat.engines.reference.mesh_energies import mesh_energies
from etsplat.engines.reference.normal_consistency import normal_consistency
from etsplat.engines.reference.photometric import photometric_loss
from etsplat.engines.reference.pick_values import pick_values
from etsplat.engines.reference.rasterize import rasterize
from etsplat.engines.reference.rasterize_opaque import rasterize_opaque, render_opaque
from etsplat.engines.reference.soup_activation import soup_activation
from etsplat.engines.reference.soup_statistics import update_statistics
from etsplat.engines.reference.spherical_harmonics import soup_colors, spherical_harmonics
from etsplat.engines.reference.triangle_area import mean_area
from etsplat.engines.reference.triangle_channels import triangle_channels
from etsplat.engines.reference.weighted_sum import weighted_sum


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


class Engine:
    """The engine "reference": plain PyTorch, on any device, in any precision; gradients by autograd.

    Others inherit from it what they have no code of their own for. Tensors come as the public functions describe them,
    on one device and in one precision, but not always contiguous. Results are differentiable wherever the public
    function says so. Operations are static: an engine has no state but what its device has.

    Attributes:
        name: by which it is chosen: `with etsplat.engine(name)`.
        device: type of the devices on which it is chosen by itself, for float32; None if it never is.
        queued: how steps are queued on it, None where each step returns to the host.
    """

    name: str = "reference"
    device: str | None = None
    queued: QueuedSteps | None = None

    @property
    def queues_steps(self) -> bool:
        """Whether steps can run one after the other without the host looking in between."""
        return self.queued is not None

    def check(self, tensor: Tensor) -> None:
        """Raises ValueError where it does not compute with tensors of this device or dtype."""

    def home(self) -> torch.device:
        """Where a task puts its tensors if nobody says where.

        Raises:
            EngineUnavailableError: It cannot run here.
        """
        return torch.device("cpu")

    def looping(self) -> AbstractContextManager[None]:
        """What a loop of steps runs in."""
        return nullcontext()

    adam_step = staticmethod(adam_step)
    antialias = staticmethod(antialias)
    mean_area = staticmethod(mean_area)
    mesh_energies = staticmethod(mesh_energies)
    normal_consistency = staticmethod(normal_consistency)
    photometric_loss = staticmethod(photometric_loss)
    pick_values = staticmethod(pick_values)
    rasterize = staticmethod(rasterize)
    rasterize_opaque = staticmethod(rasterize_opaque)
    render_opaque = staticmethod(render_opaque)
    soup_activation = staticmethod(soup_activation)
    soup_colors = staticmethod(soup_colors)
    spherical_harmonics = staticmethod(spherical_harmonics)
    triangle_channels = staticmethod(triangle_channels)
    update_statistics = staticmethod(update_statistics)
    weighted_sum = staticmethod(weighted_sum)
