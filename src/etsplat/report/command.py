"""The command line that repeats a run."""

import shlex
from typing import Any

from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import flatten
from etsplat.tasks.train_config import TrainConfig


def reproduce_command(config: dict[str, Any], version: str) -> str | None:
    """The command line of a run, one option a line; None if the run was given objects from Python instead of paths.

    Args:
        config: the run's config.json.
        version: of this etsplat. Settings that the preset implies are left out if the run was made with the same.
    """
    settings, same = config["config"], config["versions"]["etsplat"] == version
    if config["paths"]["source"] is None:
        return None
    if config["task"] == "train":
        words, implied = _train_words(config["paths"], settings)
    else:
        if config["source"]["init_mesh"] and config["paths"]["init_mesh"] is None:
            return None
        words, implied = _reconstruct_words(config["paths"], settings)
    for name, value in flatten(settings).items():
        if name not in ("preset", "scene_type") and (not same or name not in implied or implied[name] != value):
            words.append(_option(name, value))
    return " \\\n    ".join(words)


def _option(name: str, value: object) -> str:
    """How a setting is given on the command line."""
    group, dot, last = name.replace("_", "-").rpartition(".")
    if isinstance(value, bool):
        return f"--{group}{dot}{'' if value else 'no-'}{last}"
    return f"--{group}{dot}{last} {shlex.quote(str(value))}"


def _reconstruct_words(paths: dict[str, Any], settings: dict[str, Any]) -> tuple[list[str], dict[str, Any]]:
    """How the command begins, and the settings that its preset implies."""
    words = [f"etsplat reconstruct {shlex.quote(paths['source'])} --out DIR"]
    if paths["init_mesh"]:
        words.append(f"--init-mesh {shlex.quote(paths['init_mesh'])}")
    words.append(f"--preset {settings['preset']}")
    return words, flatten(ReconstructConfig.of(settings["preset"]).to_dict())


def _train_words(paths: dict[str, Any], settings: dict[str, Any]) -> tuple[list[str], dict[str, Any]]:
    """The same for a soup."""
    source = paths["source"]
    words = [f"etsplat train {shlex.quote(source)} --out DIR"]
    if source == "demo:scene":
        words = ["etsplat demo scene --out DIR"]
    words += [f"--{name} {shlex.quote(paths[name])}" for name in ("images", "masks") if paths.get(name)]
    words += [f"--preset {settings['preset']}", f"--scene-type {settings['scene_type']}"]
    return words, flatten(TrainConfig.of(settings["preset"], settings["scene_type"]).to_dict())
