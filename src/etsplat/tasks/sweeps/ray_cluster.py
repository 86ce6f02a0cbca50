"""Runs on a Ray cluster: a task for each, which takes its cores."""

import importlib
import logging
import socket
from concurrent.futures import Future
from typing import Any

from etsplat.core.errors import InputError
from etsplat.tasks.sweeps.executors import Executor, LostError
from etsplat.tasks.sweeps.work import Work, perform

_CANCELLED_SECONDS, _REACH_SECONDS = 60.0, 10.0
_REMEDY = "start one with `ray start --head`, or name another: HOST:PORT"


class RayExecutor(Executor):
    """A task for each run, in a process of its own. Which machine is Ray's business; all see the same folders."""

    def __init__(self, address: str, cores: int) -> None:
        """Connects to the cluster, if this process has not yet.

        Args:
            address: as `ray.init` takes it; "auto" for the cluster that this machine is part of.
            cores: of each task.

        Raises:
            InputError: Ray is not installed, or there is no cluster.
        """
        try:
            ray: Any = importlib.import_module("ray")
        except ImportError as error:
            raise InputError(f"cluster {address}: needs Ray; pip install 'etsplat[cluster]'") from error
        self._ray, self.threads = ray, cores
        self._connected = not ray.is_initialized()
        if self._connected:
            _reach(address)
            try:
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise InputError(f"cluster {address}: {_said(error, address)}; {_REMEDY}") from error
        # Retries are those of `run_cells`. A process makes one run, so that none inherits another's memory.
        self._perform = ray.remote(num_cpus=cores, max_retries=0, max_calls=1)(perform)
        self._tasks: list[Any] = []

    def submit(self, work: Work) -> "_Task":
        """As of `Executor`."""
        task = self._perform.remote(work)
        self._tasks.append(task)
        return _Task(task.future(), self._ray.exceptions.RayError)

    def stop(self) -> None:
        """As of `Executor`."""
        for task in self._tasks:
            self._ray.cancel(task)
        if self._tasks:
            self._ray.wait(self._tasks, num_returns=len(self._tasks), timeout=_CANCELLED_SECONDS)

    def close(self) -> None:
        """As of `Executor`."""
        if self._connected:
            self._ray.shutdown()


def _said(error: Exception, address: str) -> str:
    """What Ray says, but where it asks for an option of its own programs."""
    if isinstance(error, ConnectionError) and address == "auto":
        return "no Ray runs on this machine"
    return " ".join(str(error).split()).removesuffix(".")


def _reach(address: str) -> None:
    """Raises InputError where nobody listens at HOST:PORT, for which Ray itself would wait for many minutes."""
    host, colon, port = address.rpartition("://")[2].rpartition(":")
    if not (colon and port.isdigit()):
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_REACH_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise InputError(f"cluster {address}: nobody answers there ({error}); {_REMEDY}") from error


class _Task:
    """A `Pending` of Ray."""

    def __init__(self, future: "Future[str]", errors: type[Exception]) -> None:
        self._future, self._errors = future, errors

    def done(self) -> bool:
        return self._future.done()

    def result(self) -> str:
        try:
            return self._future.result()
        except self._errors as error:
            lines = str(error).strip().splitlines()
            raise LostError(f"{type(error).__name__}: {lines[0] if lines else 'lost'}") from error
