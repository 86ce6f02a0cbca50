"""One run as it is handed to a process somewhere, and what that process does with it. Imports no torch at its top."""

import contextlib
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.core.spelling import by_options, spelled_as_options
from etsplat.io.atomic import write_error
from etsplat.io.locks import check_nobody_writes
from etsplat.io.run_directory import is_run
from etsplat.tasks.settings import Settings

PATIENCE = 60.0
"""Seconds to wait for whoever still writes the run: a process that is thought dead may take a while to end."""


@dataclass(frozen=True)
class Work:
    """A run, for any process on any machine that sees the same folders; all of it can be pickled.

    Attributes:
        run: a function of a module, ``run(source, folder, config, resume=..., callbacks=..., **options)``.
        source: its input.
        folder: run directory.
        config: settings.
        options: what `run` takes besides.
        threads: of the engine and of torch.
        store: where the run directory is kept, as fsspec names it ("s3://..."); None for the folder alone.
        options_spelled: whether errors spell settings as the command line does, as where the work was made.
    """

    run: Callable[..., object]
    source: str
    folder: Path
    config: Settings
    options: Mapping[str, Any] = field(default_factory=dict)
    threads: int = 1
    store: str | None = None
    options_spelled: bool = field(default_factory=by_options)

    @property
    def log(self) -> Path:
        """Beside the folder: what was said of the run, of all attempts at it."""
        return log_of(self.folder)


def log_of(folder: Path) -> Path:
    """Where what was said of a run in a folder stands."""
    return folder.parent / f"{folder.name}.log"


def perform(work: Work) -> str:
    """Makes a run, or goes on with it from its last checkpoint, in this process.

    Returns:
        Nothing, or in a line why it failed: it would fail again. The log has the traceback.

    Raises:
        KeyboardInterrupt: the process was interrupted; a checkpoint of the last whole iteration is written.
    """
    try:
        with _logging(work.log) as tell:
            try:
                with spelled_as_options(work.options_spelled):
                    _perform(work, tell)
            except Exception as error:
                if not isinstance(error, InputError):
                    tell(traceback.format_exc())
                tell(f"failed: {_line(error)}")
                return _line(error)
    except (InputError, OSError) as error:  # of the log
        return _line(error)
    return ""


def _perform(work: Work, tell: Callable[[str], None]) -> None:
    from etsplat.optim.loop import CheckpointEvent, Event, NoteEvent, UndoEvent

    store = None
    if work.store is not None:
        from etsplat.tasks.sweeps.store import Store

        store = Store(work.store, work.folder)
    wait_for_writer(work.folder)
    if store is not None and not is_run(work.folder):
        store.fetch()
    resume = is_run(work.folder)
    tell(f"{'goes on' if resume else 'begins'} with {work.threads} thread{'s' * (work.threads != 1)}")

    def note(event: Event) -> None:
        if isinstance(event, NoteEvent | UndoEvent | CheckpointEvent):
            tell(str(event))
        if isinstance(event, CheckpointEvent) and store is not None:
            store.keep()

    try:
        with _on_threads(work.threads):
            work.run(work.source, work.folder, work.config, resume=resume, callbacks=[note], **work.options)
    finally:
        if store is not None and is_run(work.folder):
            store.keep()
    tell("done")


@contextlib.contextmanager
def _on_threads(count: int) -> Iterator[None]:
    """Within the block the engine and torch use so many; some of torch's sums depend on their number."""
    import torch

    from etsplat.engines.threads import num_threads, set_num_threads

    before = num_threads(), torch.get_num_threads()
    set_num_threads(count)
    torch.set_num_threads(count)
    try:
        yield
    finally:
        set_num_threads(before[0])
        torch.set_num_threads(before[1])


def wait_for_writer(folder: Path, patience: float = PATIENCE) -> None:
    """Returns once nobody writes the run in a folder.

    Raises:
        InputError: somebody still does after so many seconds.
    """
    until = time.monotonic() + patience
    while True:
        try:
            return check_nobody_writes(folder)
        except InputError:
            if time.monotonic() > until:
                raise
        time.sleep(0.2)


@contextlib.contextmanager
def _logging(path: Path) -> Iterator[Callable[[str], None]]:
    """What appends a text to a log, with the time before it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "a", encoding="utf-8", buffering=1)  # noqa: SIM115
    except OSError as error:
        raise write_error(path, error) from error
    with file:
        yield lambda text: print(f"{datetime.now():%Y-%m-%d %H:%M:%S} {text}", file=file)


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or repr(error)
