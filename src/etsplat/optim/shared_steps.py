"""A step that several workers make together: each draws and differentiates some of its views; all add them up alike.

What a view gives is a message of its own: its loss, its gradients, and what the strategy looks at. Of each tensor only
the rows travel that have a bit that is not zero. All workers add up the messages in the order of the views, which is
what one process does with its own: `Tensor.grad` of one view, plus that of the next. A message travels while its
worker draws its next view.

What all can compute for themselves does not travel. Of harmonics it is the gradient of the view's colours that does,
and each carries it on to the coefficients. Terms that depend on the parameters alone are added by each. Within a view
autograd adds these first, then what comes from the picture, then what comes from the colours; so is it done here.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from etsplat.core.rasterization import Rasterization, TriangleStatistics
from etsplat.core.workers import Workers
from etsplat.ops.adam import Adam
from etsplat.ops.soup_colors import EndAtColors, colors_backward

Gradients = Callable[[range], tuple[Tensor, list[Rasterization]]]
"""Of the views at these places of a step: leaves their gradients in the parameters, and returns the loss and what was
seen of each."""

_COLORS, _CENTER, _DEGREE = "colors", "center", "degree"
_WHICH = "?"
"""After the name of a tensor: of which rows it is, a bit for each, and how many there are."""


@dataclass(frozen=True)
class Apart:
    """What every worker computes of a step for itself.

    Attributes:
        colored: of the first optimizer's parameters those that `soup_colors` gets.
        of_parameters: leaves in the parameters the gradients of terms that depend on them alone; None where these are
            in what the last view gives.
    """

    colored: tuple[str, str, str]
    of_parameters: Callable[[], None] | None


def owners(views: Sequence[int], count: int) -> list[int]:
    """Which of `count` workers differentiates each view of a step.

    A photo belongs to one worker, which so need not read the others' as long as the views of a step are spread; what
    is more than an equal share goes to those that have least.
    """
    share, loads = -(-len(views) // count), [0] * count
    chosen: list[int | None] = []
    for view in views:
        home = view % count
        chosen.append(home if loads[home] < share else None)
        loads[home] += loads[home] < share
    for place, owner in enumerate(chosen):
        if owner is None:
            chosen[place] = least = min(range(count), key=loads.__getitem__)
            loads[least] += 1
    return [owner for owner in chosen if owner is not None]


def shared_gradients(
    group: Workers,
    views: Sequence[int],
    gradients: Gradients,
    optimizers: Sequence[Adam],
    observed: Sequence[str],
    apart: Apart | None = None,
) -> tuple[Tensor, list[Rasterization]]:
    """The gradients of a step, added up in the order of its views, in the parameters of every worker.

    Args:
        group: who shares the step.
        views: of the step.
        gradients: of some of them.
        optimizers: whose parameters have gradients.
        observed: what is to be handed on of each rendering, as of `etsplat.rasterize`.
        apart: what need not be handed on; None for nothing.

    Returns:
        The loss of the step, and of each view in their order what was seen, with `observed` and no more.
    """
    if group.count == 1:
        return gradients(range(len(views)))
    named = {f"{number}.{name}": (each, name) for number, each in enumerate(optimizers) for name in each.parameters}
    colored = [] if apart is None else [optimizers[0].parameters[name] for name in apart.colored]

    def draw(place: int) -> Tensor:
        with EndAtColors(*colored) if colored else contextlib.nullcontext() as ending:
            loss, (seen,) = gradients(range(place, place + 1))
        found = {f"gradient.{key}": each.parameters[name].grad for key, (each, name) in named.items()}
        found |= {"loss": loss, **_observed(seen, observed), **_colors(ending)}
        return pack({key: tensor for key, tensor in found.items() if tensor is not None})

    losses, seen, sums = [], [], _Sums({key: each.parameters[name] for key, (each, name) in named.items()})
    for place, message in enumerate(group.hand_round(draw, owners(views, group.count))):
        tensors = unpack(message)
        device = next(iter(sums.parameters.values())).device
        tensors = {key: tensor.to(device) for key, tensor in tensors.items()}
        parts = [{key.removeprefix("gradient."): t for key, t in tensors.items() if key.startswith("gradient.")}]
        if apart is not None and apart.of_parameters is not None and place == len(views) - 1:
            parts.insert(0, sums.left_by(apart.of_parameters))
        if apart is not None:
            vertices, dc, rest = colored
            center, degree = tensors[_CENTER], int(tensors[_DEGREE])
            by_colors = colors_backward(tensors[_COLORS][None], vertices, dc, rest, center, degree)
            parts.append({f"0.{name}": tensor for name, tensor in zip(apart.colored, by_colors, strict=True)})
        sums.add(parts)
        losses.append(tensors["loss"])
        seen.append(_rendering(tensors))
    sums.leave()
    return sum(losses[1:], start=losses[0]), seen


class _Sums:
    """Gradients of parameters, added up as autograd does: within a view first, then to those of the views before."""

    def __init__(self, parameters: Mapping[str, Tensor]) -> None:
        self.parameters, self._sums = parameters, dict[str, Tensor]()

    def add(self, parts: Sequence[Mapping[str, Tensor]]) -> None:
        """What a view gives, in parts, which are given away."""
        for key in self.parameters:
            found = [part[key] for part in parts if key in part]
            for other in found[1:]:
                found[0].add_(other)
            if found:
                self._sums[key] = self._sums[key].add_(found[0]) if key in self._sums else found[0]

    def left_by(self, backward: Callable[[], None]) -> dict[str, Tensor]:
        """The gradients that something leaves in the parameters."""
        self._set({})
        backward()
        return {key: parameter.grad for key, parameter in self.parameters.items() if parameter.grad is not None}

    def leave(self) -> None:
        """Puts the sums where autograd leaves them."""
        self._set(self._sums)

    def _set(self, gradients: Mapping[str, Tensor]) -> None:
        for key, parameter in self.parameters.items():
            parameter.grad = gradients.get(key)


def pack(tensors: dict[str, Tensor]) -> Tensor:
    """A message: (K,) uint8 on the CPU, of tensors by name."""
    return torch.frombuffer(bytearray(safetensors.torch.save(dict(_rows(tensors)))), dtype=torch.uint8)


def unpack(message: Tensor) -> dict[str, Tensor]:
    """The tensors of a message, to the bit, on the CPU."""
    found = safetensors.torch.load(message.numpy().tobytes())
    tensors = {}
    for name, rows in found.items():
        if name.endswith(_WHICH):
            continue
        which = found.get(f"{name}{_WHICH}")
        if which is None:
            tensors[name] = rows
            continue
        count = int.from_bytes(which[:8].numpy().tobytes(), "little")
        kept = torch.from_numpy(np.unpackbits(which[8:].numpy(), count=count).astype(bool))
        whole = torch.zeros((count, *rows.shape[1:]), dtype=rows.dtype)
        whole[kept] = rows
        tensors[name] = whole
    return tensors


def _rows(tensors: dict[str, Tensor]) -> Iterator[tuple[str, Tensor]]:
    """Of each tensor those rows that are not all zero, and which they are, where that is less than all."""
    for name, tensor in tensors.items():
        whole = tensor.detach().cpu().contiguous()
        if whole.dim() == 0 or whole.numel() == 0:
            yield name, whole
            continue
        kept = (whole.reshape(len(whole), -1).view(torch.uint8) != 0).any(dim=1)
        yield name, whole[kept]
        bits = np.packbits(kept.numpy())
        yield f"{name}{_WHICH}", torch.from_numpy(np.concatenate([_length(len(whole)), bits]))


def _length(count: int) -> Any:
    return np.frombuffer(count.to_bytes(8, "little"), dtype=np.uint8)


def _colors(ending: EndAtColors | None) -> dict[str, Tensor]:
    """The gradient of a view's colours, and what leads on from there."""
    if ending is None:
        return {}
    if ending.colors is None or ending.colors.grad is None:
        raise RuntimeError("a model with COLORED drew a view without soup_colors")
    if ending.again:
        raise RuntimeError("colours of one view were made twice")
    return {_COLORS: ending.colors.grad[0], _CENTER: ending.centers, _DEGREE: torch.tensor(ending.degree)}


def _observed(seen: Rasterization, names: Sequence[str]) -> dict[str, Tensor]:
    """Transposed, so that a row is a triangle where there is one view."""
    found: dict[str, Tensor] = {}
    for name in names:
        value = getattr(seen, name)
        if is_dataclass(value):
            found |= {f"seen.{name}.{entry.name}": getattr(value, entry.name)[0] for entry in fields(value)}
        elif value is not None:
            found[f"seen.{name}"] = value[0]
    return found


def _rendering(tensors: dict[str, Tensor]) -> Rasterization:
    """What was seen of a view; of colour and opacity, which are always there, nothing unless it was handed on."""
    seen = {key.removeprefix("seen."): tensor[None] for key, tensor in tensors.items() if key.startswith("seen.")}
    parts = {key.partition(".")[2]: value for key, value in seen.items() if "." in key}
    nothing = tensors["loss"].new_zeros((1, 0, 0, 0))
    images = {"color": nothing, "alpha": nothing, **{key: value for key, value in seen.items() if "." not in key}}
    return Rasterization(**images, statistics=TriangleStatistics(**parts) if parts else None)
