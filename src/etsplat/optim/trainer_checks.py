"""What a trainer refuses before it begins."""

from collections.abc import Mapping
from typing import Any

import torch

from etsplat.core.validation import check_kind, shown
from etsplat.data.dataset import Dataset
from etsplat.model.model import Model
from etsplat.optim.objective import Objective
from etsplat.optim.strategies import Strategy


def check_parts(
    model: Model,
    dataset: Dataset,
    objective: Objective,
    strategy: Strategy | None,
    paces: Mapping[str, Any],
) -> None:
    """Raises ValueError, naming the argument, for what no run can be made of; arguments are those of `Trainer`."""
    check_kind("dataset", dataset, Dataset, "etsplat.load_dataset(path) reads one")
    if not dataset.train:
        raise ValueError("dataset: has no view in `train` to fit to")
    check_kind("objective", objective, Objective, "Objective(photometric)")
    if strategy is not None:
        check_kind("strategy", strategy, Strategy, "make one, such as etsplat.Fixed()")
    parameters = model.parameters()
    for name, parameter in parameters.items():
        if parameter.dtype != torch.float32:
            raise ValueError(f"model must be float32, as cameras of data sets are, got {name} in {parameter.dtype}")
    if unknown := sorted(set(paces) - set(parameters)):
        raise ValueError(f"paces name {', '.join(unknown)}; the model has {', '.join(parameters)}")


def check_callbacks(callbacks: object) -> None:
    """Raises ValueError for one function in the place of several."""
    if callable(callbacks):
        raise ValueError(f"callbacks must be a sequence of functions, got {shown(callbacks)}: pass [callback]")
