"""What commands that make many runs have in common: where these run, and how that is watched."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from etsplat.cli.command import INTERRUPTED, Command, fail
from etsplat.core.errors import InputError
from etsplat.tasks.sweeps.places import Where

if TYPE_CHECKING:
    from etsplat.cli.live_table import Headline
    from etsplat.tasks.sweeps.cells import Cell


@dataclass(frozen=True, kw_only=True)
class Placed(Command):
    """Base of the commands that make many runs."""

    out: Path
    """Folder for the runs and what is made of them; what was interrupted goes on where it was."""
    jobs: Annotated[int, tyro.conf.arg(help_behavior_hint="(default: one for each core)")] = 0
    """Runs beside each other on this machine; 0 for one on each core. They share the cores evenly."""
    cores: int | None = None
    """Cores of each run; None for an even share of this machine's, and for one on a cluster."""
    cluster: str | None = None
    """Run on a cluster, whose machines see the same folders:
    auto or ADDRESS: of Ray (extra "cluster"); slurm: by submitit (extra "slurm").
    None for this machine."""
    slurm: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: none)")] = ()
    """With --cluster slurm: submitit's parameters, such as timeout_min=240 slurm_partition=cpu."""

    def where(self) -> Where:
        """What the options say.

        Raises:
            InputError: they contradict each other.
        """
        pairs = [item.partition("=") for item in self.slurm]
        for item, (name, equals, _) in zip(self.slurm, pairs, strict=True):
            if not (name and equals):
                raise InputError(f"slurm: {item} is not a parameter and its value; write NAME=VALUE")
        given = {name: value for name, _, value in pairs}
        return Where(self.jobs, self.cores, self.cluster, given, self.out / "submitit")

    def run_cells(self, cells: "Sequence[Cell]", where: Where, headline: "Headline") -> None:
        """Runs what is not finished yet; Ctrl-C ends the process, which can be repeated."""
        from rich.console import Console

        from etsplat.cli.live_table import LiveTable
        from etsplat.tasks.sweeps.cells import run_cells

        try:
            with LiveTable(Console(), cells, headline) as table:
                run_cells(cells, where, table.update)
        except KeyboardInterrupt:
            fail("interrupted; give the same command to go on", INTERRUPTED)
