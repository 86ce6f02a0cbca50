"""Adam over named parameters, all of them in one native call.

The update is that of ``torch.optim.Adam`` without weight decay, on every element, also where the gradient is zero.
Moments are plain tensors under the parameter's name, so that structural edits can carry them over (``optim/edit.py``).
"""

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from etsplat.core.validation import check_like, check_number, check_shape, check_written, dense
from etsplat.engines.choice import engine_for, queued_steps
from etsplat.engines.engine import Engine
from etsplat.engines.reference.steps import AdamGroup, step_rates
from etsplat.ops.soup_colors import EndAtColors, colors_backward


class Adam:
    """Adam (Kingma and Ba 2015).

        m <- m + (1 - b1) (g - m)
        v <- b2 v + (1 - b2) g^2
        p <- p - lr / (1 - b1^t) * m / (sqrt(v) / sqrt(1 - b2^t) + eps)

    Attributes:
        parameters: The tensors that are updated in place, by name.
        learning_rates: One per parameter; change them freely between steps.
        betas: Decay of the first and second moments.
        eps: Added to the square root.
        first_moments: m, shaped as the parameters.
        second_moments: v, shaped as the parameters.
        step_count: t, the number of steps taken.
        paces: By name of a parameter, (rows,) factors of its rate, one for each row. Change them freely between steps;
            those of a parameter are gone when another number of rows takes its place.
        calmed: Names of parameters whose rows move less where their gradients are small beside the others': the rate of
            a row is multiplied by r^2 / (r^2 + (mean r)^2), r^2 the sum of v over the row. Adam by itself moves all
            alike, also where there is hardly a gradient.

    Example:
        >>> place = torch.tensor([1.0, 2.0], requires_grad=True)
        >>> adam = etsplat.Adam({"place": place}, {"place": 0.1})
        >>> place.square().sum().backward()
        >>> adam.step()
        >>> place.detach()  # the first step of Adam is the rate
        tensor([0.9000, 1.9000])
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        learning_rates: Mapping[str, float],
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ) -> None:
        """Start with zero moments.

        Args:
            parameters: Leaf tensors by name.
            learning_rates: One for each name, at least 0.
            betas: Both in [0, 1).
            eps: At least 0.

        Raises:
            ValueError: Names that do not match, a number out of its range, or a parameter that is no tensor with
                a place in memory for each element.
        """
        if not isinstance(parameters, Mapping):
            raise ValueError(f"parameters must be tensors by name, got {type(parameters).__name__}")
        if not isinstance(learning_rates, Mapping) or set(parameters) != set(learning_rates):
            got = sorted(learning_rates) if isinstance(learning_rates, Mapping) else learning_rates
            raise ValueError(f"learning_rates must name {sorted(parameters)}, got {got}")
        if not (isinstance(betas, Sequence) and len(betas) == 2 and all(_is_decay(beta) for beta in betas)):
            raise ValueError(f"betas must be two numbers in [0, 1), got {betas}")
        check_number("eps", eps, 0)
        for name, rate in learning_rates.items():
            check_number(f"learning_rates[{name}]", rate, 0)
        for name, parameter in parameters.items():
            check_written(f"parameters[{name}]", parameter)
        self.parameters = dict(parameters)
        self.learning_rates = dict(learning_rates)
        self.betas = betas
        self.eps = eps
        self.step_count = 0
        self.first_moments = {name: _zeros(parameter) for name, parameter in self.parameters.items()}
        self.second_moments = {name: _zeros(parameter) for name, parameter in self.parameters.items()}
        self.paces: dict[str, Tensor] = {}
        self.calmed: frozenset[str] = frozenset()

    def __repr__(self) -> str:
        rates = ", ".join(f"{name}: {rate:.3g}" for name, rate in self.learning_rates.items())
        return f"{type(self).__name__}({rates}; {self.step_count} steps)"

    @torch.no_grad()
    def step(self, decays: Mapping[str, float] | None = None) -> None:
        """Update every parameter from its gradient; those that require none, and have none, stay as they are.

        Args:
            decays: By name of a parameter, how many times the parameter itself is added to its gradient: 2 c where c
                times the sum of its squares is minimised, whose gradient then takes no memory of its own.

        Raises:
            ValueError: A parameter that lacks its gradient or a place for each element, paces that do not fit it, or a
                decay of none that there is; nothing is updated then.
        """
        decays = decays or {}
        if not decays.keys() <= self.parameters.keys():
            raise ValueError(f"decays must be of {sorted(self.parameters)}, got {sorted(decays)}")
        together: dict[Engine, list[str]] = {}
        for name, parameter in self.parameters.items():
            check_written(f"parameters[{name}]", parameter)  # `data` may have been set since
            if parameter.grad is None and not parameter.requires_grad:
                continue  # frozen, as torch.optim has it
            together.setdefault(engine_for(parameter), []).append(name)
        groups_of = {engine: {name: self._group(name) for name in names} for engine, names in together.items()}
        self.step_count += 1
        for engine, names in together.items():
            groups, rates = groups_of[engine], [self.learning_rates[name] for name in names]
            added = [decays.get(name, 0.0) for name in names]
            engine.adam_step(list(groups.values()), rates, added, self.betas, self.eps, self.step_count)
            self._store(groups)

    def rates(self, names: Sequence[str]) -> list[float]:
        """What step t = `step_count` needs: lr / (1 - b1^t) of each named parameter, then sqrt(1 - b2^t)."""
        return step_rates([self.learning_rates[name] for name in names], self.betas, self.step_count)

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for parameter in self.parameters.values():
            parameter.grad = None

    @torch.no_grad()
    def forget(self, name: str) -> None:
        """Set the moments of a parameter to 0."""
        self.first_moments[name].zero_()
        self.second_moments[name].zero_()

    def replace(self, name: str, parameter: Tensor, first: Tensor, second: Tensor) -> None:
        """Put another tensor, with its moments, in the place of a parameter (structural edits only).

        Raises:
            ValueError: An unknown name, a parameter that cannot be written, or moments that do not fit it.
        """
        if name not in self.parameters:
            raise ValueError(f"name must be one of {sorted(self.parameters)}, got {name!r}")
        check_written("parameter", parameter)
        for moment_name, moment in (("first", first), ("second", second)):
            check_shape(moment_name, moment, tuple(parameter.shape))
            check_like(moment_name, moment, "parameter", parameter)
        check_like("parameter", parameter, f"parameters[{name}]", self.parameters[name])
        if name in self.paces and len(self.paces[name]) != len(parameter):
            del self.paces[name]
        self.parameters[name] = parameter
        self.first_moments[name] = dense(first, "first")
        self.second_moments[name] = dense(second, "second")

    def state_dict(self) -> dict[str, Any]:
        """Everything but the parameters themselves; tensors are shared, not copied."""
        return {
            "step_count": self.step_count,
            "learning_rates": dict(self.learning_rates),
            "betas": self.betas,
            "eps": self.eps,
            "first_moments": dict(self.first_moments),
            "second_moments": dict(self.second_moments),
            "paces": dict(self.paces),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a ``state_dict`` of an optimizer over parameters of the same names and shapes.

        Raises:
            ValueError: No such state, other names or shapes; nothing is changed then.
        """
        if lacking := sorted(set(self.state_dict()) - set(state if isinstance(state, Mapping) else ())):
            kind = ": it is of torch.optim" if "param_groups" in state else ""
            got = f"one without {', '.join(lacking)}{kind}" if isinstance(state, Mapping) else type(state).__name__
            raise ValueError(f"state must be what state_dict() of an etsplat.Adam returns, got {got}")
        for key in ("learning_rates", "first_moments", "second_moments"):
            if set(state[key]) != set(self.parameters):
                raise ValueError(f"{key} must name {sorted(self.parameters)}, got {sorted(state[key])}")
        for key in ("first_moments", "second_moments"):
            for name, moment in state[key].items():
                check_shape(f"{key}[{name}]", moment, tuple(self.parameters[name].shape))
                check_like(f"{key}[{name}]", moment, f"parameters[{name}]", self.parameters[name])
        self.step_count = int(state["step_count"])
        self.learning_rates = dict(state["learning_rates"])
        self.betas = tuple(state["betas"])
        self.eps = float(state["eps"])
        self.first_moments = {name: _dense_copy(state["first_moments"][name]) for name in self.parameters}
        self.second_moments = {name: _dense_copy(state["second_moments"][name]) for name in self.parameters}
        self.paces = {name: _dense_copy(paces) for name, paces in state["paces"].items()}

    @torch.no_grad()
    def step_on_device(
        self, rates: Tensor, halted: Tensor, decays: Tensor | None = None, ending: EndAtColors | None = None
    ) -> None:
        """A step as part of a queued one; it leaves `step_count` to the caller.

        Args:
            rates: (P + 1,) float32 in device memory, of `rates`.
            halted: () int32 in device memory: nothing is updated where it is not 0.
            decays: (P,) float32 in device memory, as those of `step`.
            ending: Where gradients ended at colours of three of the parameters, from which they are carried on.
        """
        engine, updated = queued_steps(rates), None
        if ending is not None:
            updated = self._carry_on(ending, rates, halted, decays)
        groups = {name: self._group(name) for name in self.parameters if name != updated}
        nothing = rates[:0]
        no_group = nothing, nothing, nothing, nothing, None
        in_order = [groups.get(name, no_group) for name in self.parameters]
        engine.adam_step(in_order, rates, decays, self.betas, self.eps, halted)
        self._store(groups)

    def _carry_on(self, ending: EndAtColors, rates: Tensor, halted: Tensor, decays: Tensor | None) -> str | None:
        """From colours to the parameters; the name of the one that was updated on the way, without a gradient."""
        if ending.colors is None or ending.colors.grad is None:
            return None
        rest, updated, engine = ending.of[-1], None, queued_steps(rates)
        place, name = next((i, name) for i, (name, p) in enumerate(self.parameters.items()) if p is rest)
        gradient = ending.colors.grad, ending.colors.detach()
        colored = ending.of, ending.centers, ending.degree
        if rest.grad is None and name not in self.paces and rest.is_contiguous():
            moments = self.first_moments[name], self.second_moments[name]
            decay = None if decays is None else decays[place : place + 1]
            numbers = rates[place : place + 1], rates[-1:], decay
            found = engine.colors_adam(*gradient, *colored, moments, numbers, self.betas, self.eps, halted)
            torch.autograd.graph.increment_version(rest)
            updated = name
        else:
            found = colors_backward(gradient[0], *ending.of, *colored[1:])
        for parameter, by_colors in zip(ending.of, found, strict=False):
            parameter.grad = by_colors if parameter.grad is None else parameter.grad + by_colors
        return updated

    def _group(self, name: str) -> AdamGroup:
        """Value, gradient and moments of a parameter, contiguous."""
        parameter = self.parameters[name]
        if parameter.grad is None:
            raise ValueError(f"parameter {name} has no gradient: call backward() before step()")
        first, second = self.first_moments[name], self.second_moments[name]
        if not parameter.shape == parameter.grad.shape == first.shape == second.shape:
            was, got = tuple(first.shape), tuple(parameter.shape)
            raise ValueError(f"parameter {name}, its gradient and moments must have one shape, {was}, got {got}")
        paces = self.paces.get(name)
        if paces is not None:
            check_shape(f"paces of {name}", paces, (len(parameter),))
            check_like(f"paces of {name}", paces, name, parameter)
            paces = dense(paces, f"paces of {name}")
        if name in self.calmed:
            calm = _calm(second)
            paces = calm if paces is None else calm * paces
        return dense(parameter, name), dense(parameter.grad, f"gradient of {name}"), first, second, paces

    def _store(self, groups: Mapping[str, AdamGroup]) -> None:
        for name, (value, *_) in groups.items():
            parameter = self.parameters[name]
            if value.data_ptr() == parameter.data_ptr():
                torch.autograd.graph.increment_version(parameter)  # so that a stale graph fails loudly in backward
            else:
                parameter.copy_(value)


def _is_decay(beta: object) -> bool:
    return isinstance(beta, Real) and 0 <= float(beta) < 1


def _calm(second: Tensor) -> Tensor:
    """(rows,) by how much each row moves less than by itself; 0 for all where there are no gradients yet."""
    squared = second.flatten(1).sum(dim=1)
    return squared / (squared + squared.sqrt().mean().square()).clamp_min(torch.finfo(second.dtype).tiny)


def _zeros(parameter: Tensor) -> Tensor:
    """A moment: dense whatever the strides of the parameter."""
    return torch.zeros(parameter.shape, dtype=parameter.dtype, device=parameter.device)


def _dense_copy(moment: Tensor) -> Tensor:
    return moment.detach().clone(memory_format=torch.contiguous_format)
