"""The only place that adds or removes primitives.

An edit is a plan (which rows come from which) carried out on everything that has a row per vertex or per face: the
parameters, Adam's two moments, and statistics. None of them can be forgotten, because all go through `_carry`.
"""

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from etsplat.geometry.subdivision import SubdivisionPlan
from etsplat.ops.adam import Adam


def apply_subdivision(
    plan: SubdivisionPlan,
    adam: Adam,
    *,
    per_vertex: Sequence[str],
    per_face: Sequence[str],
    statistics: Mapping[str, Tensor] | None = None,
) -> dict[str, Tensor]:
    """Subdivides: midpoints get the mean of their edge's two ends, child faces a copy of their parent.

    This holds for parameter values and both Adam moments alike. The step count, and parameters that are not named
    (sigma), stay as they are. An empty plan changes no value.

    Args:
        plan: from `longest_edge_plan`.
        adam: the optimizer; its parameters and moments are replaced in place.
        per_vertex: names of the parameters and statistics with one row per vertex.
        per_face: names of those with one row per face.
        statistics: tensors that are not parameters but have rows too, such as gradient sums.

    Returns:
        The new tensor of each name: leaf tensors with the old requires_grad for parameters, plain ones for statistics.

    Raises:
        ValueError: a name is unknown, given twice, or its tensor does not have the plan's number of rows. Nothing has
            been changed then.
    """
    carry = dict.fromkeys(per_vertex, plan.interpolate) | dict.fromkeys(per_face, plan.inherit)
    rows = dict.fromkeys(per_vertex, plan.num_vertices) | dict.fromkeys(per_face, plan.num_faces)
    statistics = statistics or {}
    if len(carry) != len(per_vertex) + len(per_face):
        raise ValueError(f"per_vertex and per_face must name each tensor once, got {[*per_vertex, *per_face]}")
    for name, count in rows.items():
        tensor = adam.parameters.get(name, statistics.get(name))
        if tensor is None:
            raise ValueError(f"per_vertex and per_face must name parameters or statistics, got {name!r}")
        if tensor.ndim == 0 or len(tensor) != count:
            raise ValueError(f"{name} must have {count} rows as the plan, got shape {tuple(tensor.shape)}")
    if missing := set(statistics) - set(carry):
        raise ValueError(f"per_vertex or per_face must name every statistic, got none of {sorted(missing)}")
    return {name: _carry(name, move, adam, statistics) for name, move in carry.items()}


@torch.no_grad()
def _carry(name: str, move: Callable[[Tensor], Tensor], adam: Adam, statistics: Mapping[str, Tensor]) -> Tensor:
    if name in statistics:
        return move(statistics[name])
    old = adam.parameters[name]
    new = move(old.detach()).requires_grad_(old.requires_grad)
    adam.replace(name, new, move(adam.first_moments[name]), move(adam.second_moments[name]))
    return new
