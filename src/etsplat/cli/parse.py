"""The list of commands, and which of them a command line asks for. Imports no torch, so that help is fast."""

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, make_dataclass
from functools import partial
from typing import Annotated, Any, Literal, Union, get_type_hints

import tyro

from etsplat.cli.command import Command
from etsplat.cli.data import Download, Masks, Sfm, Undistort
from etsplat.cli.doctor import Doctor
from etsplat.cli.runs import DemoObject, DemoScene, Reconstruct, Train
from etsplat.cli.soups import Evaluate, Export, Render, View
from etsplat.cli.sweeps import SweepReconstruct, SweepTrain
from etsplat.cli.tuning import TuneReconstruct, TuneTrain
from etsplat.core.errors import InputError
from etsplat.tasks.settings import OneOf, Rare, Setting, Settings, did_you_mean, docs_of, settings_of


@dataclass(frozen=True)
class Group:
    """Commands under a common word, as in `etsplat data download`.

    Attributes:
        help: what they have in common.
        commands: by name; two at least, or tyro sees no choice to make.
        default: which of them is meant where none is named; without it, one must be.
    """

    help: str
    commands: "Mapping[str, type[Command] | Group]"
    default: str | None = None


COMMANDS: dict[str, type[Command] | Group] = {
    "demo": Group(
        "See it work on what is built in code; `etsplat demo` alone is `etsplat demo object`.",
        {"object": DemoObject, "scene": DemoScene},
        default="object",
    ),
    "reconstruct": Reconstruct,
    "train": Train,
    "data": Group(
        "Where captures come from: find the cameras of photos, mask objects, remove lens distortion, fetch data sets.",
        {"sfm": Sfm, "masks": Masks, "undistort": Undistort, "download": Download},
    ),
    "sweep": Group(
        "Any settings against each other on any inputs, on this machine or a cluster; a table and a page at the end.",
        {"reconstruct": SweepReconstruct, "train": SweepTrain},
    ),
    "tune": Group(
        "Search good settings, where a sweep of all combinations would take too long (needs optuna).",
        {"reconstruct": TuneReconstruct, "train": TuneTrain},
    ),
    "eval": Evaluate,
    "view": View,
    "render": Render,
    "export": Export,
    "doctor": Doctor,
}

# tyro joins the lines of a paragraph, except indented ones.
_ETSPLAT = """Differentiable triangle splatting: posed images in, triangles out.

Examples:
    etsplat demo object                               see it work
    etsplat demo scene                                the same on a scene, as a triangle soup
    etsplat reconstruct bunny.obj --out runs/bunny    reconstruct a mesh from pictures of it
    etsplat train my_scene/ --out runs/scene          fit a triangle soup to photos
    etsplat train --help                              what can be set; --help-all for the rest
    etsplat --version                                 which one this is; etsplat doctor says more
"""


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments ask for. `--help` and wrong options end the process, as tyro does.

    Raises:
        InputError: there is no such command, or a setting is out of its range.
    """
    words = [re.sub(r"^(--method=)?single_sided$", r"\1single-sided", word) for word in arguments] or ["--help"]
    if words[0] == "export":
        words = ["--sky=none" if word == "--no-sky" else word for word in words]  # as of `etsplat render`
    registry = _registry(brief=("--help" in words or "-h" in words) and "--help-all" not in words)
    entry: type[Command] | Group = Group(_ETSPLAT, COMMANDS)
    program = ["etsplat"]
    while isinstance(entry, Group):
        if words and not words[0].startswith("-"):
            word = words.pop(0)
        elif entry.default is not None and words[:1] not in (["-h"], ["--help"]):
            word = entry.default
        else:
            break
        if word not in entry.commands:
            hint = did_you_mean(word, entry.commands)
            raise InputError(
                f"{word}: is no command{f'{hint} ' if hint else '; '}`{' '.join(program)} --help` lists them"
            )
        program.append(word)
        entry = entry.commands[word]
    listing = isinstance(entry, Group)
    asked, default = _listed(entry) if listing else (entry, entry.defaults(words))
    return tyro.cli(
        asked,
        prog=" ".join(program),
        description=entry.help if listing else inspect.cleandoc(entry.__doc__ or ""),
        args=["--help" if word == "--help-all" else word for word in words],
        default=default,
        registry=registry,
    )


def _listed(group: Group) -> tuple[Any, Any]:
    """What tyro is to list a group's commands by, and which of them is the default.

    Each has the first sentences of its help; nobody asks for its options here.
    """
    kinds = {name: make_dataclass(name, []) for name in group.commands}
    entries = []
    for name, entry in group.commands.items():
        text = entry.help if isinstance(entry, Group) else inspect.cleandoc(entry.__doc__ or "").partition("\n\n")[0]
        entries.append(Annotated[kinds[name], tyro.conf.subcommand(name, description=text)])
    return Union[tuple(entries)], tyro.MISSING if group.default is None else kinds[group.default]()  # noqa: UP007


def _offered(setting: Setting) -> Any:
    """A type that tyro reads as one of the words that there are by now; of files, which the setting itself checks."""
    if setting.suffix:
        words: Any = Annotated[str, tyro.conf.arg(metavar=f"{{{','.join(setting.choices)},FILE{setting.suffix}}}")]
        return words | None if setting.optional else words
    # None as one of them: of a union tyro's errors would list the words in another order each time.
    return Literal[(*setting.choices, *([None] if setting.optional else []))]  # pyright: ignore[reportInvalidTypeForm]


def _registry(*, brief: bool) -> tyro.constructors.ConstructorRegistry:
    """How tyro is to read commands and configs: in brief, without groups and what is `Rare`."""
    registry = tyro.constructors.ConstructorRegistry()
    registry.struct_rule(partial(_struct, brief=brief))
    return registry


def _struct(info: tyro.constructors.StructTypeInfo, *, brief: bool) -> tyro.constructors.StructConstructorSpec | None:
    """The options of a command or config; None of what is neither."""
    # By its metaclass: on Python 3.10 `isinstance` takes an alias such as tuple[int, ...] for a class.
    if not (issubclass(type(info.type), type) and issubclass(info.type, Command | Settings)):
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
