"""Workers that run the inputs of a target one after the other, within bounds, and what is counted of them.

A worker is a fork of this process. Before it runs an input it writes its number to memory that both share, so that a
crash or a hang is known to belong to it; another worker goes on behind it.
"""

import faulthandler
import json
import mmap
import os
import shutil
import struct
import sys
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np
import torch

HANG = 20.0
"""Seconds that an input may take."""

EXCESS = 256
"""MiB by which an input may raise the memory that the worker has used at most."""

_MAPPED = 4096  # MiB that a worker may map, more than it has: beyond is MemoryError
_ENDED, _HUNG, _GREW = 0, 1, 3  # how workers end; 1 is faulthandler's


class Refused(Exception):  # noqa: N818  # no error: what a target expects
    """A reader or an operation said in plain words that it cannot use this."""


class Target(Protocol):
    """What is tried with many inputs."""

    name: str
    least_accepted: float

    def describe(self, rng: np.random.Generator) -> Any:
        """An input."""
        ...

    def run(self, described: Any, folder: Path) -> None:
        """Try it. Refused: it was refused as it should be. Everything else that is raised is a defect."""
        ...


@dataclass
class Failure:
    """Inputs that failed alike: how many, and the first one."""

    kind: str
    index: int
    text: str
    count: int = 1


@dataclass
class Tally:
    """Of one target."""

    name: str
    inputs: int = 0
    accepted: int = 0
    seconds: float = 0.0
    failures: dict[str, Failure] = field(default_factory=dict)

    def add(self, kind: str, where: str, index: int, text: str) -> None:
        """A failure."""
        key = f"{kind} at {where}"
        if key in self.failures:
            self.failures[key].count += 1
        else:
            self.failures[key] = Failure(kind, index, text)

    def counts(self) -> Counter[str]:
        """Failures by kind: crash, hang, memory, exception."""
        total: Counter[str] = Counter()
        for failure in self.failures.values():
            total[failure.kind if failure.kind in ("crash", "hang", "memory") else "exception"] += failure.count
        return total

    def share_accepted(self) -> float:
        """Of all inputs."""
        return self.accepted / max(1, self.inputs)


def generator(target: Target, seed: int, index: int) -> np.random.Generator:
    """Of input `index`."""
    return np.random.default_rng([seed, zlib.crc32(target.name.encode()), index])


def run_target(
    target: Target, seed: int, *, inputs: int = 1 << 62, seconds: float = float("inf"), hang: float = HANG
) -> Tally:
    """Try inputs 0, 1, ... of a target, so many or for so long."""
    tally, begin = Tally(target.name), time.monotonic()
    target.describe(generator(target, seed, 0))  # what is made once is made before the fork
    with _scratch() as folder, open(folder / "log", "w+", encoding="utf-8") as log:
        shared = mmap.mmap(-1, struct.calcsize(_STATUS))
        while tally.inputs < inputs and time.monotonic() < begin + seconds:
            worker = _Worker(target, seed, shared, log.fileno(), folder / "files", hang)
            process = os.fork()
            if process == 0:
                worker.work(tally.inputs, inputs, begin + seconds)
            status = os.waitpid(process, 0)[1]
            _account(tally, status, shared, _said(log))
    tally.seconds = time.monotonic() - begin
    return tally


def _account(tally: Tally, status: int, shared: mmap.mmap, said: str) -> None:
    index, accepted = struct.unpack_from(_STATUS, shared)
    tally.accepted += accepted
    tally.inputs = index
    lines = said.splitlines()
    for line in lines:
        if line.startswith("{"):
            found = json.loads(line)
            tally.add(found["kind"], found["where"], found["index"], found["text"])
    code = os.waitstatus_to_exitcode(status)
    if code != _ENDED:
        tally.inputs = index + 1
    if code not in (_ENDED, _GREW):
        trace = "\n".join(line for line in lines if not line.startswith("{"))
        tally.add("hang" if code == _HUNG else "crash", _innermost(trace), index, f"exit status {code}\n{trace}")


_STATUS = "<qq"  # the input at work, and how many this worker has seen accepted


@dataclass
class _Worker:
    target: Target
    seed: int
    shared: mmap.mmap
    log: int
    folder: Path
    hang: float

    def work(self, first: int, end: int, until: float) -> None:
        """In the child; it does not return."""
        code = 70
        try:
            code = self._inputs(first, end, until)
        except BaseException:
            os.write(self.log, traceback.format_exc().encode())
        finally:
            os._exit(code)

    def _inputs(self, first: int, end: int, until: float) -> int:
        import resource

        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        faulthandler.enable(self.log, all_threads=False)
        # Torch makes its pool anew where it is first asked for it after a fork: two threads at once may find none.
        torch.set_num_threads(torch.get_num_threads())
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + (_MAPPED << 20), resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        accepted, reported = 0, set()
        self.folder.mkdir(exist_ok=True)
        for index in range(first, end):
            struct.pack_into(_STATUS, self.shared, 0, index, accepted)
            if time.monotonic() > until:
                return _ENDED
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            faulthandler.dump_traceback_later(self.hang, exit=True, file=self.log)
            kind, where, text = self._try(index)
            grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10
            if grown > EXCESS:
                kind, text = "memory", f"{grown} MiB more\n{text}"
            accepted += kind == "accepted"
            if kind in ("accepted", "refused"):
                continue
            said = text if (kind, where) not in reported else ""
            reported.add((kind, where))
            line = json.dumps({"kind": kind, "where": where, "index": index, "text": said})
            os.write(self.log, line.encode() + b"\n")
            if kind == "memory":
                struct.pack_into(_STATUS, self.shared, 0, index, accepted)
                return _GREW
        struct.pack_into(_STATUS, self.shared, 0, end, accepted)
        return _ENDED

    def _try(self, index: int) -> tuple[str, str, str]:
        described = self.target.describe(generator(self.target, self.seed, index))
        try:
            self.target.run(described, self.folder)
            return "accepted", "", ""
        except Refused as refusal:
            # A reader may have caught the MemoryError of an allocation that it should not have tried.
            kind = "memory" if _ran_out_of_memory(refusal) else "refused"
            return kind, "a refusal", "" if kind == "refused" else "".join(traceback.format_exception(refusal))
        except Exception as error:
            text = "".join(traceback.format_exception(error))
            kind = "memory" if _ran_out_of_memory(error) else type(error).__name__
            return kind, _innermost(text), text


def _ran_out_of_memory(error: BaseException) -> bool:
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, MemoryError) or "can't allocate memory" in str(seen):
            return True
        seen = seen.__cause__ or seen.__context__
    return False


def _innermost(trace: str) -> str:
    """The frame of the package that is nearest to where it happened, as file:function."""
    frames = []
    for line in trace.splitlines():
        words = line.strip().split('"')
        if line.strip().startswith("File ") and len(words) == 3:
            function = line.rsplit(" in ", 1)[-1]
            frames.append((words[1], function))
    latest_first = "most recent call first" in trace
    own = [f"{Path(name).name}:{function}" for name, function in frames if "/etsplat/" in name]
    every = own or [f"{Path(name).name}:{function}" for name, function in frames] or ["an unknown place"]
    return every[0 if latest_first else -1]


def _said(log: Any) -> str:
    log.seek(0)
    said = log.read()
    log.seek(0)
    log.truncate()
    return said


@contextmanager
def _scratch() -> Iterator[Path]:
    memory = Path("/dev/shm")
    with TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)


def keep(target: Target, seed: int, failure: Failure, place: Path) -> None:
    """Write the first input of a failure into a folder, with what was said of it."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    described = target.describe(generator(target, seed, failure.index))
    if isinstance(described, dict) and all(isinstance(value, bytes) for value in described.values()):
        for name, data in described.items():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(data)
    else:
        (place / "input.txt").write_text(repr(described), encoding="utf-8")
    (place / "failure.txt").write_text(failure.text, encoding="utf-8")


def replay(target: Target, seed: int, index: int) -> None:
    """Run one input in this process, without bounds."""
    described = target.describe(generator(target, seed, index))
    with _scratch() as folder:
        try:
            target.run(described, folder)
            print("accepted")
        except Refused as refusal:
            print("refused:", refusal.__cause__, file=sys.stderr)
