"""Inputs that are built in code, by name. Imports no torch."""

from pathlib import Path

from etsplat.core.errors import InputError

DEMO_OBJECT, DEMO_SCENE = "demo:owl", "demo:scene"
TASKS = {DEMO_OBJECT: "reconstruct", DEMO_SCENE: "train"}
"""Which task takes which."""


def check_demo(source: str | Path, task: str) -> None:
    """Raises InputError if it is named as they are, and is none, or one for another task."""
    name = str(source)
    if name in TASKS and TASKS[name] != task:
        raise InputError(f"{name}: is for `etsplat {TASKS[name]}`; name another input")
    if name.startswith("demo:") and name not in TASKS and not Path(source).exists():
        known = " and ".join(f"{demo} for `etsplat {kind}`" for demo, kind in TASKS.items())
        raise InputError(f"{name}: is not built in; there are {known}")
