"""Runs on this machine: processes beside each other, each with its share of the cores.

A run on one thread wastes nothing on waiting for others, so a grid is fastest with a run on each core, though
no single run is.
"""

import os
import pickle
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor

from etsplat.engines.threads import num_threads
from etsplat.io.atomic import write_error
from etsplat.tasks.sweeps import worker
from etsplat.tasks.sweeps.executors import Executor, LostError
from etsplat.tasks.sweeps.work import Work


class LocalExecutor(Executor):
    """A process for each run, started by a thread that waits for its end.

    The process is in a session of its own, so that Ctrl-C in a terminal does not reach it. It lives as long as its
    standard input is open: when that is closed, by `stop` or since this process was killed, it saves a checkpoint and
    ends.
    """

    def __init__(self, runs: int, jobs: int = 0, cores: int | None = None) -> None:
        """Takes the limits.

        Args:
            runs: how many there will be.
            jobs: beside each other; 0 for one on each core, or as many as `cores` leave.
            cores: of each; None for an even share.
        """
        jobs = max(1, min(jobs or num_threads() // (cores or 1), runs))
        self.threads = cores or max(1, num_threads() // jobs)
        self._threads = ThreadPoolExecutor(jobs, thread_name_prefix="etsplat-run")
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock, self._stopped = threading.Lock(), False

    def submit(self, work: Work) -> "Future[str]":
        """As of `Executor`."""
        return self._threads.submit(self._perform, work)

    def stop(self) -> None:
        """As of `Executor`."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                _input_of(process).close()
        self._threads.shutdown(cancel_futures=True)

    def close(self) -> None:
        """As of `Executor`."""
        self._threads.shutdown()

    def _perform(self, work: Work) -> str:
        with self._lock:
            if self._stopped:
                raise LostError("interrupted")
            process = _start(work)
            self._running.add(process)
        with process:
            assert process.stdout is not None
            text = process.stdout.read().decode()
            process.wait()  # before its standard input is closed, which would interrupt it
        with self._lock:
            self._running.remove(process)
        if process.returncode == 0:
            return text
        raise LostError(f"its process ended with {_end_of(process.returncode)}")


def _start(work: Work) -> "subprocess.Popen[bytes]":
    """The process of a run; it has the modules that this one has."""
    folders = os.pathsep.join(map(os.path.abspath, sys.path))
    try:
        with open(work.log, "ab") as log:
            process = subprocess.Popen(
                [sys.executable, worker.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env={**os.environ, "PYTHONPATH": folders},
                start_new_session=True,
            )
        _input_of(process).write(pickle.dumps(work))
        _input_of(process).flush()
    except OSError as error:
        raise write_error(work.log, error) from error
    return process


def _input_of(process: "subprocess.Popen[bytes]"):
    assert process.stdin is not None
    return process.stdin


def _end_of(status: int) -> str:
    if status > 0:
        return f"status {status}"
    try:
        return f"signal {signal.Signals(-status).name}"
    except ValueError:
        return f"signal {-status}"
