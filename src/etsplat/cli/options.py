"""The commands' options as dataclasses: names, defaults and `--help` texts. Imports no torch, so that help is fast."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from etsplat.tasks.reconstruct_config import PRESETS, ReconstructConfig

Settings = Annotated[ReconstructConfig, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


@dataclass(frozen=True)
class Demo:
    """Reconstruct an object that is built in code: nothing to download, nothing to choose."""

    settings: Settings
    out: Path = Path("runs/demo")
    """Folder for the results."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    resume: bool = False
    """Continue an interrupted run in the folder."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Reconstruct:
    """Deform a sphere into the object that pictures show."""

    source: tyro.conf.Positional[Path]
    """A mesh file, which is photographed from 40 sides; or a folder with posed images (transforms.json or COLMAP)."""
    out: Path
    """Folder for the results: mesh.ply, mesh.obj, mesh.glb, metrics.json, report.html and more."""
    settings: Settings
    init_mesh: Path | None = None
    """Start from this mesh instead of a sphere; in the units of the source."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    resume: bool = False
    """Continue an interrupted run in the folder; give the same options as then."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Doctor:
    """Say what this installation can do: engine, instruction set, threads, versions, and what is missing for what."""

    debug: bool = False
    """Show the traceback of an error."""


Command = Demo | Reconstruct | Doctor

# tyro joins the lines of a paragraph, except indented ones.
_ETSPLAT = """Differentiable triangle splatting: posed images in, triangles out.

    etsplat demo                                      see it work
    etsplat reconstruct bunny.obj --out runs/bunny    reconstruct a mesh from pictures of it
    etsplat reconstruct --help                        every option
"""
_EXAMPLES = {
    "demo": """Examples:
    etsplat demo
    etsplat demo --out owl --method bilateral
    etsplat demo --preset tiny --overwrite
""",
    "reconstruct": """Examples:
    etsplat reconstruct bunny.obj --out runs/bunny
    etsplat reconstruct bunny.obj --out runs/bunny --preset paper
    etsplat reconstruct bunny.obj --out runs/bunny --preset paper --resume
    etsplat reconstruct my_scene/ --out runs/scene --iterations 4000
""",
}


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments ask for. `--help` and wrong options end the process, as tyro does.

    Raises:
        InputError: a setting is out of its range.
    """
    reconstruct = Reconstruct(source=tyro.MISSING, out=tyro.MISSING, settings=_preset(arguments, "quick"))
    demo = Demo(settings=_preset(arguments, "demo"))
    asked = arguments[0] if arguments else ""

    def subcommand(name: str, default: Command) -> object:
        # The list of all commands has no room for examples.
        examples = f"\n\n{_EXAMPLES[name]}" if name == asked and name in _EXAMPLES else ""
        return tyro.conf.subcommand(name, default=default, description=f"{default.__doc__}{examples}")

    commands = (
        Annotated[Demo, subcommand("demo", demo)]
        | Annotated[Reconstruct, subcommand("reconstruct", reconstruct)]
        | Annotated[Doctor, subcommand("doctor", Doctor())]
    )
    return tyro.cli(
        commands,  # pyright: ignore[reportArgumentType]
        prog="etsplat",
        description=_ETSPLAT,
        args=list(arguments) or ["--help"],
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _preset(arguments: Sequence[str], default: str) -> ReconstructConfig:
    """The settings of the preset that the arguments name: the defaults of all other options depend on it."""
    name = default
    for position, argument in enumerate(arguments):
        if argument == "--preset":
            name = "".join(arguments[position + 1 : position + 2])
        elif argument.startswith("--preset="):
            name = argument.removeprefix("--preset=")
    return PRESETS.get(name, PRESETS[default])  # tyro refuses an unknown name
