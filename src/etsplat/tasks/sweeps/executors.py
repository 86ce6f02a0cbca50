"""What makes runs: the interface of all executors. Imports no torch."""

from abc import ABC, abstractmethod
from typing import Protocol

from etsplat.tasks.sweeps.work import Work


class LostError(RuntimeError):
    """The process that made a run ended without a word, or its machine did: worth another try."""


class Pending(Protocol):
    """A run that was handed over."""

    def done(self) -> bool:
        """Whether it has ended, in whatever way."""
        ...

    def result(self) -> str:
        """What `perform` returned, once it has ended.

        Raises:
            LostError: the process did not live to return anything.
        """
        ...


class Executor(ABC):
    """Makes runs, each in a process of its own, as many beside each other as there is room for.

    Attributes:
        threads: of each run.
    """

    threads: int

    @abstractmethod
    def submit(self, work: Work) -> Pending:
        """Hands a run over; returns at once.

        Raises:
            InputError: it is not taken.
        """

    @abstractmethod
    def stop(self) -> None:
        """Interrupts all runs, takes back those that have not begun, and waits until each has saved a checkpoint."""

    @abstractmethod
    def close(self) -> None:
        """Frees what it holds, when all runs have ended."""
