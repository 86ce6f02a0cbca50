"""The list of commands, and which of them a command line asks for. Imports no torch, so that help is fast."""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, make_dataclass
from typing import Annotated, Any, Union

import tyro

from etsplat.cli.command import Command, help_of
from etsplat.cli.data import Download, Sfm, Undistort
from etsplat.cli.doctor import Doctor
from etsplat.cli.evaluate import Evaluate
from etsplat.cli.export import Export
from etsplat.cli.reconstruct import Demo, Reconstruct
from etsplat.cli.render import Render
from etsplat.cli.train import DemoScene, Train
from etsplat.cli.view import View


@dataclass(frozen=True)
class Group:
    """Commands under a common word, as in `etsplat data download`.

    Attributes:
        help: what they have in common.
        commands: by name; two at least, or tyro sees no choice to make.
    """

    help: str
    commands: dict[str, type[Command]]


COMMANDS: dict[str, type[Command] | Group] = {
    "demo": Demo,
    "reconstruct": Reconstruct,
    "train": Train,
    "data": Group(
        "Where captures come from: find the cameras of photos, remove lens distortion, fetch data sets.",
        {"sfm": Sfm, "undistort": Undistort, "download": Download},
    ),
    "eval": Evaluate,
    "view": View,
    "render": Render,
    "export": Export,
    "doctor": Doctor,
}

# tyro joins the lines of a paragraph, except indented ones.
_ETSPLAT = """Differentiable triangle splatting: posed images in, triangles out.

    etsplat demo                                      see it work
    etsplat demo scene                                the same on a scene, as a triangle soup
    etsplat reconstruct bunny.obj --out runs/bunny    reconstruct a mesh from pictures of it
    etsplat train my_scene/ --out runs/scene          fit a triangle soup to photos
    etsplat train --help                              every option
"""


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments ask for. `--help` and wrong options end the process, as tyro does.

    Raises:
        InputError: a setting is out of its range.
    """
    # `demo` with and without "scene" are two commands with options of their own.
    demo = {"demo": DemoScene} if list(arguments[:2]) == ["demo", "scene"] else {}
    commands: Any = _union({**COMMANDS, **demo}, arguments, 0)
    parsed = tyro.cli(
        commands,
        prog="etsplat",
        description=_ETSPLAT,
        args=list(arguments) or ["--help"],
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )
    return parsed if isinstance(parsed, Command) else parsed.command


def _union(commands: Mapping[str, type[Command] | Group], arguments: Sequence[str], depth: int) -> Any:
    """A type that tyro reads as one of the commands."""
    asked = arguments[depth] if depth < len(arguments) else ""
    return Union[tuple(_member(name, entry, arguments, name == asked, depth) for name, entry in commands.items())]  # noqa: UP007


def _member(name: str, entry: type[Command] | Group, arguments: Sequence[str], asked: bool, depth: int) -> Any:
    if isinstance(entry, Group):
        members = _union(entry.commands, arguments, depth + 1)
        group = make_dataclass(name, [("command", members)], frozen=True)
        return Annotated[group, tyro.conf.OmitArgPrefixes, tyro.conf.subcommand(name, description=entry.help)]
    # The list of all commands has no room for examples.
    description = help_of(entry) if asked else inspect.cleandoc(entry.__doc__ or "")
    return Annotated[entry, tyro.conf.subcommand(name, default=entry.defaults(arguments), description=description)]
