"""What every task's run has in common: its place, its record and its events."""

import contextlib
import hashlib
import json
import platform
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.core.workers import about_this, restarted, workers
from etsplat.engines.choice import engine_for, resolve_device
from etsplat.engines.threads import num_threads
from etsplat.io.kernel_files import kernel_digest, write_kernel
from etsplat.io.locks import check_nobody_writes, writing_run
from etsplat.io.paths import given_path
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.optim.exposure import Exposure
from etsplat.optim.loop import Callback, Event, NoteEvent, PrepareEvent, Progress, StageEvent, StepEvent
from etsplat.optim.objective import Term
from etsplat.optim.schedules import Scheduled
from etsplat.optim.terms import named_terms
from etsplat.optim.trainer import M, Trainer
from etsplat.optim.trainer_checks import check_callbacks
from etsplat.optim.watch import Outcome
from etsplat.tasks.notebook import notebook_callbacks, result_html
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import Settings
from etsplat.tasks.train_config import TrainConfig

ABOUT_EXPOSURE = (
    "colour in a training photo = matrix times colour of the result, both as displayed, red, green and blue in [0, 1]; "
    "the mean photo is neutral"
)


T = TypeVar("T")
C = TypeVar("C", bound=ReconstructConfig | TrainConfig)


@dataclass(frozen=True)
class Place:
    """Where a run goes, and what happens to what is there.

    Attributes:
        path: the run directory.
        resume: continue the run in it.
        overwrite: replace a run in it.
    """

    path: Path
    resume: bool
    overwrite: bool

    def check(self) -> None:
        """Cheap, so that it comes before the input is prepared.

        Raises:
            InputError: there is no run to continue, or no place for a new one; both are asked for; or somebody writes
                the run that is there.
        """
        if self.resume and self.overwrite:
            raise InputError(f"{option('resume')} and {option('overwrite')}: contradict each other; give one of them")
        if not self.resume:
            RunDirectory.check_free(self.path, overwrite=self.overwrite)
        elif not is_run(self.path):
            raise InputError(f"{self.path}: holds no run to resume; start it without {option('resume')}")
        check_nobody_writes(self.path)

    @contextlib.contextmanager
    def open(self, record: dict[str, Any], tell: Callable[[str], None]) -> Iterator[RunDirectory]:
        """The directory, made or with the run that goes on, which nobody else writes within the block.

        Args:
            record: as of `make_record`.
            tell: called with a sentence where nothing keeps others away.

        Raises:
            InputError: as `check`; or the run in it was started with other settings or input.
        """
        self.check()
        with writing_run(self.path, tell):
            if self.resume:
                yield RunDirectory.resume(self.path, record)
                return
            run = RunDirectory.create(self.path, record, overwrite=self.overwrite)
            write_kernel(run.path, record["config"].get("method"))
            yield run


@dataclass(frozen=True)
class Result:
    """What a run gives back; all of it is in the run directory too.

    Attributes:
        path: the run directory.
        metrics: as in metrics.json.
        OPAQUE: what pictures of opaque triangles are called, as of the model.
    """

    OPAQUE: ClassVar[str]

    path: Path
    metrics: dict[str, Any] = field(repr=False)

    def _repr_html_(self) -> str:
        return result_html(self.path, self.metrics, self.OPAQUE)


def settings_for(config: C | None, kind: type[C]) -> C:
    """The settings that a task is to run with: its defaults where there are none.

    Raises:
        ValueError: they are of another kind.
    """
    if config is not None and not isinstance(config, kind):
        name = kind.__name__
        raise ValueError(f"config must be a {name}, got {type(config).__name__}: etsplat.{name}.of(PRESET) makes one")
    return config or kind()


class Job(Generic[C]):
    """A run of a task, from its settings to its metrics: what all tasks do around their trainers.

    Of several workers all fit; one of them, the first, tells, writes and measures.

    Attributes:
        config: settings.
        device: where it runs.
        run: the run directory, within `writing`.
        place: where it is.
    """

    run: RunDirectory

    def __init__(
        self,
        config: C,
        out: str | Path,
        callbacks: Sequence[Callback],
        *,
        resume: bool,
        overwrite: bool,
    ) -> None:
        """Raises InputError where there is no run to continue, or no place for a new one.

        Raises ValueError for one function in the place of several callbacks.
        """
        out = given_path("out", out, "the path of a folder")
        check_callbacks(callbacks)
        self.config, self.device = config, resolve_device(config.device, config.engine)
        self._callbacks = (callbacks or notebook_callbacks()) if workers().leads else []
        again = restarted() and self.first(lambda: is_run(out))
        self.place = Place(out, resume or again, overwrite and not again)
        self.first(self.place.check)
        if workers().count > config.batch:
            text = f"batch is {config.batch}: of {workers().count} workers no more have something to do in a step"
            self.announce(NoteEvent(text))

    @staticmethod
    def first(make: Callable[[], T]) -> T:
        """What the first worker makes of it, also for the others: for whatever writes, and what measures a result."""
        return workers().from_first(make)

    def announce(self, event: Event) -> None:
        """Tells all callbacks."""
        for callback in self._callbacks:
            callback(event)

    def prepared(self, done: int, total: int) -> None:
        """Tells that so many views are ready."""
        self.announce(PrepareEvent(done, total))

    def identify(
        self,
        hashes: Mapping[str, str | None],
        paths: Mapping[str, str | None],
        iterations: int | None = None,
        *,
        views: str | None = None,
    ) -> None:
        """Takes what the run is of, as `make_record` does. A run that goes on must be of the same, by its hashes.

        Raises:
            InputError: the run in the folder was started with other settings or input.
        """
        self._record = make_record(self.config, iterations or self.config.iterations, hashes, paths, views)
        about = {"device": device_name(self.device), "iterations": self._record["iterations"], **self._record["source"]}
        workers().agree({**about_this(), **about, **flattened(self._record["config"])})
        if self.place.resume:
            self.first(lambda: RunDirectory.resume(self.place.path, self._record))

    def shorten(self, iterations: int) -> None:
        """Ends the run after so many iterations, which what it starts from says of it; before `writing`."""
        self.config = replace(self.config, iterations=iterations)
        self._record["iterations"] = iterations

    def measured(self) -> dict[str, Any] | None:
        """metrics.json of a run that goes on after it was done, once it is identified; None of others."""
        run = RunDirectory(self.place.path)
        return self.first(lambda: run.read_metrics() if self.place.resume and run.metrics_path.is_file() else None)

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Within the block there is `run`, and nobody else writes it.

        Raises:
            InputError: somebody does; or as `Place.open`.
        """
        if not workers().leads:
            self.run = RunDirectory(self.place.path)
            yield
            return
        with self.place.open(self._record, lambda text: self.announce(NoteEvent(text))) as self.run:
            self.run.forget_end()
            try:
                yield
            except BaseException as error:
                self.run.write_end(end_of(error))
                raise

    def fit(self, trainer: Trainer[M], first: Callback | None = None) -> Outcome[M]:
        """Runs a trainer from the last checkpoint to the end; see `Trainer.fit`. `first` is told before the others."""
        output = self.config.output
        trainer.fit(
            self.config.iterations,
            callbacks=[each for each in (first, self.announce) if each is not None and workers().leads],
            log_every=output.log_every,
            evaluate_every=output.evaluate_every,
            checkpoint_every=output.checkpoint_every,
            run=self.run,
            run_hash=hash_record(self._record),
        )
        outcome = trainer.outcome()
        if outcome.note is not None:
            self.announce(NoteEvent(outcome.note))
        return outcome

    def fit_stage(self, trainer: Trainer[M], iterations: int, folder: str, name: str) -> M:
        """Runs a trainer that makes something beside what the run optimizes, from its own last checkpoint to the end.

        Args:
            trainer: of what is made.
            iterations: its steps.
            folder: in the run's directory, for its checkpoints and history.
            name: what is made, for those who watch.

        Returns:
            What was made.
        """

        def tell(event: Event) -> None:
            if isinstance(event, StepEvent):
                self.announce(StageEvent(name, event.iteration, event.iterations))

        output = self.config.output
        trainer.fit(
            iterations,
            callbacks=[tell],
            log_every=output.log_every,
            checkpoint_every=output.checkpoint_every,
            run=self.first(lambda: self.run.stage(folder, iterations)),
            run_hash=hash_record(self._record),
        )
        return trainer.outcome().model

    def exposed(self, exposure: Exposure, names: Sequence[str]) -> dict[str, Any]:
        """Writes exposure.json where exposures were learned, and says so.

        Args:
            exposure: of the trainer, at the end.
            names: of the views.

        Returns:
            For metrics.json: whether they were, and what they explained of the error when that was measured.
        """
        if exposure.learned:
            matrices = {names[view]: matrix.tolist() for view, matrix in exposure.matrices().items()}
            self.first(lambda: self.run.write_exposure({"about": ABOUT_EXPOSURE, "matrices": matrices}))
            text = "the photos were exposed unlike each other; exposure.json has what was learned of each"
            self.announce(NoteEvent(f"exposure: {text}"))
        return {"exposure_learned": exposure.learned, "exposure_explained": exposure.explained}

    def finish(self, progress: Progress, found: Mapping[str, Any], result: Tensor) -> dict[str, Any]:
        """Writes metrics.json: what was found, how long it took, on what, and how it was made.

        Args:
            progress: at the end.
            found: metrics.
            result: a tensor of the result, for its device and precision.
        """
        config = self.config
        metrics = {
            **found,
            "iterations": progress.iteration,
            "seconds": progress.seconds,
            "seconds_per_iteration": progress.seconds / progress.iteration,
            "engine": engine_for(result).name,
            "device": device_name(result.device),
            "threads": num_threads(),
            **({"workers": workers().count} if workers().count > 1 else {}),
            "method": config.method,
            "preset": config.preset,
            "seed": config.seed,
            "versions": versions(),
        }
        self.first(lambda: self.run.write_metrics(metrics))
        return self.first(self.run.read_metrics)


def terms_of(
    group: object,
    *,
    leaving: Collection[str] = (),
    scheduled: Mapping[str, Callable[[float], Scheduled]] | None = None,
    arguments: Mapping[str, Mapping[str, Any]] | None = None,
) -> list[Term]:
    """The terms whose weights `lambda_NAME` are settings, in the order of these.

    Args:
        group: the settings.
        leaving: names of weights of something else, or of terms that do not apply.
        scheduled: by name of a term, what becomes of its weight over the run, where it does not stay.
        arguments: by name, what else it is made with.
    """
    known, scheduled, arguments = named_terms(), scheduled or {}, arguments or {}
    weights = {key.removeprefix("lambda_"): value for key, value in vars(group).items() if key.startswith("lambda_")}
    return [
        known[name](scheduled[name](weight) if name in scheduled else weight, **arguments.get(name, {}))
        for name, weight in weights.items()
        if name not in leaving
    ]


def make_record(
    config: Settings,
    iterations: int,
    hashes: Mapping[str, str | None],
    paths: Mapping[str, str | None],
    views: str | None = None,
) -> dict[str, Any]:
    """What config.json holds. Inputs are identified by their hashes; paths are for the reader.

    Args:
        config: settings, as they were asked for.
        iterations: of this run, which may be fewer.
        hashes: of the input, by kind. That of a kernel from Python joins them.
        paths: where it was read from, by kind.
        views: hash of the photos' names and poses, by which a capture is known again; None where nobody asks.
    """
    settings = config.to_dict()
    return {
        "task": config.TASK,
        "config": settings,
        "iterations": iterations,
        "source": {**hashes, **kernel_digest(settings.get("method"))},
        "paths": paths,
        **({} if views is None else {"views": views}),
        "versions": versions(),
    }


def flattened(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Settings by their dotted names."""
    found = {}
    for name, value in settings.items():
        inner = flattened(value, f"{before}{name}.") if isinstance(value, Mapping) else {f"{before}{name}": value}
        found |= inner
    return found


def end_of(error: BaseException) -> str:
    """What became of a run that an error ended, in a line."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    return " ".join(f"failed: {error or type(error).__name__}".split())


def hash_record(record: dict[str, Any]) -> str:
    """Identifies all that the result depends on."""
    relevant = {key: record[key] for key in ("task", "config", "source")}
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()


def path_of(source: object) -> str | None:
    """For the record: where a source was read from, if it was; absolute, so that it is found from any folder."""
    if not isinstance(source, str | Path):
        return None
    return str(Path(source).resolve()) if Path(source).exists() else str(source)  # the latter: "demo:scene"


def device_name(device: torch.device) -> str:
    """For the record: "cpu", or what the GPU is called."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def versions() -> dict[str, str]:
    """Of what computes."""
    return {"etsplat": version("etsplat"), "torch": torch.__version__, "python": platform.python_version()}
