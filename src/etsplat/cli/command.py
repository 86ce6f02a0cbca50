"""What every command of the command line is: a dataclass whose fields are its options, with a method that runs it."""

import runpy
import shlex
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, NoReturn, TypeVar, get_args

import tyro

from etsplat.core.errors import InputError
from etsplat.io.run_directory import KERNEL_FILE
from etsplat.tasks.settings import AnySettings, SoftMethod, kernel_methods

AnyCommand = TypeVar("AnyCommand", bound="Command")

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130

Flag = tyro.conf.FlagCreatePairsOff[bool]
"""An option that is off unless given. Settings have a pair, --name and --no-name: a preset may turn them on."""


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """Base of the commands. The docstring of a subclass is its help, those of its fields are theirs.

    The list of commands shows it up to its examples. A module that defines commands imports no torch at its top, so
    that `--help` is fast.
    """

    debug: Flag = False
    """Show the traceback of an error."""

    @classmethod
    def defaults(cls: type[AnyCommand], arguments: Sequence[str], **known: Any) -> AnyCommand:
        """The command before its options are applied.

        Args:
            arguments: the command line; where a preset is an option, it is named there.
            known: what the arguments decide, by name. What else has no default must be given as an option.
        """
        required = [entry.name for entry in fields(cls) if entry.default is entry.default_factory is MISSING]
        options: dict[str, Any] = {**dict.fromkeys(required, tyro.MISSING), **known}
        return cls(**options)

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
        run_kernel_file(Path(file))
    out = option_value(arguments, "--out")
    if "--resume" in arguments and out is not None and (Path(out) / KERNEL_FILE).is_file():
        from etsplat.io.kernel_files import adopt_kernel_of

        adopt_kernel_of(Path(out))


def run_kernel_file(path: Path) -> None:
    """Runs a Python file that registers kernels: the only file that the command line runs, and only where it is named.

    Raises:
        InputError: there is no such file, it fails, or it registers nothing.
    """
    if not path.is_file():
        raise InputError(f"--kernel-file {path}: no such file; check the path")
    try:
        runpy.run_path(str(path))
    except Exception as error:
        raise InputError(f"--kernel-file {path}: failed ({type(error).__name__}: {error})") from error
    if kernel_methods() == get_args(SoftMethod):
        raise InputError(f"--kernel-file {path}: registers no kernel; call etsplat.register_kernel(name, value) in it")


def option_value(arguments: Sequence[str], option: str) -> str | None:
    """What the arguments say for an option, the last time that they do, before they are parsed."""
    value = None
    for position, argument in enumerate(arguments):
        if argument == option:
            value = "".join(arguments[position + 1 : position + 2])
        elif argument.startswith(f"{option}="):
            value = argument.removeprefix(f"{option}=")
    return value


def resume_line(arguments: Sequence[str]) -> str:
    """The command line that continues an interrupted one."""
    kept = [argument for argument in arguments if argument not in ("--overwrite", "--resume")]
    return shlex.join(["etsplat", *kept, "--resume"])


def fail(message: str, code: int) -> NoReturn:
    """Ends the process with one line on standard error."""
    print(f"etsplat: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)
