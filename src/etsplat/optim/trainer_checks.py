"""What a trainer refuses before it begins, and what it makes of its arguments."""

import warnings
from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path
from types import FunctionType
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from etsplat.core.validation import check_kind, check_number, shown, whole_number
from etsplat.core.workers import workers
from etsplat.data.dataset import Dataset
from etsplat.data.doubtful_poses import doubts
from etsplat.io.run_directory import RunDirectory
from etsplat.model.model import Model
from etsplat.ops.adam import Adam
from etsplat.optim.loop import Callback, NoteEvent
from etsplat.optim.objective import Objective, check_asked
from etsplat.optim.strategies import Strategy

USUAL_EXTENT = (0.5, 50.0)
"""Extents of the scenes that absolute rates were made for, generously."""


def check_parts(
    model: Model,
    dataset: Dataset,
    objective: Objective,
    strategy: Strategy | None,
    others: Mapping[str, tuple[object, type]],
    paces: Mapping[str, Any],
) -> None:
    """Raises ValueError, naming the argument, for what no run can be made of; arguments are those of `Trainer`.

    Of the `others`, by name, a value may be None or of its kind.
    """
    if Model not in type(model).__mro__:  # a protocol, which isinstance would compare by its names
        raise ValueError(f"model must be a model, such as etsplat.TriangleMesh, got {shown(model)}")
    check_kind("dataset", dataset, Dataset, "etsplat.load_dataset(path) reads one")
    if not dataset.train:
        raise ValueError("dataset: has no view in `train` to fit to")
    check_kind("objective", objective, Objective, "Objective(photometric)")
    if strategy is not None:
        check_kind("strategy", strategy, Strategy, "make one, such as etsplat.Fixed()")
        check_asked("strategy", strategy.outputs)
        if not callable(strategy.state):
            raise ValueError(
                f"strategy.state must be a method that returns tensors by name, got {shown(strategy.state)}"
            )
    for name, (value, kind) in others.items():
        if value is not None:
            check_kind(name, value, kind, f"etsplat.{kind.__name__} makes one")
    parameters = model.parameters()
    for name, parameter in parameters.items():
        if parameter.dtype != torch.float32:
            raise ValueError(f"model must be float32, as cameras of data sets are, got {name} in {parameter.dtype}")
    learned = [name for name, parameter in parameters.items() if parameter.requires_grad]
    if learned and (frozen := [name for name in parameters if name not in learned]):
        raise ValueError(
            f"model requires gradients of {', '.join(learned)}, and none of {', '.join(frozen)}: model.learnable() "
            "learns all; what is to stay as it is gets the rate 0 in schedule.rates"
        )
    if unknown := sorted(set(paces) - set(parameters)):
        raise ValueError(f"paces name {', '.join(unknown)}; the model has {', '.join(parameters)}")


def doubts_before(dataset: Dataset, *, own_rates: bool) -> tuple[str, ...]:
    """What a run would go on with, and learn little by, a sentence each.

    Args:
        dataset: of the run.
        own_rates: whether nobody has chosen the rates, which are absolute.
    """
    low, high = USUAL_EXTENT
    if not own_rates or dataset.extent == 0 or low <= dataset.extent <= high:
        return doubts(dataset)
    return (
        *doubts(dataset),
        f"the cameras are spread over {dataset.extent:.4g} units, and the model's own rates are made for {low:g} to "
        f"{high:g}: dataset.normalized() moves a scene, dataset.renormalized(*etsplat.bounding_sphere(dataset)) an "
        "object with outlines; or choose rates in schedule",
    )


def plain_settings(part: object, depth: int = 4) -> object:
    """Of parts of a run their numbers and texts, also within so many collections and objects in each other.

    Of functions their names; of all else, and of what lies deeper, the name of its kind.
    """
    if part is None or isinstance(part, bool | int | float | str):
        return part
    name = type(part).__name__
    if isinstance(part, FunctionType | type):
        return part.__qualname__
    if depth == 0 or isinstance(part, Tensor):
        return name
    if isinstance(part, Set):
        return sorted(map(str, part))
    if isinstance(part, list | tuple):
        return [plain_settings(value, depth - 1) for value in part]
    held = part if isinstance(part, Mapping) else getattr(part, "__dict__", {})
    return [name, *sorted([str(key), plain_settings(value, depth - 1)] for key, value in held.items())]


def tell(sentences: Iterable[str], callbacks: Sequence[Callback], below: int = 0) -> None:
    """Tells all callbacks; where there are none, Python's warnings, so many calls below `fit`."""
    for sentence in sentences:
        for callback in callbacks:
            callback(NoteEvent(sentence))
        if not callbacks:
            warnings.warn(sentence, stacklevel=4 + below)  # of who calls `fit`, which is decorated


def tell_of_going_on(
    run: RunDirectory | Path | str | None, callbacks: Sequence[Callback], iteration: int, iterations: int
) -> None:
    """Tells that a run goes on from its checkpoint; where nobody listens, if that leaves no step to make.

    Args:
        run: as handed in by the caller of `fit`; a task, which hands in a `RunDirectory`, has told by itself.
        callbacks: who is told.
        iteration: of the checkpoint.
        iterations: length of the run.
    """
    done = iteration >= iterations
    if isinstance(run, RunDirectory) or not workers().leads or not (callbacks or done):
        return
    taken = "the model becomes that of its checkpoint"
    left = (
        f"has {iteration:,} of {iterations:,} iterations, and none is made" if done else f"goes on after {iteration:,}"
    )
    tell([f"run {run}: {left}; {taken}{'; another folder begins anew' if done else ''}"], callbacks, below=2)


def checked_background(background: Sequence[float] | Tensor | None) -> list[float] | None:
    """Of `Trainer`, as floats. Raises ValueError where it is no colour."""
    if background is None:
        return None
    wanted = "background must be three numbers from 0 to 1, or None"
    if isinstance(background, str) or not isinstance(background, Iterable):
        raise ValueError(f"{wanted}, got {shown(background)}")
    channels = list(background)
    for index, channel in enumerate(channels):
        check_number(f"background[{index}]", channel, 0, 1)
    if len(channels) != 3:
        raise ValueError(f"{wanted}, got {len(channels)} of them")
    return [float(channel) for channel in channels]


def generator_of(seed: object) -> torch.Generator:
    """What all random choices are taken from. Raises ValueError where there is neither a seed nor a generator."""
    if isinstance(seed, torch.Generator):
        return seed
    number = whole_number(seed)
    if number is None:
        raise ValueError(f"seed must be an integer or a torch.Generator, got {shown(seed)}")
    return torch.Generator().manual_seed(number)


def checked_metrics(found: object) -> dict[str, Any]:
    """What `evaluate` returned, its numbers as those of Python, which a run can keep. Raises ValueError for others."""
    if not isinstance(found, Mapping):
        raise ValueError(f"evaluate must return numbers by name, got {shown(found)}")
    metrics = {
        name: value.item() if isinstance(value, Tensor | np.ndarray | np.generic) and value.ndim == 0 else value
        for name, value in found.items()
    }
    for name, value in metrics.items():
        if value is not None and not isinstance(value, int | float):
            raise ValueError(f"evaluate must return numbers by name, got {shown(value)} for {name!r}")
    return metrics


def check_callbacks(callbacks: object) -> None:
    """Raises ValueError where they are no functions, or one in the place of several."""
    if callable(callbacks):
        raise ValueError(f"callbacks must be a sequence of functions, got {shown(callbacks)}: pass [callback]")
    if not isinstance(callbacks, Sequence):
        raise ValueError(f"callbacks must be a sequence of functions, got {shown(callbacks)}")
    for index, callback in enumerate(callbacks):
        if not callable(callback):
            raise ValueError(f"callbacks[{index}] must be a function of an event, got {shown(callback)}")


def check_unreplaced(model: Model, adam: Adam) -> None:
    """Raises ValueError where tensors of the model are no longer those that its optimizer moves."""
    if apart := [name for name, tensor in model.parameters().items() if adam.parameters.get(name) is not tensor]:
        raise ValueError(
            f"model: {', '.join(apart)} were replaced since this Trainer was made, by load_state, another Trainer or an"
            " assignment: make a Trainer anew, or change values in place, within torch.no_grad()"
        )


def check_edited(
    strategy: Strategy, iteration: int, edited: bool, before: Mapping[str, Tensor], model: Model, adam: Adam
) -> None:
    """Raises ValueError where an edit replaced tensors, as they were `before`, of one of both, or did not say so."""
    who, after = type(strategy).__name__, model.parameters()
    if apart := [name for name, tensor in after.items() if adam.parameters[name] is not tensor]:
        raise ValueError(
            f"{who} replaced {', '.join(apart)} of the model or of its optimizer at iteration {iteration}, and not of "
            "both: edit by etsplat.apply_rows, and give the first that it returns to model.load_state"
        )
    if not edited and any(tensor is not before.get(name) for name, tensor in after.items()):
        got = shown(edited)
        raise ValueError(f"{who} replaced tensors at iteration {iteration}, and returned {got}: edit is to return True")


def state_of(strategy: Strategy) -> Mapping[str, Tensor]:
    """Its state. Raises ValueError where a checkpoint cannot hold it."""
    found: object = strategy.state()
    values = list(found.values()) if isinstance(found, Mapping) else [found]
    if wrong := [value for value in values if not isinstance(value, Tensor)]:
        raise ValueError(f"{type(strategy).__name__}.state must return tensors by name, got {shown(wrong[0])}")
    return cast(Mapping[str, Tensor], found)
