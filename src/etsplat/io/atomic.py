"""Files appear whole or not at all: every result is written beside its destination and renamed into place."""

import errno
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from etsplat.core.errors import InputError

_REMEDIES = {
    errno.ENOSPC: "free some space on that disk or choose another folder",
    errno.EDQUOT: "your disk quota is used up: free some space or choose another folder",
    errno.EFBIG: "the file would exceed the allowed file size: raise the limit or choose another folder",
    errno.EROFS: "choose a folder on a disk that can be written to",
    errno.EACCES: "choose a folder that you may write to",
    errno.EPERM: "choose a folder that you may write to",
    errno.ENOENT: "create the folder first",
    errno.EEXIST: "a file is in the way: choose another folder",
    errno.ENOTDIR: "a part of the path is a file: choose another folder",
    errno.EISDIR: "the path is a folder: choose a file name",
}

_TEMPORARY = re.compile(r"\.(.+)\.[0-9a-f]{8}(\.[^.]*)?")


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; move it onto `path` when the block succeeds.

    The temporary name keeps the suffix of `path`, so that writers which choose the format by suffix work. When the
    block raises, the temporary file is removed and whatever was at `path` before is untouched.

    Args:
        path: the destination. Its folder must exist.

    Yields:
        The path to write to.

    Raises:
        InputError: the disk is full, read-only, or refuses the write for another reason of the operating system.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, path)
    except OSError as error:
        raise write_error(path, error) from error
    finally:
        with suppress(FileNotFoundError, NotADirectoryError):
            temporary.unlink()


def destination_of(temporary: Path) -> Path | None:
    """Which file `atomic_write` was writing under a temporary path; None if that is none of its names."""
    found = _TEMPORARY.fullmatch(temporary.name)
    return found and temporary.with_name(found[1] + (found[2] or ""))


def write_error(path: Path | str, error: OSError) -> InputError:
    """The one-line InputError for a failed write to `path`: what the system said, and what to do."""
    reason = error.strerror or str(error) or type(error).__name__  # some libraries raise OSError without a number
    remedy = _REMEDIES.get(error.errno or 0, "check the disk and the folder's permissions")
    stays = " (an earlier version of the file is unchanged)" if os.path.isfile(path) else ""
    return InputError(f"cannot write {path}: {reason}; {remedy}{stays}")


def _flush(path: Path) -> None:
    # Without this a power cut after the rename can leave an empty file under the final name.
    with open(path, "rb+") as file:
        os.fsync(file.fileno())
