"""Locks on files, and what they keep: the folder of a run, and scratch folders.

They end with the process that holds them, however it ends; its children do not hold them.
"""

import contextlib
import glob
import os
import shutil
import socket
import tempfile
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from etsplat.core.errors import InputError
from etsplat.io.atomic import write_error

RUN_LOCK = ".lock"
"""In the folder of a run while somebody writes it; says who. A killed process leaves the file, not the lock."""

_MARK = "etsplat-working"
"""File of a scratch folder that its process keeps locked."""

_held: "weakref.WeakSet[IO[bytes]]" = weakref.WeakSet()


def lock_file(file: IO[bytes]) -> None:
    """Locks an open file until it is closed.

    Raises:
        BlockingIOError: it is locked, by another process or through another opening in this one.
        OSError: this system, or this file's, has no such locks.
    """
    try:
        import fcntl
    except ImportError as error:
        raise OSError("no file locks on this system") from error
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    _held.add(file)


@contextlib.contextmanager
def writing_run(folder: Path, tell: Callable[[str], None]) -> Iterator[None]:
    """Within the block nobody else writes the run in a folder; reading needs no lock.

    Args:
        folder: made if it does not exist.
        tell: called with a sentence where there are no file locks: then nothing keeps others away.

    Raises:
        InputError: somebody writes it, the message says which process; or nothing can be written there.
    """
    path = folder / RUN_LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = _open_locked(path)
    except BlockingIOError as error:
        raise _refusal(folder) from error
    except OSError as error:
        raise write_error(folder, error) from error
    if file is None:
        tell(f"{folder}: there are no file locks here, so take care yourself that no second process writes this run")
        yield
        return
    with file:
        try:
            yield
        finally:
            if not file.closed:  # as it is in a child that leaves the block too
                path.unlink(missing_ok=True)


def check_nobody_writes(folder: Path) -> None:
    """Raises InputError if somebody writes the run in a folder, which need not exist."""
    try:
        with open(folder / RUN_LOCK, "rb") as file:
            lock_file(file)
    except BlockingIOError as error:
        raise _refusal(folder) from error
    except OSError:  # nobody has begun to, or no locks
        pass


def was_killed(folder: Path) -> bool:
    """Whether who wrote the run in a folder ended without a word, as far as this machine knows; takes no lock."""
    try:
        _, number, _, host = (folder / RUN_LOCK).read_text(encoding="utf-8", errors="replace").split()
        if host != socket.gethostname() or os.name == "nt":
            return False
        os.kill(int(number), 0)
    except ProcessLookupError:
        return True
    except (OSError, ValueError, OverflowError):  # no lock, or that of another user's process
        return False
    return False


@contextlib.contextmanager
def scratch_folder(beside: Path) -> Iterator[Path]:
    """A folder of a random name beside a path that will exist, for this user alone, and gone afterwards.

    A process that is killed leaves its own behind. The next one for the same path removes it.

    Raises:
        OSError: it cannot be made.
    """
    _remove_abandoned(beside)
    with (
        tempfile.TemporaryDirectory(prefix=f".{beside.name}-", dir=beside.parent) as folder,
        open(Path(folder) / f"{_MARK}.new", "wb") as mark,
    ):
        with contextlib.suppress(OSError):  # where there are no locks nobody finds the mark, nor removes this
            lock_file(mark)
            os.rename(mark.name, Path(folder) / _MARK)  # locked from the moment that it has its name
        yield Path(folder)


def _remove_abandoned(beside: Path) -> None:
    """Removes scratch folders whose processes have ended."""
    for mark in beside.parent.glob(f".{glob.escape(beside.name)}-*/{_MARK}"):
        with contextlib.suppress(OSError), open(mark, "rb") as file:  # locked, by a living process; or just removed
            lock_file(file)
            shutil.rmtree(mark.parent)


def _open_locked(path: Path) -> IO[bytes] | None:
    """The file, new or left over, locked and with the name of this process in it. None where there are no locks."""
    while True:
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "a+b"))
            try:
                lock_file(file)
            except BlockingIOError:
                raise
            except OSError:
                path.unlink(missing_ok=True)
                return None
            if not _is_at(path, file):  # whoever had it removed it before it was locked
                continue
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
            file.flush()
            stack.pop_all()
            return file


def _is_at(path: Path, file: IO[bytes]) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _refusal(folder: Path) -> InputError:
    try:
        holder = (folder / RUN_LOCK).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        holder = []
    who = holder[0] if holder else "another process"  # which has not said so yet
    return InputError(f"{folder}: {who} is writing this run; wait for it, end it, or choose another folder")


def _forget() -> None:
    """In a child, which would go on holding the locks of its parent when that has ended."""
    for file in list(_held):
        file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
