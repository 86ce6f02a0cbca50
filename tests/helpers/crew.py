"""Processes that wait for something to do together: started once, since each imports torch for seconds."""

import multiprocessing
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

PATIENCE = 120.0


class Crew:
    """So many processes, of which some or all act together."""

    def __init__(self, size: int, meeting: Path) -> None:
        context = multiprocessing.get_context("spawn")
        pipes = [context.Pipe() for _ in range(size)]
        self._pipes: Sequence[Connection] = [here for here, _ in pipes]
        self._processes = [context.Process(target=_serve, args=(there,), daemon=True) for _, there in pipes]
        for process in self._processes:
            process.start()
        self._meeting, self._times = meeting, 0

    def act(self, count: int, what: Callable[..., Any], *arguments: Any) -> list[Any]:
        """What a function of a module of helpers returns in each of the first `count` processes, or its error."""
        self._times += 1
        place = f"file://{self._meeting / f'meeting_{self._times}'}"
        for rank, pipe in enumerate(self._pipes[:count]):
            pipe.send((what, arguments, place, rank, count))
        found = []
        for pipe in self._pipes[:count]:
            if not pipe.poll(PATIENCE):
                raise TimeoutError(f"{what.__name__}: a worker does not answer")
            found.append(pipe.recv())
        return found

    def end(self) -> None:
        for process in self._processes:
            process.kill()
            process.join()


@contextmanager
def crew_of(size: int, meeting: Path) -> Iterator[Crew]:
    crew = Crew(size, meeting)
    try:
        yield crew
    finally:
        crew.end()


def _serve(pipe: Connection) -> None:
    import torch

    from etsplat.core.workers import together

    torch.set_num_threads(1)
    while True:
        what, arguments, place, rank, count = pipe.recv()
        try:
            with together(place, rank=rank, count=count):
                found = what(*arguments)
        except Exception as error:
            error.add_note(traceback.format_exc()) if hasattr(error, "add_note") else None
            found = error
        pipe.send(found)
