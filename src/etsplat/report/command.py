"""The command line that repeats a run."""

import shlex
from typing import Any

from etsplat.core.spelling import as_option
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import Settings, flatten
from etsplat.tasks.train_config import TrainConfig

CONFIGS: dict[str, type[Settings]] = {kind.TASK: kind for kind in (ReconstructConfig, TrainConfig)}


def reproduce_command(config: dict[str, Any], version: str) -> str | None:
    """The command line of a run, one option a line; None if the run was given objects from Python instead of paths.

    Args:
        config: the run's config.json.
        version: of this etsplat. Settings that the preset implies are left out if the run was made with the same.
    """
    settings, paths, same = config["config"], config["paths"], config["versions"]["etsplat"] == version
    if paths["source"] is None or (paths.get("init_mesh", "") is None and config["source"].get("init_mesh")):
        return None
    kind = CONFIGS[config["task"]]
    implied = flatten(kind.based_on(settings).to_dict())
    words = [f"etsplat {config['task']} {shlex.quote(paths['source'])} --out DIR"]
    if paths["source"] == "demo:scene":
        words = ["etsplat demo scene --out DIR"]
    words += [_given(name, paths[name]) for name in ("init_mesh", "images", "masks", "blocks") if paths.get(name)]
    words += [_given(name, settings[name]) for name in kind.LABELS]
    for name, value in flatten(settings).items():
        if name not in kind.LABELS and (not same or name not in implied or implied[name] != value):
            words.append(_given(name, value))
    return " \\\n    ".join(words)


def _given(name: str, value: object) -> str:
    """How a setting is given on the command line, for a shell."""
    return as_option(name, value if isinstance(value, bool) else shlex.quote(str(value)))
