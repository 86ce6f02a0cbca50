"""The command line that repeats a run."""

import shlex
from typing import Any

from etsplat.tasks.reconstruct_config import PRESETS


def reproduce_command(config: dict[str, Any], version: str) -> str | None:
    """The command line of a run, one option a line; None if the run was given objects from Python instead of paths.

    Args:
        config: the run's config.json.
        version: of this etsplat. Settings that the preset implies are left out if the run was made with the same.
    """
    paths, source = config["paths"], config["source"]
    if paths["source"] is None or (source["init_mesh"] and paths["init_mesh"] is None):
        return None
    words = [f"etsplat reconstruct {shlex.quote(paths['source'])} --out DIR"]
    if paths["init_mesh"]:
        words.append(f"--init-mesh {shlex.quote(paths['init_mesh'])}")
    settings = config["config"]
    words.append(f"--preset {settings['preset']}")
    implied = vars(PRESETS[settings["preset"]]) if config["versions"]["etsplat"] == version else {}
    for name, value in settings.items():
        if name != "preset" and (name not in implied or implied[name] != value):
            words.append(f"--{name.replace('_', '-')} {shlex.quote(str(value))}")
    return " \\\n    ".join(words)
