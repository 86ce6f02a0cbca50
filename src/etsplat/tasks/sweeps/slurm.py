"""Runs on Slurm, by submitit: a job for each."""

import importlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.tasks.sweeps.executors import Executor, LostError
from etsplat.tasks.sweeps.work import Work, perform

_CANCELLED_SECONDS = 40.0
"""Slurm gives a cancelled job half a minute."""


class SlurmExecutor(Executor):
    """A job for each run. One that Slurm ends at its time limit is queued again, and goes on from its checkpoint."""

    def __init__(self, folder: Path, cores: int, parameters: Mapping[str, str], cluster: str = "slurm") -> None:
        """Asks submitit for its executor.

        Args:
            folder: for submitit's files: what is handed over, and what the jobs print.
            cores: of each job.
            parameters: of `submitit.AutoExecutor.update_parameters`.
            cluster: of submitit: "slurm"; or "local", processes of this machine, to try what will be handed to Slurm.

        Raises:
            InputError: submitit is not installed, there is no Slurm, or a parameter is none.
        """
        try:
            submitit: Any = importlib.import_module("submitit")
        except ImportError as error:
            raise InputError("cluster slurm: needs submitit; pip install 'etsplat[slurm]'") from error
        self._errors = submitit.core.utils
        self.threads = cores
        self._jobs: list[Any] = []
        try:
            self._executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
            self._executor.update_parameters(name="etsplat", cpus_per_task=cores, **_typed(parameters))
        except (RuntimeError, NameError, TypeError, AssertionError, OSError) as error:
            raise InputError(f"cluster {cluster}: {' '.join(str(error).split())}") from error
        self._resumable = _resumable(submitit.helpers.Checkpointable)

    def submit(self, work: Work) -> "_Job":
        """As of `Executor`."""
        try:
            job = self._executor.submit(self._resumable(), work)
        except self._errors.FailedJobError as error:
            raise InputError(f"cluster slurm: refuses the job ({' '.join(str(error).split())})") from error
        self._jobs.append(job)
        return _Job(job, self._errors)

    def stop(self) -> None:
        """As of `Executor`; what Slurm kills goes on from its last checkpoint."""
        left = [job for job in self._jobs if not job.done()]
        for job in left:
            job.cancel(check=False)
        until = time.monotonic() + _CANCELLED_SECONDS
        while not all(job.done() for job in left) and time.monotonic() < until:
            time.sleep(0.3)

    def close(self) -> None:
        """As of `Executor`."""


class _Job:
    """A `Pending` of submitit."""

    def __init__(self, job: Any, errors: Any) -> None:
        self._job, self._errors = job, errors

    def done(self) -> bool:
        return self._job.done()

    def result(self) -> str:
        try:
            return self._job.result()
        except (self._errors.UncompletedJobError, self._errors.FailedJobError) as error:
            text = f"job {self._job.job_id} ended without a result; {self._job.paths.stderr} has more"
            raise LostError(text) from error


def _resumable(base: type) -> type:
    """What submitit calls, and queues again as it is."""

    class Resumable(base):
        def __call__(self, work: Work) -> str:
            return perform(work)

    return Resumable


def _typed(parameters: Mapping[str, str]) -> dict[str, int | str]:
    return {name: int(text) if text.isdigit() else text for name, text in parameters.items()}
