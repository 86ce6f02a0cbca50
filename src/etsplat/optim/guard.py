"""Sees to it that edits do not spoil what training has reached.

The photometric loss, mean over training views at a small fixed size, is measured before an edit, and again some
steps after it. If it is higher than before by more than a tolerance, everything goes back to where it was before the
edit, and the run goes on from there with a milder one, if the strategy has one, or without: with the bits of a run
that never had it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from etsplat.core.validation import check_count, check_number
from etsplat.optim.loop import Progress
from etsplat.optim.schedules import NEVER


@dataclass(frozen=True)
class Held:
    """An edit that is on trial.

    Attributes:
        iteration: after whose step it was made.
        due: the iteration after which it is judged.
        loss: before it.
        state: of the run before it.
        losses: sum and number of the losses since the last StepEvent, before it.
    """

    iteration: int
    due: int
    loss: float
    state: dict[str, Tensor]
    losses: tuple[float, int]


class Guard:
    """Holds the state before an edit until that is judged, and knows which edits were undone.

    Attributes:
        held: the edit on trial, if there is one.
        undone: iterations whose edits were undone, ascending; each as often as that happened.

    Example:
        >>> etsplat.Guard(tolerance=0.05, until=1000).undone
        []
    """

    def __init__(self, *, tolerance: float = 0.02, steps: int = 100, until: int = NEVER) -> None:
        """Holds nothing yet.

        Args:
            tolerance: by which part the loss may be higher than before the edit.
            steps: after so many steps an edit is judged, or before the next edit if that comes earlier.
            until: length of the run: an edit is judged after its last step if nothing comes earlier.

        Raises:
            ValueError: a number is out of its range, or none.
        """
        check_number("tolerance", tolerance)
        steps, until = check_count("steps", steps), check_count("until", until, least=0)
        self._tolerance, self._steps, self._until = tolerance, steps, until
        self.held: Held | None = None
        self.undone: list[int] = []

    @property
    def due(self) -> int:
        """After which iteration something is judged."""
        return NEVER if self.held is None else self.held.due

    def hold(self, progress: Progress, next_edit: int, loss: float, state: Mapping[str, Tensor]) -> None:
        """To be called before an edit.

        Args:
            progress: where the run stands; the edit's iteration is done.
            next_edit: the iteration of the edit after this one.
            loss: now.
            state: now; copied.
        """
        due = max(progress.iteration, min(progress.iteration + self._steps, next_edit, self._until))
        copied = {name: tensor.detach().clone() for name, tensor in state.items()}
        self.held = Held(progress.iteration, due, loss, copied, (progress.loss_sum, progress.loss_count))

    def release_if_same(self, state: Mapping[str, Tensor]) -> None:
        """To be called after an edit that replaced no tensor: one that changed nothing is not judged."""
        if self.held is not None and all(torch.equal(tensor, state[name]) for name, tensor in self.held.state.items()):
            self.held = None

    def judge(self, loss: float) -> Held | None:
        """Ends the trial; returns what is to be gone back to, if the loss is too high for the edit to stay."""
        held, self.held = self.held, None
        assert held is not None
        if loss <= (1 + self._tolerance) * held.loss:
            return None
        self.undone = sorted([*self.undone, held.iteration])
        return held

    def state(self) -> dict[str, Tensor]:
        """Everything that later judgements depend on, by name, for a checkpoint; empty if nothing was ever undone."""
        state = {"undone": torch.tensor(self.undone)} if self.undone else {}
        if self.held is not None:
            held = self.held
            state |= {f"held.{name}": tensor for name, tensor in held.state.items()}
            numbers = [held.iteration, held.due, held.loss, *held.losses]
            state["trial"] = torch.tensor(numbers, dtype=torch.float64)
        return state

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        self.undone, self.held = [], None
        if "undone" in state:
            self.undone = state["undone"].tolist()
        if "trial" in state:
            iteration, due, loss, loss_sum, loss_count = state["trial"].tolist()
            held = {name.removeprefix("held."): tensor for name, tensor in state.items() if name.startswith("held.")}
            self.held = Held(int(iteration), int(due), loss, held, (loss_sum, int(loss_count)))
