"""What can be fitted to photos: the trainer, the objectives and the scorer know a model by this alone."""

from collections.abc import Mapping
from copy import copy
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import Rasterization
from etsplat.core.validation import check_kind, check_place, check_shape

Depth = Literal["plane", "centroid"]
Backgrounds = Float[Tensor, "3"] | Float[Tensor, "B 3"]
A = TypeVar("A", bound="Appearance")


class Appearance:
    """How the numbers of a model become pictures: a frozen dataclass over this class, which has nothing that changes.

    Those of its values that may change at every step are its `numbers`.
    """

    @property
    def numbers(self) -> tuple[float, ...]:
        """Those values."""
        return ()

    @property
    def needs_host(self) -> bool:
        """Whether drawing waits for the host, so that steps cannot be queued on a device."""
        return False

    @property
    def structure(self: A) -> A:
        """All but the numbers: what changes the kernels that are launched, and so seldom. Comparable."""
        return self

    @property
    def whole(self: A) -> A:
        """The same with all that single steps leave out by chance: what is looked at between steps."""
        return self

    def on_device(self: A, numbers: Float[Tensor, " K"]) -> A:
        """The same with its `numbers` read from device memory, for steps that the host does not look at."""
        return self


M = TypeVar("M", bound="Model")
K = TypeVar("K", bound="Model")


def model_for(user: object, model: Any, kind: type[K]) -> K:
    """The model. Raises ValueError, naming whoever has a use for one kind alone, where it is of another."""
    if not isinstance(model, kind):
        raise ValueError(f"{type(user).__name__} needs a {kind.__name__}, got a {type(model).__name__}")
    return model


class Model(Protocol):
    """Learnable triangles. One of your own is a class over this one, with its parameters as attributes.

    Attributes:
        appearance: how they are drawn, in training and ever after.
        RATES: Adam's learning rate of each parameter where nobody says otherwise, for a model of about unit size.
        OPAQUE: what its picture is called where a mesh viewer draws it.
        COLORED: of a model that calls `soup_colors` once for a view: the parameters that it hands over, in their order.
            Such a model uses each of its parameters but once otherwise for the colours of a view: workers rely on it.
            None for any other.
    """

    appearance: Any
    RATES: ClassVar[Mapping[str, float]]
    OPAQUE: ClassVar[str]
    COLORED: ClassVar[tuple[str, str, str] | None] = None

    @property
    def count(self) -> int:
        """Number of triangles."""
        ...

    def parameters(self) -> dict[str, Tensor]:
        """The learnable tensors by name, in the order of `RATES`; those that are None are not."""
        found = {name: getattr(self, name) for name in self.RATES}
        return {name: parameter for name, parameter in found.items() if parameter is not None}

    @property
    def rates(self) -> dict[str, float]:
        """`RATES` of the parameters that it has, by name."""
        return {name: self.RATES[name] for name in self.parameters()}

    def learnable(self: M) -> M:
        """This one, with parameters that require gradients.

        Raises:
            ValueError: they were made within `torch.inference_mode`.
        """
        for name, parameter in self.parameters().items():
            if parameter.is_inference():
                raise ValueError(
                    f"{name}: was made within torch.inference_mode(), whose tensors learn nothing; make the model"
                    " outside of it, or within torch.no_grad()"
                )
            parameter.requires_grad_(True)
        return self

    def render(
        self,
        cameras: Cameras,
        *,
        backgrounds: Backgrounds | None = None,
        outputs: tuple[str, ...] = ("color",),
        depth_of: Depth = "plane",
    ) -> Rasterization:
        """Pictures of B cameras, differentiable; all else as in `etsplat.rasterize`."""
        ...

    def render_opaque(self, cameras: Cameras, *, supersampling: int = 4) -> Float[Tensor, "B H W 4"]:
        """What a mesh viewer shows: opaque triangles with a z-buffer, premultiplied RGBA, detached."""
        ...

    def surface(self) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
        """Vertices and faces of what a mesh viewer shows, detached, on the CPU."""
        ...

    def describe(self) -> dict[str, float]:
        """A few numbers for the log, by name. Changes nothing."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Every tensor that the model consists of, detached, by name, for a checkpoint.

        They share memory with the model: what is kept while it learns is to be cloned.
        """
        return {name: parameter.detach() for name, parameter in self.parameters().items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Takes these tensors, not copies, in the place of its own, onto its device; those not named stay.

        An optimizer of one's own knows the tensors before, and is to be made anew.

        Raises:
            ValueError: a name that the model does not have, or a tensor that does not fit it or the others; nothing is
                changed then.
        """
        self._check_state(state)
        self._take(state)

    def _take(self, state: Mapping[str, Tensor]) -> None:
        """As `load_state`, of what fits; what else can be wrong with it is raised before anything is changed."""
        for name, old in self.parameters().items():
            if name in state:
                setattr(self, name, state[name].to(old.device).requires_grad_(old.requires_grad))

    def _rows(self, state: Mapping[str, Tensor]) -> Mapping[str, int]:
        """How many rows each tensor has to have once this state is loaded, of those that depend on each other."""
        return {}

    def _check_state(self, state: Mapping[str, Tensor]) -> None:
        check_kind("state", state, Mapping, "a dict of tensors by name, as state() returns")
        own = self.state()
        if unknown := sorted(set(state) - set(own)):
            raise ValueError(f"state must name some of {', '.join(own)}, got {', '.join(unknown)}")
        for name, given in state.items():
            check_shape(f"state[{name}]", given, ("rows", *own[name].shape[1:]) if own[name].ndim else ())
            if given.dtype != own[name].dtype and own[name].is_floating_point():
                raise ValueError(f"state[{name}] must be {own[name].dtype} as the model, got {given.dtype}")
        for name, rows in self._rows(state).items():
            if (got := len(state.get(name, own[name]))) != rows:
                raise ValueError(f"state[{name}] must have {rows} rows beside the others, got {got}: load all together")

    def to(self: M, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> M:
        """The same on another device or in another precision, in leaf tensors of its own.

        Raises:
            ValueError: `device` is a dtype.
        """
        check_place(device)
        moved = copy(self)
        for name, parameter in self.parameters().items():
            tensor = parameter.detach().to(device=device, dtype=dtype)
            setattr(moved, name, tensor.requires_grad_(parameter.requires_grad))
        return moved

    def save(self, path: Path | str) -> None:
        """Writes a file, atomically; the suffix is its kind."""
        ...
