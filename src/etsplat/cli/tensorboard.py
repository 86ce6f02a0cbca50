"""Curves for tensorboard, for who wants them there."""

from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.optim.loop import DoneEvent, StepEvent


class TensorboardWriter:
    """A callback that writes what history.jsonl holds into the folder `tensorboard` of a run."""

    def __init__(self, run_dir: Path) -> None:
        """Raises InputError if tensorboard is not installed."""
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise InputError("--tensorboard: is not installed; pip install 'etsplat[tensorboard]'") from error
        self._make = SummaryWriter
        self._folder = run_dir / "tensorboard"
        self._writer: Any = None

    def __call__(self, event: object) -> None:
        """Take in an event of the run."""
        if isinstance(event, StepEvent):
            if self._writer is None:  # not before the run directory has been made
                # What a run that was killed wrote beyond its last checkpoint is hidden.
                self._writer = self._make(str(self._folder), purge_step=event.iteration)
            for name, value in {"loss": event.loss, **event.state, **event.metrics}.items():
                self._writer.add_scalar(name, value, event.iteration)
            self._writer.flush()  # a run may end at any moment
        elif isinstance(event, DoneEvent) and self._writer is not None:
            self._writer.close()
