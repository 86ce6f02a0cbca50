"""What every study is: a command of its own, `python -m studies.NAME`."""

import inspect
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import tyro

from etsplat.cli.command import Command
from etsplat.cli.main import run_command


@dataclass(frozen=True, kw_only=True)
class Study(Command):
    """Base of the studies; the module of one is named as its class, in lower case."""

    @classmethod
    def program(cls) -> str:
        """How it is started."""
        return f"python -m studies.{cls.__name__.lower()}"

    @classmethod
    def parse(cls, arguments: Sequence[str]) -> Command:
        """The study with these options. `--help` and wrong options end the process, as tyro does."""
        default = cls.defaults(arguments)
        return tyro.cli(
            cls,
            prog=cls.program(),
            description=inspect.cleandoc(cls.__doc__ or ""),
            args=list(arguments),
            default=default,
        )

    @classmethod
    def main(cls) -> NoReturn:
        """Runs it with the options of the command line; the process ends as one of `etsplat` does."""
        run_command(cls.parse, sys.argv[1:] or ["--help"])

    def command_line(self, arguments: Sequence[str]) -> str:
        """What somebody types to get the same again."""
        return f"{self.program()} {shlex.join(arguments)}"
