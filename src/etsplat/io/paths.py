"""What a path says: which kind of file it is, and what was probably meant where nothing is."""

import difflib
import os
from pathlib import Path, PurePosixPath, PureWindowsPath

from etsplat.core.errors import InputError


def kind_of(path: Path | str) -> str:
    """The suffix of a file's name, which says what kind of file it is, in lower case: cameras write .JPG."""
    return given_path("path", path).suffix.lower()


def given_path(name: str, path: object, what: str = "a path") -> Path:
    """What was given as a path. Raises InputError, with the name of the argument, where it is none.

    Args:
        name: of the argument.
        path: what was given.
        what: what it must be, as it follows "it must be".
    """
    if not isinstance(path, str | os.PathLike):
        got = "None" if path is None else f"of type {type(path).__name__}"
        raise InputError(f"{name}: is {got}; it must be {what}")
    return Path(path)


def path_within(folder: Path, name: str, source: Path | str) -> Path:
    """Where the file lies that another file names: `folder` / `name`, never outside of the folder.

    Args:
        folder: what the name is relative to.
        name: with forward slashes or backslashes.
        source: the file that has the name, for the message.

    Raises:
        InputError: the name is empty, longer than names can be, absolute, of a drive, or leads out of the folder.
    """
    parts = PurePosixPath(name.replace("\\", "/")).parts
    try:
        longest = max(len(part.encode()) for part in parts)
    except ValueError:  # no part, or characters that are none
        longest = 0
    if not 0 < longest < 256 or len(name) > 2048 or any(character < " " for character in name):
        raise InputError(f"{source}: {name[:80]!r} is no file name; correct it there")
    if parts[0].startswith("/") or ".." in parts or PureWindowsPath(name).drive:
        raise InputError(f"{source}: {name!r} leads out of {folder}; copy the file there and name it in that folder")
    return folder / name


def path_remedy(path: Path | str) -> str:
    """The end of the error for a path that is not there, or no folder: what was probably meant, or to check it.

    Looks beside the first part of the path that is not there, for names that are spelled alike.
    """
    path = Path(path)
    if path.is_file():
        return "it is a file"
    missing, rest = path, Path()
    while not missing.parent.exists():
        missing, rest = missing.parent, missing.name / rest
    try:
        names = os.listdir(missing.parent)
    except OSError:  # may not be read, or is a file
        names = []
    if not missing.name.startswith("."):  # a command that was killed leaves hidden folders named like its result
        names = [name for name in names if not name.startswith(".")]
    meant = [missing.with_name(name) for name in difflib.get_close_matches(missing.name, names, n=1)]
    whole = [found / rest for found in meant if (found / rest).exists()]
    return f"did you mean {(whole or meant)[0]}?" if meant else "check the path"
