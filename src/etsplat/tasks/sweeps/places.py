"""Where the runs of a grid are made, and by which executor. Imports no torch."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.tasks.sweeps.executors import Executor

SLURM = "slurm"


@dataclass(frozen=True)
class Where:
    """Where the runs of a grid are made.

    Attributes:
        jobs: on this machine, so many runs beside each other; 0 for one on each core, or as many as `cores` leave.
        cores: of each run; None for an even share of this machine's, and for one elsewhere.
        cluster: None for this machine, "slurm", or the address of a Ray cluster ("auto" for the one that this machine
            is part of).
        slurm: parameters of submitit for the jobs, such as ``{"timeout_min": "240"}``.
        folder: for submitit's own files; all machines see it.
    """

    jobs: int = 0
    cores: int | None = None
    cluster: str | None = None
    slurm: Mapping[str, str] = field(default_factory=dict)
    folder: Path = Path("submitit")

    def __post_init__(self) -> None:
        if self.jobs < 0:
            raise InputError(f"jobs: is {self.jobs}; it must be at least 1, or 0 for one on each core")
        if self.cores is not None and self.cores < 1:
            raise InputError(f"cores: is {self.cores}; it must be at least 1")
        if self.slurm and self.cluster != SLURM:
            raise InputError(f"slurm: has an effect only with {option('cluster', SLURM)}; leave it out, or add that")

    def executor(self, runs: int) -> Executor:
        """What makes so many runs.

        Raises:
            InputError: what it needs is not installed, or there is no such cluster.
        """
        if self.cluster is None:
            from etsplat.tasks.sweeps.local import LocalExecutor

            return LocalExecutor(runs, self.jobs, self.cores)
        if self.cluster == SLURM:
            from etsplat.tasks.sweeps.slurm import SlurmExecutor

            return SlurmExecutor(self.folder, self.cores or 1, self.slurm)
        from etsplat.tasks.sweeps.ray_cluster import RayExecutor

        return RayExecutor(self.cluster, self.cores or 1)
