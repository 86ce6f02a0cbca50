"""The processes that make one run together: one alone, or as many as torchrun started.

A worker computes what nobody else does, and gets the rest from the others. Nothing is ever added up on the way: what
workers hand each other are whole results, which each of them then adds in the same order. So all hold the same bits,
those of one process alone.
"""

import contextlib
import os
import pickle
import platform
import re
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import timedelta
from importlib.metadata import version
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from etsplat import _native
from etsplat.core.errors import InputError

T = TypeVar("T")
S = TypeVar("S")

PATIENCE = timedelta(hours=12)
"""So long workers wait for one that is alive and silent, such as the first while it measures a large result. One that
was killed is found at once, by its closed connections."""

MEETING = timedelta(minutes=10)
"""So long those that have come wait for the others at the start."""

_DROPPED = 0.2
"""Seconds in which gloo's threads let go of the last message."""

_LAUNCHED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
_REPORTED = "etsplat/reported"


class WorkerLostError(RuntimeError):
    """Another worker of the run ended, or cannot be reached any more. The message is one line."""


class Workers:
    """Those that run together, as one of them sees it. With one all methods give back what they were given.

    Attributes:
        rank: which this is, from 0.
        count: how many there are.
        neighbours: how many of them, with this one, are on the same machine.
        sent: bytes that this one has handed to each other in `hand_round`, and how often.
    """

    def __init__(self, rank: int = 0, count: int = 1, store: Any = None) -> None:
        """Takes its place; more than one need torch's default process group. Use `together`."""
        self.rank, self.count, self.neighbours = rank, count, 1
        self.sent = {"bytes": 0, "messages": 0}
        self._store = store

    @property
    def leads(self) -> bool:
        """Whether this is the one that writes, prints and measures."""
        return self.rank == 0

    def any(self, flag: bool) -> bool:
        """Whether it is so on any of them; the same answer on all."""
        if self.count == 1:
            return flag
        return any(bool(other) for other in self._gather(torch.tensor([int(flag)])))

    def map(self, function: Callable[[S], T], items: Sequence[S]) -> list[T]:
        """The function's values, in the order of the items, of each of which one worker takes care."""
        if self.count == 1:
            return [function(items[index]) for index in range(len(items))]
        own = [function(items[index]) for index in range(self.rank, len(items), self.count)]
        found = self._gather_objects(own)
        return [found[index % self.count][index // self.count] for index in range(len(items))]

    def from_first(self, make: Callable[[], T]) -> T:
        """What the first one makes; an error that it runs into is raised on all."""
        if self.count == 1:
            return make()
        made: list[Any] = [None, None]
        if self.leads:
            try:
                made[0] = make()
            except Exception as error:
                made[1] = error
        with _reaching():
            dist.broadcast_object_list(made, src=0)
        if made[1] is not None:
            raise made[1]
        return made[0]

    def agree(self, about: Mapping[str, object]) -> None:
        """Checks that all have the same.

        Args:
            about: values by what they are called; their texts are compared.

        Raises:
            InputError: on all of them; the message names what differs first.
        """
        if self.count == 1:
            return
        texts = [dict(each) for each in self._gather_objects({name: str(value) for name, value in about.items()})]
        for rank, other in enumerate(texts):
            for name in sorted({*texts[0], *other}):
                mine, theirs = texts[0].get(name, "none"), other.get(name, "none")
                if mine != theirs:
                    raise InputError(
                        f"{name}: worker 0 has {mine}, worker {rank} has {theirs}; the bits of a run need the same on "
                        "all workers"
                    )

    def hand_round(self, make: Callable[[int], Tensor], owners: Sequence[int]) -> Iterator[Tensor]:
        """Messages of all workers, in their order.

        Those that are made travel while a worker makes its next one, and the later ones while the earlier are used.

        Args:
            make: one of this worker, by its number: (K,) uint8 on the CPU.
            owners: whose each message is.

        Yields:
            (K,) uint8 on the CPU.
        """
        if self.count == 1:
            yield from map(make, range(len(owners)))
            return
        device = _wire()
        buffers, travelling = dict[int, Tensor](), dict[int, Any]()
        for some in _rounds(owners):
            own = {number: make(number) for number in some if owners[number] == self.rank}
            lengths = torch.stack(self._gather(torch.tensor([len(own.get(number, ())) for number in some])))
            with _reaching():
                for number, length in zip(some, lengths.amax(dim=0).tolist(), strict=True):
                    buffer = own[number] if number in own else torch.empty(length, dtype=torch.uint8)
                    buffers[number] = buffer = buffer.to(device)
                    travelling[number] = dist.broadcast(buffer, src=owners[number], async_op=True)
            self.sent["bytes"] += sum(map(len, own.values()))
            self.sent["messages"] += len(own)
        for number in range(len(owners)):
            with _reaching():
                travelling.pop(number).wait()
            yield buffers.pop(number).cpu()

    def first_to_report(self) -> bool:
        """Whether no other worker has said yet that the run ends early; from now on this one has."""
        if self.count == 1:
            return True
        try:
            return self._store.add(_REPORTED, 1) == 1
        except (RuntimeError, AttributeError):  # nobody is there to ask
            return True

    def _gather(self, own: Tensor) -> list[Tensor]:
        """Of all, in their order; small integers of one shape."""
        device = _wire()
        found = [torch.empty_like(own, device=device) for _ in range(self.count)]
        with _reaching():
            dist.all_gather(found, own.to(device))
        return [each.cpu() for each in found]

    def _gather_objects(self, own: T) -> list[T]:
        found: list[Any] = [None] * self.count
        with _reaching():
            dist.all_gather_object(found, own)
        return found


ALONE = Workers()
_current = ALONE


def workers() -> Workers:
    """Those of the block `together`; elsewhere one alone."""
    return _current


def launched() -> bool:
    """Whether torchrun, or what sets the same variables, started more than this process."""
    return all(name in os.environ for name in _LAUNCHED) and os.environ["WORLD_SIZE"] not in ("", "1")


def restarted() -> bool:
    """Whether torchrun has started these workers again after one of them failed (`--max-restarts`)."""
    return os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") not in ("", "0")


@contextlib.contextmanager
def together(init_method: str = "env://", *, rank: int | None = None, count: int | None = None) -> Iterator[Workers]:
    """Within the block processes make one run together, if torchrun started several; nothing is done otherwise.

    The process group is made here, or taken as it is where there is one.

    Args:
        init_method: where they meet, as of `torch.distributed.init_process_group`.
        rank: which of them this is; None for the environment's.
        count: how many there are; None for the environment's.

    Raises:
        InputError: they do not find each other, or this torch cannot do it.

    Example:
        >>> with etsplat.together() as workers:  # one, unless torchrun started more
        ...     share = list(range(10))[workers.rank :: workers.count]
        >>> len(share)
        10
    """
    global _current
    if _current is not ALONE or (count is None and not launched()):
        yield _current
        return
    rank = int(os.environ["RANK"]) if rank is None else rank
    count = int(os.environ["WORLD_SIZE"]) if count is None else count
    if not dist.is_available():
        raise InputError("torchrun: this build of torch has no torch.distributed; start one process, without torchrun")
    joined, store = not dist.is_initialized(), None
    if joined:
        store = _join(init_method, rank, count)
    threads = _native.num_threads()
    _current = Workers(dist.get_rank(), dist.get_world_size(), store)
    try:
        _share_cores(_current)
        yield _current
    finally:
        _current = ALONE
        _native.set_num_threads(count=threads)
        if joined:
            # Torch 2.6 waits here for threads that want the interpreter's lock, which it holds, to drop what was sent
            # last: they have it first.
            time.sleep(_DROPPED)
            with contextlib.suppress(RuntimeError):
                dist.destroy_process_group()


def about_this() -> dict[str, str]:
    """What must be the same on all workers of a run whatever it is, because bits depend on it."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return {
        "etsplat": version("etsplat"),
        "torch": torch.__version__,
        "instruction set": _native.instruction_set(),
        "machine": platform.machine(),
        "GPU": gpu,
    }


def _join(init_method: str, rank: int, count: int) -> Any:
    """Makes the process group; returns its store."""
    from torch.distributed.rendezvous import rendezvous  # late: builds without torch.distributed have none

    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if gpus:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % gpus)
    each_its_own = dist.is_nccl_available() and 0 < int(os.environ.get("LOCAL_WORLD_SIZE", count)) <= gpus
    try:
        shared, _, _ = next(iter(rendezvous(init_method, rank, count, timeout=MEETING)))
        # torchrun keeps its store when it starts workers again: the addresses of those before must not be found.
        store = dist.PrefixStore(f"etsplat/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", shared)  # pyright: ignore[reportPrivateImportUsage]
        backend = "nccl" if each_its_own else "gloo"
        dist.init_process_group(backend, store=store, rank=rank, world_size=count, timeout=PATIENCE)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"torchrun: the {count} workers do not find each other ({_first_line(error)})") from error
    return store


def _share_cores(group: Workers) -> None:
    """Workers that may use the same cores of one machine take their part of them each, if nobody said otherwise."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    place = socket.gethostname(), cores
    places = group._gather_objects(place)
    group.neighbours, sharing = [host for host, _ in places].count(place[0]), places.count(place)
    if sharing > 1 and not os.environ.get("ETSPLAT_NUM_THREADS"):
        _native.set_num_threads(count=max(1, _native.num_threads() // sharing))


def _rounds(owners: Sequence[int]) -> list[list[int]]:
    """The numbers of the first message of each worker, then of the second of each, and so on."""
    made, rounds = dict[int, int](), list[list[int]]()
    for number, owner in enumerate(owners):
        made[owner] = made.get(owner, 0) + 1
        if made[owner] > len(rounds):
            rounds.append([])
        rounds[made[owner] - 1].append(number)
    return rounds


def _wire() -> torch.device:
    """Where tensors are while they travel: gloo's on the CPU, NCCL's on the GPU."""
    return torch.device("cuda" if dist.get_backend() == "nccl" else "cpu")


@contextlib.contextmanager
def _reaching() -> Iterator[None]:
    """What torch says where a worker is gone, in one kind of error."""
    try:
        yield
    except (WorkerLostError, InputError):
        raise
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise WorkerLostError(f"another worker of the run ended or cannot be reached ({_first_line(error)})") from error


def _first_line(error: Exception) -> str:
    """What happened, without the place in torch's sources before it, and what gloo adds."""
    line = (str(error) or type(error).__name__).splitlines()[0]
    return re.sub(r"^\[[^\]]*:\d+\] ", "", line).partition(". ")[0]
