"""What the commands that make a run have in common: progress, report, summary, and how a run ends early."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from etsplat.cli.command import FAILED, INTERRUPTED, fail, resume_line

if TYPE_CHECKING:
    from etsplat.cli.progress import RunProgress


def run_task(
    task: "Callable[[RunProgress], object]", out: Path, arguments: Sequence[str], *, debug: bool, preparing: str
) -> int:
    """Does a run with a progress bar, writes its report and prints what came out; returns the exit status.

    Args:
        task: makes the run in `out`, with the bar as one of its callbacks.
        out: the run directory.
        arguments: the command line, for the one that continues an interrupted run.
        debug: raise `DivergedError` instead of ending the process with its line.
        preparing: what happens before the first event.
    """
    from rich.console import Console

    from etsplat.cli.progress import RunProgress
    from etsplat.cli.summary import print_summary
    from etsplat.io.run_directory import is_run
    from etsplat.optim.loop import DivergedError
    from etsplat.report import write_report

    console = Console()
    try:
        with RunProgress(console, preparing=preparing) as progress:
            task(progress)
            progress.say("Writing the report")
            write_report(out)
    except KeyboardInterrupt:
        if not is_run(out):
            raise
        fail(f"interrupted; continue with: {resume_line(arguments)}", INTERRUPTED)
    except DivergedError as error:
        if debug:
            raise
        fail(str(error), FAILED)
    print_summary(console, out)
    return 0
