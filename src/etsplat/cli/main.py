"""Runs the command that was asked for, turns errors into one line, and imports torch only where it is needed."""

import os
import shlex
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import NoReturn

from rich.console import Console

from etsplat.cli.options import Demo, Doctor, Reconstruct, parse
from etsplat.core.errors import InputError

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130


def main() -> NoReturn:
    """Entry point of the `etsplat` command.

    The process ends with 0; 1 if a run failed; 2 if the input or the options cannot be used; 130 after Ctrl-C.
    """
    arguments = sys.argv[1:]
    try:
        sys.exit(_run(arguments))
    except BrokenPipeError:  # `etsplat --help | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)
    except KeyboardInterrupt:
        _fail("interrupted", INTERRUPTED)
    except (InputError, OSError) as error:
        if "--debug" in arguments:
            raise
        _fail(str(error), WRONG_INPUT)


def _run(arguments: Sequence[str]) -> int:
    if list(arguments) == ["--version"]:
        print(f"etsplat {version('etsplat')}")
        return 0
    command = parse(arguments)
    if isinstance(command, Doctor):
        from etsplat.cli.doctor import examine

        return 0 if examine(Console()) else FAILED
    return _reconstruct(command, arguments)


def _reconstruct(command: Demo | Reconstruct, arguments: Sequence[str]) -> int:
    from etsplat.cli.progress import RunProgress
    from etsplat.cli.summary import print_summary
    from etsplat.io.run_directory import is_run
    from etsplat.optim.loop import DivergedError
    from etsplat.report import write_report
    from etsplat.tasks.reconstruct import reconstruct

    console = Console()
    try:
        with RunProgress(console) as progress:
            reconstruct(
                command.source if isinstance(command, Reconstruct) else "demo:owl",
                command.out,
                command.settings,
                init_mesh=command.init_mesh if isinstance(command, Reconstruct) else None,
                callbacks=[progress],
                resume=command.resume,
                overwrite=command.overwrite,
            )
            progress.say("Writing the report")
            write_report(command.out)
    except KeyboardInterrupt:
        if not is_run(command.out):
            raise
        _fail(f"interrupted; continue with: {resume_line(arguments)}", INTERRUPTED)
    except DivergedError as error:
        if command.debug:
            raise
        _fail(str(error), FAILED)
    print_summary(console, command.out)
    return 0


def resume_line(arguments: Sequence[str]) -> str:
    """The command line that continues an interrupted one."""
    kept = [argument for argument in arguments if argument not in ("--overwrite", "--resume")]
    return shlex.join(["etsplat", *kept, "--resume"])


def _fail(message: str, code: int) -> NoReturn:
    """End the process with one line on standard error."""
    print(f"etsplat: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)
