"""`etsplat doctor`."""

from collections.abc import Sequence
from dataclasses import dataclass

from etsplat.cli.command import FAILED, Command


@dataclass(frozen=True, kw_only=True)
class Doctor(Command):
    """Say what this installation can do: engine, instruction set, threads, versions, and what is missing for what."""

    def run(self, arguments: Sequence[str]) -> int:
        """Prints the state of the installation; fails if what must work does not."""
        from rich.console import Console

        from etsplat.cli.examine import examine

        return 0 if examine(Console()) else FAILED
