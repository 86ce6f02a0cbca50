"""What every command of the command line is: a dataclass whose fields are its options, with a method that runs it."""

import inspect
import shlex
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NoReturn

import tyro

from etsplat.io.run_directory import KERNEL_FILE
from etsplat.tasks.settings import AnySettings

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130

Flag = tyro.conf.FlagCreatePairsOff[bool]
"""An option that is off unless given. Settings have a pair, --name and --no-name: a preset may turn them on."""


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """Base of the commands. The docstring of a subclass is its help, those of its fields are theirs.

    A module that defines commands imports no torch at its top, so that `--help` is fast.
    """

    EXAMPLES: ClassVar[str] = ""
    """Command lines, one each line, for the command's own help."""

    debug: Flag = False
    """Show the traceback of an error."""

    @classmethod
    @abstractmethod
    def defaults(cls, arguments: Sequence[str]) -> "Command":
        """The command before its options are applied; where a preset is an option, `arguments` name it."""

    @abstractmethod
    def run(self, arguments: Sequence[str]) -> int:
        """Does what the command is for; `arguments` are the command line. Returns the process's exit status.

        Raises:
            InputError: the input or an option cannot be used.
        """


def settings_before_options(kind: type[AnySettings], arguments: Sequence[str], **named: str) -> AnySettings:
    """The settings that options change: those of ``--config FILE``, or of the preset that the arguments name.

    Args:
        kind: of config.
        arguments: the command line.
        named: what a preset is named by, with the values where the arguments have none: ``preset="best"``.

    Raises:
        InputError: the file cannot be used, there is no such preset, or both name one.
    """
    _know_kernels(arguments)
    given = {}
    for name in named:
        if (value := option_value(arguments, f"--{name.replace('_', '-')}")) is not None:
            given[name] = value
    path = option_value(arguments, "--config")
    return kind.based_on(named | given) if path is None else kind.from_file(path, named, given)


def _know_kernels(arguments: Sequence[str]) -> None:
    """Registers what settings may name: kernels of ``--kernel-file``, which runs, and of a run that goes on."""
    if (file := option_value(arguments, "--kernel-file")) is not None:
        from etsplat.cli.kernel_file import run_kernel_file

        run_kernel_file(Path(file))
    out = option_value(arguments, "--out")
    if "--resume" in arguments and out is not None and (Path(out) / KERNEL_FILE).is_file():
        from etsplat.io.kernel_files import adopt_kernel_of

        adopt_kernel_of(Path(out))


def option_value(arguments: Sequence[str], option: str) -> str | None:
    """What the arguments say for an option, the last time that they do, before they are parsed."""
    value = None
    for position, argument in enumerate(arguments):
        if argument == option:
            value = "".join(arguments[position + 1 : position + 2])
        elif argument.startswith(f"{option}="):
            value = argument.removeprefix(f"{option}=")
    return value


def help_of(command: type[Command]) -> str:
    """What a command's own help says of it: its docstring and its examples."""
    text = inspect.cleandoc(command.__doc__ or "")
    if not command.EXAMPLES:
        return text
    examples = inspect.cleandoc(command.EXAMPLES).splitlines()
    return f"{text}\n\nExamples:\n" + "\n".join(f"    {line}" for line in examples)


def resume_line(arguments: Sequence[str]) -> str:
    """The command line that continues an interrupted one."""
    kept = [argument for argument in arguments if argument not in ("--overwrite", "--resume")]
    return shlex.join(["etsplat", *kept, "--resume"])


def fail(message: str, code: int) -> NoReturn:
    """Ends the process with one line on standard error."""
    print(f"etsplat: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)
