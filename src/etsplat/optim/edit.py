"""The only place that adds or removes primitives.

An edit is a plan (which rows come from which) carried out on everything that has a row per vertex, per face or per
triangle: the parameters, Adam's two moments, and statistics. None of them can be forgotten, because all go through
`_carry`.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from etsplat.core.validation import check_indices, check_memory, check_shape
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

    Example:
        >>> vertices, faces = etsplat.icosphere(0)
        >>> adam = etsplat.Adam({"vertices": vertices, "colors": torch.ones(20, 3)}, {"vertices": 1e-3, "colors": 1e-2})
        >>> topology = etsplat.MeshTopology.from_faces(faces, len(vertices))
        >>> plan = etsplat.longest_edge_plan(vertices, topology, scores=torch.ones(20), budget_faces=30)
        >>> new = etsplat.apply_subdivision(plan, adam, per_vertex=["vertices"], per_face=["colors"])
        >>> len(new["colors"]), len(adam.first_moments["colors"])
        (30, 30)
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
        check_memory(name, tensor)
        if tensor.ndim == 0 or len(tensor) != count:
            raise ValueError(f"{name} must have {count} rows as the plan, got shape {tuple(tensor.shape)}")
    if missing := set(statistics) - set(carry):
        raise ValueError(f"per_vertex or per_face must name every statistic, got none of {sorted(missing)}")
    return {name: _carry(name, move, move, adam, statistics) for name, move in carry.items()}


@dataclass(frozen=True, eq=False)
class RowPlan:
    """How N separate primitives become M.

    Attributes:
        num_rows: N.
        source: (M,) the old row that each new row is or is made from.
        fresh: (M,) whether the row is made by this edit: it starts with zero moments and statistics.
        values: by name of a parameter, its values in the fresh rows, in their order. The parameters that are not named
            are copied from the source.

    Example:
        >>> plan = etsplat.RowPlan.keeping(torch.tensor([True, False, True]))
        >>> plan.source.tolist()
        [0, 2]
    """

    num_rows: int
    source: Int[Tensor, " M"]
    fresh: Bool[Tensor, " M"]
    values: Mapping[str, Tensor] = field(default_factory=dict)

    @staticmethod
    def keeping(kept: Bool[Tensor, " N"]) -> "RowPlan":
        """The plan that removes all other rows.

        Raises:
            ValueError: another shape or dtype.
        """
        _check_flags_of_rows("kept", kept, "N")
        source = kept.nonzero()[:, 0]
        return RowPlan(len(kept), source, torch.zeros(len(source), dtype=torch.bool, device=kept.device))


def apply_rows(
    plan: RowPlan, adam: Adam, statistics: Mapping[str, Tensor], *, others: Collection[str] = ()
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Adds, removes and reorders primitives. Parameters of `adam` and statistics have a row for each.

    Args:
        plan: which rows there are afterwards.
        adam: the optimizer; its parameters and moments are replaced in place.
        statistics: tensors that are not parameters but have rows too.
        others: parameters that have not; they stay as they are.

    Returns:
        The new parameters (leaf tensors with the old requires_grad) and statistics, by name.

    Raises:
        ValueError: a tensor does not have the plan's number of rows, or values do not fit. Nothing has been changed
            then.

    Example:
        >>> adam = etsplat.Adam({"opacities": torch.tensor([0.9, 0.1, 0.8])}, {"opacities": 0.05})
        >>> plan = etsplat.RowPlan.keeping(adam.parameters["opacities"] > 0.5)
        >>> parameters, statistics = etsplat.apply_rows(plan, adam, {"seen": torch.tensor([7, 0, 3])})
        >>> len(parameters["opacities"]), statistics["seen"].tolist()
        (2, [7, 3])
    """
    check_shape("source", plan.source, ("M",))
    check_indices("source", plan.source, plan.num_rows)
    _check_flags_of_rows("fresh", plan.fresh, len(plan.source))
    having = {name: parameter for name, parameter in adam.parameters.items() if name not in others}
    for name, tensor in [*having.items(), *statistics.items()]:
        check_memory(name, tensor)
        if tensor.ndim == 0 or len(tensor) != plan.num_rows:
            raise ValueError(f"{name} must have {plan.num_rows} rows as the plan, got shape {tuple(tensor.shape)}")
    count = int(plan.fresh.sum())
    for name, values in plan.values.items():
        if name not in having:
            raise ValueError(f"values must name parameters, got {name!r}")
        check_memory(f"values of {name}", values)
        expected = (count, *adam.parameters[name].shape[1:])
        if tuple(values.shape) != expected:
            raise ValueError(f"values of {name} must have shape {expected}, got {tuple(values.shape)}")

    def start_at_zero(tensor: Tensor) -> Tensor:
        moved = tensor[plan.source]
        moved[plan.fresh] = 0
        return moved

    def set_values(name: str) -> Callable[[Tensor], Tensor]:
        def move(tensor: Tensor) -> Tensor:
            moved = tensor[plan.source]
            if name in plan.values:
                moved[plan.fresh] = plan.values[name].to(moved)
            return moved

        return move

    parameters = {name: _carry(name, set_values(name), start_at_zero, adam, {}) for name in having}
    return parameters, {name: start_at_zero(tensor) for name, tensor in statistics.items()}


def apply_sources(sources: Mapping[str, Int[Tensor, " M"]], adam: Adam) -> dict[str, Tensor]:
    """Gives parameters, and their moments, copies of some of their rows, where what they belong to is removed.

    Args:
        sources: by name of a parameter, the old row (M,) of each new one. Those not named stay as they are.
        adam: the optimizer; its parameters and moments are replaced in place.

    Returns:
        The new parameters, leaf tensors with the old requires_grad, by name.

    Raises:
        ValueError: a name is unknown or has no rows, or a row is out of range. Nothing has been changed then.
    """
    for name, source in sources.items():
        if name not in adam.parameters:
            raise ValueError(f"sources must name parameters, got {name!r}")
        check_memory(name, adam.parameters[name])
        if adam.parameters[name].ndim == 0:
            raise ValueError(f"sources must name parameters with rows, got {name!r}")
        check_indices(f"sources of {name}", source, len(adam.parameters[name]))

    def pick(rows: Tensor) -> Callable[[Tensor], Tensor]:
        return lambda tensor: tensor[rows.to(tensor.device)]

    return {name: _carry(name, pick(source), pick(source), adam, {}) for name, source in sources.items()}


def halves_plan(vertices: Float[Tensor, "N3 3"], colors: Float[Tensor, "N3 3"], halved: Int[Tensor, " K"]) -> RowPlan:
    """Halves some of N separate triangles at the middle of their longest edges; rows are their corners.

    Args:
        vertices: (3N, 3) corners, three of each triangle after the other.
        colors: (3N, 3) likewise; the middle has the mean of its edge's ends.
        halved: (K,) which triangles, each once. Their halves come last: one of each, then the others.
    """
    corners, tones = (tensor.reshape(-1, 3, 3) for tensor in (vertices, colors))
    halved = halved.to(corners.device)
    kept = torch.ones(len(corners), dtype=torch.bool, device=corners.device)
    kept[halved] = False
    triangles = torch.cat([kept.nonzero()[:, 0], halved, halved])
    source = (3 * triangles[:, None] + torch.arange(3, device=corners.device)).flatten()
    fresh = torch.arange(len(source), device=corners.device) >= 3 * int(kept.sum())
    chosen = corners[halved]
    longest = (chosen.roll(-1, dims=1) - chosen).norm(dim=2).argmax(dim=1)  # edge k runs from corner k to the next
    rows, following = torch.arange(len(halved), device=corners.device), (longest + 1) % 3

    def halves(values: Tensor) -> Tensor:
        middle = (values[rows, longest] + values[rows, following]) / 2
        first, second = values.clone(), values.clone()
        first[rows, following] = middle
        second[rows, longest] = middle
        return torch.cat([first, second]).reshape(-1, 3)

    return RowPlan(len(vertices), source, fresh, {"vertices": halves(chosen), "colors": halves(tones[halved])})


def _check_flags_of_rows(name: str, flags: Tensor, rows: str | int) -> None:
    check_shape(name, flags, (rows,))
    if flags.dtype != torch.bool:
        raise ValueError(f"{name} must be of bools, got {flags.dtype}")


@torch.no_grad()
def _carry(
    name: str,
    move: Callable[[Tensor], Tensor],
    move_moment: Callable[[Tensor], Tensor],
    adam: Adam,
    statistics: Mapping[str, Tensor],
) -> Tensor:
    if name in statistics:
        return move(statistics[name])
    old = adam.parameters[name]
    old.grad = None  # nobody needs it any more; copies are made one by one, so that few of them are there at a time
    new = move(old.detach()).requires_grad_(old.requires_grad)
    for moments in (adam.first_moments, adam.second_moments):
        moments[name] = move_moment(moments[name])
    adam.replace(name, new, adam.first_moments[name], adam.second_moments[name])
    return new
