"""The list of commands, and which of them a command line asks for. Imports no torch, so that help is fast."""

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, make_dataclass
from typing import Annotated, Any, Literal, Union, get_type_hints

import tyro

from etsplat.cli.command import Command
from etsplat.cli.data import Download, Sfm, Undistort
from etsplat.cli.doctor import Doctor
from etsplat.cli.runs import DemoObject, DemoScene, Reconstruct, Train
from etsplat.cli.soups import Evaluate, Export, Render, View
from etsplat.core.errors import InputError
from etsplat.tasks.settings import OneOf, Rare, Setting, Settings, did_you_mean, docs_of, settings_of


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
    "demo": Group(
        "See it work on what is built in code; `etsplat demo` alone is `etsplat demo object`.",
        {"object": DemoObject, "scene": DemoScene},
    ),
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

    etsplat demo object                               see it work
    etsplat demo scene                                the same on a scene, as a triangle soup
    etsplat reconstruct bunny.obj --out runs/bunny    reconstruct a mesh from pictures of it
    etsplat train my_scene/ --out runs/scene          fit a triangle soup to photos
    etsplat train --help                              what can be set; --help-all for the rest
"""


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments ask for. `--help` and wrong options end the process, as tyro does.

    Raises:
        InputError: there is no such command, or a setting is out of its range.
    """
    words = [re.sub(r"^(--method=)?single_sided$", r"\1single-sided", word) for word in arguments] or ["--help"]
    if words[0] == "demo" and (len(words) == 1 or (words[1].startswith("-") and words[1] not in ("-h", "--help"))):
        words.insert(1, "object")
    _check_command(words)
    parsed = tyro.cli(
        _union(COMMANDS, words, 0),
        prog="etsplat",
        description=_ETSPLAT,
        args=["--help" if word == "--help-all" else word for word in words],
        config=(tyro.conf.OmitSubcommandPrefixes,),
        registry=_registry(brief=("--help" in words or "-h" in words) and "--help-all" not in words),
    )
    return parsed if isinstance(parsed, Command) else parsed.command


def _check_command(words: Sequence[str]) -> None:
    """Refuses words that name no command, before tyro takes them for options."""
    known: Mapping[str, type[Command] | Group] = COMMANDS
    for depth, word in enumerate(words):
        if word.startswith("-") or not known:
            return
        if word not in known:
            program, hint = " ".join(["etsplat", *words[:depth]]), did_you_mean(word, known)
            raise InputError(f"{word}: is no command{f'{hint} ' if hint else '; '}`{program} --help` lists them")
        entry = known[word]
        known = entry.commands if isinstance(entry, Group) else {}


def _union(commands: Mapping[str, type[Command] | Group], words: Sequence[str], depth: int) -> Any:
    """A type that tyro reads as one of the commands. Those that are not asked for have a name and a line of help."""
    asked = words[depth] if depth < len(words) else ""
    return Union[tuple(_member(name, entry, words, name == asked, depth) for name, entry in commands.items())]  # noqa: UP007


def _member(name: str, entry: type[Command] | Group, words: Sequence[str], asked: bool, depth: int) -> Any:
    description = entry.help if isinstance(entry, Group) else inspect.cleandoc(entry.__doc__ or "")
    if not asked:
        description = description.partition("\n\nExamples:")[0]
        return Annotated[make_dataclass(name, []), tyro.conf.subcommand(name, description=description)]
    if isinstance(entry, Group):
        commands = Annotated[_union(entry.commands, words, depth + 1), tyro.conf.arg(name="")]
        group = make_dataclass(name, [("command", commands)], frozen=True)
        return Annotated[group, tyro.conf.subcommand(name, description=description)]
    return Annotated[entry, tyro.conf.subcommand(name, default=entry.defaults(words), description=description)]


def _offered(setting: Setting) -> Any:
    """A type that tyro reads as one of the words that there are by now."""
    words: Any = Literal[setting.choices]  # pyright: ignore[reportInvalidTypeForm]
    return words | None if setting.optional else words


def _registry(*, brief: bool) -> tyro.constructors.ConstructorRegistry:
    """How tyro is to read commands and configs: in brief, without groups and what is `Rare`."""
    registry = tyro.constructors.ConstructorRegistry()

    @registry.struct_rule
    def rule(info: tyro.constructors.StructTypeInfo) -> tyro.constructors.StructConstructorSpec | None:
        if not (isinstance(info.type, type) and issubclass(info.type, Command | Settings)):
            return None
        hints, docs = get_type_hints(info.type, include_extras=True), docs_of(info.type)
        specs = []
        for field in fields(info.type):
            hint, value = hints[field.name], getattr(info.default, field.name)
            group = is_dataclass(value) and not isinstance(value, Settings)
            extras = getattr(hint, "__metadata__", ())
            hidden = brief and (group or Rare in extras)
            kind: Any = _offered(settings_of(info.type)[field.name]) if OneOf in map(type, extras) else hint
            kind = Annotated[kind, tyro.conf.Suppress] if hidden else kind
            specs.append(tyro.constructors.StructFieldSpec(field.name, kind, value, docs.get(field.name)))
        return tyro.constructors.StructConstructorSpec(info.type, tuple(specs))

    return registry
