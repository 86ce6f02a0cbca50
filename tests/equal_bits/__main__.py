"""Runs the cases in both trees, compares, prints the table: `make equal-bits BASE=COMMIT [CASES=PATTERN] [FRESH=1]`."""

import argparse
import os
import shutil
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from fnmatch import fnmatch
from pathlib import Path

from rich.console import Console
from rich.table import Table

from .cases import CASES, CONTROLS
from .inputs import write_inputs
from .session import COLUMNS, Outcome, Session
from .trees import ROOT, base_tree, digest, locked, machine, names_of, resolve_commit, this_tree

FOLDER = ROOT / "build" / "equal_bits"
SHOWN = 4
"""So many differences of a case are printed."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="equal-bits", description=__doc__)
    parser.add_argument("--base", required=True, help="the commit to compare with")
    parser.add_argument("--cases", default="*", help="shell pattern of the names of the cases to run")
    parser.add_argument("--fresh", action="store_true", help="run BASE again too, though its results are kept")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="cases side by side")
    options = parser.parse_args()
    chosen = [case for case in CASES if fnmatch(case.name, options.cases)]
    if not chosen:
        parser.error(f"--cases {options.cases}: is none of {', '.join(case.name for case in CASES)}")

    started, session = time.perf_counter(), open_session(options.base, fresh=options.fresh)
    jobs = [(session.control, case) for case in CASES if case.name in CONTROLS]
    jobs += [(session.check, case) for case in chosen]
    with ThreadPoolExecutor(options.jobs) as pool:
        running = [pool.submit(job, case) for job, case in jobs]
        for count, future in enumerate(as_completed(running), 1):
            outcome = future.result()
            print(f"{count}/{len(jobs)} {outcome.name}: {'passed' if outcome.passed else 'FAILED'}", flush=True)
    report([future.result() for future in running], options.base, time.perf_counter() - started)
    if all(future.result().passed for future in running):
        shutil.rmtree(session.drafts)
        return 0
    print(f"The runs of this tree are in {session.drafts}, those of {options.base} in {session.kept}")
    return 1


def open_session(base: str, *, fresh: bool) -> Session:
    """Builds BASE and writes the inputs, where they are not there yet."""
    commit = resolve_commit(base)
    instruction_set, about = machine()
    of_base = FOLDER / commit[:12]
    inputs = FOLDER / f"inputs-{digest(Path(__file__).with_name('inputs.py').read_text())}"
    tree = base_tree(commit, of_base)
    with locked(FOLDER):
        write_inputs(inputs)
    drafts = Path(tempfile.mkdtemp(prefix="here-", dir=FOLDER))
    here, names = this_tree(drafts / "site"), names_of(of_base)
    return Session(tree, here, inputs, of_base / "runs", drafts, instruction_set, about, fresh, names)


def report(outcomes: list[Outcome], base: str, seconds: float) -> None:
    """Prints the table, and below it what differs."""
    table = Table(title=f"This tree against {base}, bit for bit ({seconds:.0f} s)", title_justify="left")
    for column in ("case", *COLUMNS):
        table.add_column(column)
    for outcome in outcomes:
        style = None if outcome.passed else "bold red"
        table.add_row(outcome.name, *(outcome.cells[column] for column in COLUMNS), style=style)
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(table)
    for outcome in outcomes:
        for note in outcome.notes[:SHOWN]:
            console.print(f"{outcome.name}: {note}", markup=False, highlight=False, soft_wrap=True)
        if len(outcome.notes) > SHOWN:
            console.print(f"{outcome.name}: and {len(outcome.notes) - SHOWN} more", markup=False, highlight=False)
    failed = [outcome.name for outcome in outcomes if not outcome.passed]
    console.print(f"{len(failed)} of {len(outcomes)} failed" if failed else f"all {len(outcomes)} as they should be")


if __name__ == "__main__":
    sys.exit(main())
