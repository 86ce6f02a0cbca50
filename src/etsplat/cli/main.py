"""Runs the command that was asked for and turns errors into one line."""

import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from types import FrameType
from typing import NoReturn

import etsplat
from etsplat.cli.command import FAILED, INTERRUPTED, WRONG_INPUT, Command, fail
from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from etsplat.core.spelling import spelled_as_options


def main() -> NoReturn:
    """Entry point of the `etsplat` command; it ends as `run_command` does."""
    if sys.argv[1:] == ["--version"]:
        print(f"etsplat {etsplat.__version__}")
        sys.exit(0)
    run_command(parse, sys.argv[1:])


@spelled_as_options()
def run_command(parse: Callable[[Sequence[str]], Command], arguments: Sequence[str]) -> NoReturn:
    """Runs the command that `parse` makes of the arguments, and ends the process.

    With 0; 1 if a run failed; 2 if the input or the options cannot be used; 130 after Ctrl-C.
    SIGTERM, which asks a process to end, is taken for Ctrl-C, so that a run saves a checkpoint then too.
    """
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        command = parse(arguments)
        from etsplat.engines.threads import one_torch_thread  # imports torch, which `--help` does without

        with one_torch_thread():
            sys.exit(command.run(arguments))
    except BrokenPipeError:  # `etsplat --help | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)
    except KeyboardInterrupt:
        fail("interrupted", INTERRUPTED)
    except ModuleNotFoundError as error:  # of an extra it is an InputError
        if "--debug" in arguments or error.name is None or error.name.partition(".")[0] == "etsplat":
            raise
        fail(f"the module {error.name} is not installed: install etsplat anew, without pip's --no-deps", FAILED)
    except (MemoryError, RuntimeError) as error:
        full = isinstance(error, MemoryError) or re.search(r"can't allocate memory|out of memory", str(error))
        if "--debug" in arguments or not full:
            raise
        fail("there is not enough memory for this; ask for smaller or fewer pictures or triangles", FAILED)
    except (InputError, OSError) as error:
        if "--debug" in arguments:
            raise
        if isinstance(error, OSError) and error.filename is not None:
            fail(f"{error.filename}: {error.strerror}; check the path and its permissions", WRONG_INPUT)
        fail(str(error), WRONG_INPUT)
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(_: int, frame: FrameType | None) -> None:
    """Does what Ctrl-C would do, also where that is ignored, as in a shell's background jobs."""
    on_interrupt = signal.getsignal(signal.SIGINT)
    (on_interrupt if callable(on_interrupt) else signal.default_int_handler)(signal.SIGINT, frame)
