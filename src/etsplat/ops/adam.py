"""Adam over named parameters, all of them in one native call.

The update is that of ``torch.optim.Adam`` without weight decay, on every element, also where the gradient is zero.
Moments are plain tensors under the parameter's name, so that structural edits can carry them over (``optim/edit.py``).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_like, check_shape, dense
from etsplat.cuda.transfer import upload
from etsplat.ops._adam_cuda import adam_step_cuda
from etsplat.ops.engines import resolve_engine


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
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        learning_rates: Mapping[str, float],
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
        engine: str | None = None,
    ) -> None:
        """Start with zero moments.

        Args:
            parameters: Leaf tensors by name.
            learning_rates: One for each name, at least 0.
            betas: Both in [0, 1).
            eps: At least 0.
            engine: "cpu", "cuda", "reference" or None (by dtype and device, for each parameter).

        Raises:
            ValueError: Names that do not match, or a number out of its range.
        """
        if set(parameters) != set(learning_rates):
            raise ValueError(f"learning_rates must name {sorted(parameters)}, got {sorted(learning_rates)}")
        if not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"betas must be in [0, 1), got {betas}")
        if eps < 0:
            raise ValueError(f"eps must be at least 0, got {eps}")
        self.parameters = dict(parameters)
        self.learning_rates = dict(learning_rates)
        self.betas = betas
        self.eps = eps
        self.step_count = 0
        self.first_moments = {name: _zeros(parameter) for name, parameter in self.parameters.items()}
        self.second_moments = {name: _zeros(parameter) for name, parameter in self.parameters.items()}
        self._engines = {name: resolve_engine(engine, parameter) for name, parameter in self.parameters.items()}

    @torch.no_grad()
    def step(self) -> None:
        """Update every parameter from its gradient.

        Raises:
            ValueError: A parameter without gradient; nothing is updated then.
        """
        for name, parameter in self.parameters.items():
            if parameter.grad is None:
                raise ValueError(f"parameter {name} has no gradient: call backward() before step()")
        self.step_count += 1
        if names := self._of_engine("cpu"):
            self._step_cpu(names)
        if names := self._of_engine("cuda"):
            self._step_cuda(names, upload(self.rates(names), self.parameters[names[0]].device), None)
        for name in self._of_engine("reference"):
            self._step_reference(name)

    def rates(self, names: Sequence[str]) -> list[float]:
        """What step t = `step_count` needs: lr / (1 - b1^t) of each named parameter, then sqrt(1 - b2^t)."""
        first, second = (1 - beta**self.step_count for beta in self.betas)
        return [*(self.learning_rates[name] / first for name in names), second**0.5]

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for parameter in self.parameters.values():
            parameter.grad = None

    def replace(self, name: str, parameter: Tensor, first: Tensor, second: Tensor) -> None:
        """Put another tensor, with its moments, in the place of a parameter (structural edits only).

        Raises:
            ValueError: An unknown name, or moments that do not fit the parameter.
        """
        if name not in self.parameters:
            raise ValueError(f"name must be one of {sorted(self.parameters)}, got {name!r}")
        for moment_name, moment in (("first", first), ("second", second)):
            check_shape(moment_name, moment, tuple(parameter.shape))
            check_like(moment_name, moment, "parameter", parameter)
        check_like("parameter", parameter, f"parameters[{name}]", self.parameters[name])
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
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a ``state_dict`` of an optimizer over parameters of the same names and shapes.

        Raises:
            ValueError: Other names or shapes; nothing is changed then.
        """
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

    @torch.no_grad()
    def step_on_device(self, rates: Tensor, halted: Tensor | None) -> None:
        """A step of engine "cuda" that a CUDA graph can capture and repeat; it leaves `step_count` to the caller.

        Args:
            rates: (P + 1,) float32 in device memory, of `rates`.
            halted: () int32 in device memory: nothing is updated where it is not 0. None never halts.
        """
        self._step_cuda(list(self.parameters), rates, halted)

    def _of_engine(self, engine: str) -> list[str]:
        return [name for name, chosen in self._engines.items() if chosen == engine]

    def _step_cpu(self, names: list[str]) -> None:
        groups = self._dense(names)
        values, gradients, firsts, seconds = zip(*groups, strict=True)
        _native.adam_step(
            [tensor.data_ptr() for tensor in values],
            [tensor.data_ptr() for tensor in gradients],
            [tensor.data_ptr() for tensor in firsts],
            [tensor.data_ptr() for tensor in seconds],
            [tensor.numel() for tensor in values],
            [self.learning_rates[name] for name in names],
            *self.betas,
            self.eps,
            self.step_count,
        )
        self._store(names, values)

    def _step_cuda(self, names: list[str], rates: Tensor, halted: Tensor | None) -> None:
        groups = self._dense(names)
        adam_step_cuda(groups, rates, self.betas, self.eps, halted)
        self._store(names, [group[0] for group in groups])

    def _dense(self, names: list[str]) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Value, gradient and moments of each parameter, contiguous."""
        groups = []
        for name in names:
            parameter = self.parameters[name]
            assert parameter.grad is not None
            first, second = self.first_moments[name], self.second_moments[name]
            if not parameter.shape == parameter.grad.shape == first.shape == second.shape:
                was, got = tuple(first.shape), tuple(parameter.shape)
                raise ValueError(f"parameter {name}, its gradient and moments must have one shape, {was}, got {got}")
            groups.append((dense(parameter, name), dense(parameter.grad, f"gradient of {name}"), first, second))
        return groups

    def _store(self, names: list[str], updated: Sequence[Tensor]) -> None:
        for name, value in zip(names, updated, strict=True):
            parameter = self.parameters[name]
            if value.data_ptr() == parameter.data_ptr():
                torch.autograd.graph.increment_version(parameter)  # so that a stale graph fails loudly in backward
            else:
                parameter.copy_(value)

    def _step_reference(self, name: str) -> None:
        parameter, first, second = self.parameters[name], self.first_moments[name], self.second_moments[name]
        gradient = parameter.grad
        assert gradient is not None
        beta1, beta2 = self.betas
        first += (1 - beta1) * (gradient - first)
        second.mul_(beta2).add_((1 - beta2) * gradient * gradient)
        root = second.sqrt() / (1 - beta2**self.step_count) ** 0.5
        parameter -= self.learning_rates[name] / (1 - beta1**self.step_count) * (first / (root + self.eps))


def _zeros(parameter: Tensor) -> Tensor:
    """A moment: dense whatever the strides of the parameter."""
    return torch.zeros(parameter.shape, dtype=parameter.dtype, device=parameter.device)


def _dense_copy(moment: Tensor) -> Tensor:
    return moment.detach().clone(memory_format=torch.contiguous_format)
