"""How messages spell settings: as options of the command line where that runs, else as arguments of Python.

One state of the process, which all of its threads see. Imports no torch, since modules of commands and settings do not.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from types import EllipsisType

_as_options = False


def by_options() -> bool:
    """Whether the command line runs, in whose words settings are spelled."""
    return _as_options


@contextmanager
def spelled_as_options(on: bool = True) -> Iterator[None]:
    """Within the block messages are those of the command line; or with False, of Python. Also around a function."""
    global _as_options
    before, _as_options = _as_options, on
    try:
        yield
    finally:
        _as_options = before


def either(options: str, python: str) -> str:
    """The first for the command line, the second for Python: of what a function of Python has another way for."""
    return options if _as_options else python


def option(name: str, *values: object) -> str:
    """A setting, as somebody gives it to a command, or to a function or config of Python.

    Args:
        name: of the argument or setting in Python, dotted in a group.
        values: one, or those to choose from; True or False of a flag. `...` stands for one that is not said:
            `--scene`, and `scene=`. With none at all it is the setting's name: `--min-opacity`, and `min_opacity`.

    Returns:
        Such as `--start.shape hull`, `--up y or z`, `--resume`; and `start.shape="hull"`, `up="y" or "z"`,
        `resume=True`.
    """
    if _as_options:
        return as_option(name, *values)
    if not values:
        return name
    return f"{name}={' or '.join(map(_in_python, values))}"


def as_option(name: str, *values: object) -> str:
    """The words of the command line for a setting, whoever asks; arguments as of `option`, and nothing is quoted."""
    group, dot, last = name.replace("_", "-").rpartition(".")
    given = [value for value in values if not isinstance(value, bool | EllipsisType)]
    said = f" {' or '.join(map(str, given))}" if given else ""
    return f"--{group}{dot}{'no-' * any(value is False for value in values)}{last}{said}"


def file_kind(*kinds: str) -> str:
    """One of the kinds of files, without their dots, where a command has `--format` and Python the file's name."""
    return either(f"--format {' or '.join(kinds)}", f"a path that ends in {' or '.join(f'.{kind}' for kind in kinds)}")


def _in_python(value: object) -> str:
    if isinstance(value, EllipsisType):
        return ""
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else str(value)
