"""What a path says: which kind of file it is, and what was probably meant where nothing is."""

import difflib
import os
from pathlib import Path


def kind_of(path: Path | str) -> str:
    """The suffix of a file's name, which says what kind of file it is, in lower case: cameras write .JPG."""
    return Path(path).suffix.lower()


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
    meant = [missing.with_name(name) for name in difflib.get_close_matches(missing.name, names, n=1)]
    whole = [found / rest for found in meant if (found / rest).exists()]
    return f"did you mean {(whole or meant)[0]}?" if meant else "check the path"
