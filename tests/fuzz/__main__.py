"""Try odd inputs on every reader and every public operation, and say what came of it."""

import argparse
import logging
import shutil
import sys
import warnings
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from tests.fuzz.operations import OPERATIONS
from tests.fuzz.planted import DEFECTS, INPUTS, planted
from tests.fuzz.planted import HANG as SOON
from tests.fuzz.readers import READERS
from tests.fuzz.session import HANG, Tally, Target, keep, replay, run_target

FOUND = Path("build/fuzz")

ENOUGH = 200
"""So many inputs say what share is accepted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit status."""
    options = _parse(arguments)
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    torch.set_num_threads(1)
    everything: list[Target] = [*READERS, *OPERATIONS]
    if options.replay:
        name, index = options.replay
        replay(next(target for target in everything if target.name == name), options.seed, int(index))
        return 0
    console = Console(width=max(100, Console().width))
    failed = False
    for kind in DEFECTS:
        tally = run_target(planted(kind), options.seed, inputs=INPUTS, hang=SOON if kind == "hang" else HANG)
        if set(tally.counts()) != {kind}:
            console.print(f"planted {kind}: not found, but {dict(tally.counts())}")
            failed = True
    targets = [target for target in everything if fnmatch(target.name, options.targets)]
    shutil.rmtree(FOUND, ignore_errors=True)
    tallies: list[Tally] = []
    for number, target in enumerate(targets, start=1):
        if console.is_terminal or not options.seconds:  # an hour, in which one wants to know how far it is
            console.print(f"{number} of {len(targets)}: {target.name}", style="dim")
        kin = [other for other in targets if isinstance(other, type(target))]
        total = options.inputs if target in READERS else options.calls
        seconds = (options.seconds or float("inf")) / len(targets)
        tally = run_target(target, options.seed, inputs=-(-total // len(kin)), seconds=seconds)
        tallies.append(tally)
        for kind, (what, failure) in enumerate(tally.failures.items()):
            place = FOUND / target.name.replace(" ", "_").replace("/", "_") / str(kind)
            keep(target, options.seed, failure, place)
            console.print(f"{target.name}: {what}, {failure.count} times, first input {failure.index}: {place}")
        if tally.inputs >= ENOUGH and tally.share_accepted() < target.least_accepted:
            console.print(f"{target.name}: only {tally.share_accepted():.1%} of its inputs were accepted")
            failed = True
    console.print(_table(tallies))
    return int(failed or any(tally.failures for tally in tallies))


def _table(tallies: Sequence[Tally]) -> Table:
    table = Table("target", title="odd inputs")
    for name in ("inputs", "accepted", "exceptions", "crashes", "hangs", "memory", "ms each"):
        table.add_column(name, justify="right")
    for tally in tallies:
        counts = tally.counts()
        table.add_row(
            tally.name,
            f"{tally.inputs:,}",
            f"{tally.share_accepted():.0%}",
            *(str(counts[kind] or "") for kind in ("exception", "crash", "hang", "memory")),
            f"{1000 * tally.seconds / max(1, tally.inputs):.1f}",
        )
    table.add_section()
    table.add_row("all", f"{sum(tally.inputs for tally in tallies):,}")
    return table


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=1_000_000, help="over all readers")
    parser.add_argument("--calls", type=int, default=100_000, help="over all operations")
    parser.add_argument("--seconds", type=float, help="at most, for all targets together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", default="*", metavar="PATTERN", help="only those whose name matches")
    parser.add_argument("--replay", nargs=2, metavar=("TARGET", "INPUT"), help="run one input again, without bounds")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
