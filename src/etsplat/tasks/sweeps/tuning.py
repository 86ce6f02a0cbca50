"""Searches over settings by optuna, where a table of all combinations would be too large. Imports no torch."""

import importlib
import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

from etsplat.core.errors import InputError
from etsplat.io.atomic import atomic_write, write_error
from etsplat.io.json_text import as_json, json_differences
from etsplat.tasks.settings import AnySettings, did_you_mean, settings_of
from etsplat.tasks.sweeps.cells import Cell, run_cells
from etsplat.tasks.sweeps.places import Where

GOALS = {"chamfer": -1, "psnr": 1, "ssim": 1, "flip": -1, "silhouette_iou": 1, "psnr_opaque": 1}
"""What may be searched for, a mean over inputs of a number of metrics.json: 1 where more is better."""

STUDY_FILE = "study.log"


@dataclass(frozen=True)
class Range:
    """A setting that is searched: between two numbers, perhaps by their logarithms, or among words.

    Attributes:
        name: dotted.
        low: least number.
        high: largest.
        log: whether factors matter, not differences.
        words: instead of numbers.
    """

    name: str
    low: Any = None
    high: Any = None
    log: bool = False
    words: tuple[Any, ...] = ()

    def distribution(self, optuna: Any) -> Any:
        """As optuna has it."""
        if self.words:
            return optuna.distributions.CategoricalDistribution(self.words)
        whole = isinstance(self.low, int)
        kind = optuna.distributions.IntDistribution if whole else optuna.distributions.FloatDistribution
        return kind(self.low, self.high, log=self.log)


def read_ranges(kind: type[AnySettings], given: Sequence[Sequence[str]]) -> list[Range]:
    """What options such as ``--search optimizer.lr_vertices 0.001 0.1 log`` say.

    Raises:
        InputError: no such setting, or what follows it is no range.
    """
    known, found = settings_of(kind), {}
    for words in given:
        name = words[0].replace("-", "_") if words else ""
        if name not in known or name == "seed" or name in kind.LABELS[:1]:
            raise InputError(f"search {name}: is no setting that can be searched{did_you_mean(name, known)}")
        if name in found:
            raise InputError(f"search {name}: is given twice; leave one out")
        found[name] = _range(name, known[name].kind, [known[name].read(word) for word in words[1:]])
    if not found:
        raise InputError("nothing to search: name a setting with --search NAME LOW HIGH")
    return list(found.values())


def _range(name: str, kind: type, values: list[Any]) -> Range:
    if kind not in (int, float):
        if len(set(values)) < 2:
            raise InputError(f"search {name}: name at least two values after it")
        return Range(name, words=tuple(values))
    log = values[2:] == ["log"]
    if len(values) - log != 2 or any(isinstance(value, str | None) for value in values[:2]):
        raise InputError(f"search {name}: write its least and its largest number after it, and perhaps log")
    low, high = values[:2]
    if not low < high or (log and low <= 0):
        raise InputError(f"search {name}: {low:g} to {high:g} is no range{' of logarithms' * log}; write LOW HIGH")
    return Range(name, low, high, log)


@dataclass(frozen=True)
class Search(Generic[AnySettings]):
    """What is searched, and where it is kept.

    Attributes:
        base: settings that all runs have in common.
        ranges: what is searched.
        inputs: by name; every trial is run on each.
        goal: of `GOALS`.
        seed: of the runs, and of what is proposed.
        out: folder of runs and study.
        images: of scenes, the folder of their photos; None for their own.
        store: where run directories are kept beside it, as fsspec names it; None for nowhere.
    """

    base: AnySettings
    ranges: Sequence[Range]
    inputs: Mapping[str, Path]
    goal: str
    seed: int
    out: Path
    images: str | None = None
    store: str | None = None

    def check(self) -> None:
        """Raises InputError where an end of a range is no value of its setting, or would have no effect."""
        if self.goal not in GOALS:
            raise InputError(f"goal: is {self.goal!r}; choose one of {', '.join(GOALS)}")
        for one in self.ranges:
            for value in one.words or (one.low, one.high):
                self.base.changed({one.name: value})

    def cells(self, number: int, chosen: Mapping[str, Any]) -> list[Cell]:
        """The runs of a trial."""
        config = self.base.changed({**chosen, "seed": self.seed})
        made = []
        for name, source in self.inputs.items():
            place = f"runs/{name}/trial {number}"
            kept = None if self.store is None else f"{self.store.rstrip('/')}/{place}"
            cell = Cell(name, source, f"trial {number}", config, self.out / place, images=self.images, store=kept)
            cell.look()
            made.append(cell)
        return made

    def value(self, cells: Sequence[Cell]) -> float | None:
        """What a trial came to; None where a run failed.

        Raises:
            InputError: the goal was not measured.
        """
        if any(cell.state != "done" for cell in cells):
            return None
        values = [value for cell in cells if (value := cell.metrics().get(self.goal)) is not None]
        if len(values) < len(cells):
            raise InputError(f"goal {self.goal}: was not measured in {cells[0].folder}; choose another")
        return statistics.fmean(values)


class Study:
    """The trials of a search, those of earlier calls too: they are in a journal beside the runs."""

    def __init__(self, search: Search[Any]) -> None:
        """Opens the journal, or begins it.

        Raises:
            InputError: optuna is not installed, or the folder holds another search.
        """
        search.check()
        try:
            self._optuna: Any = importlib.import_module("optuna")
        except ImportError as error:
            raise InputError("etsplat tune: needs optuna; pip install 'etsplat[tune]'") from error
        self._optuna.logging.set_verbosity(self._optuna.logging.WARNING)
        self._search = search
        try:
            search.out.mkdir(parents=True, exist_ok=True)
            journal = importlib.import_module("optuna.storages.journal")
            storage = self._optuna.storages.JournalStorage(journal.JournalFileBackend(str(search.out / STUDY_FILE)))
        except OSError as error:
            raise write_error(search.out, error) from error
        direction = "maximize" if GOALS[search.goal] > 0 else "minimize"
        self._study = self._optuna.create_study(
            study_name="etsplat", storage=storage, direction=direction, load_if_exists=True
        )
        self._take(direction)

    def run(self, trials: int, batch: int, where: Where, show: Callable[[list[Cell]], Callable[[], None]]) -> None:
        """Goes on until there are so many trials that ended.

        A batch is proposed at once. What is proposed depends on the seed and the trials before the batch, so a search
        that was interrupted goes on as if it had not been.

        Args:
            trials: in all.
            batch: how many are run beside each other.
            where: they are.
            show: given the cells of a batch, returns what is called while they run.
        """
        running = self._optuna.trial.TrialState.RUNNING
        while True:
            begun = self._study.get_trials(states=(running,))
            ended = len(self._study.trials) - len(begun)
            if ended >= trials:
                return
            chosen = {trial.number: trial.params for trial in begun} or self._propose(min(batch, trials - ended))
            cells = {number: self._search.cells(number, params) for number, params in chosen.items()}
            together = [cell for each in cells.values() for cell in each]
            run_cells(together, where, show(together))
            for number, each in cells.items():
                value = self._search.value(each)
                failed = self._optuna.trial.TrialState.FAIL if value is None else None
                self._study.tell(number, value, state=failed)

    def chosen(self) -> dict[int, dict[str, Any]]:
        """The settings of each trial, by its number."""
        return {trial.number: trial.params for trial in self._study.trials}

    def write_best(self) -> tuple[Path, float] | None:
        """Writes best.json: the settings of the best trial, for ``--config``; returns its path and what it came to."""
        complete = self._study.get_trials(states=(self._optuna.trial.TrialState.COMPLETE,))
        if not complete:
            return None
        best = self._study.best_trial
        config = self._search.base.changed({**best.params, "seed": self._search.seed})
        path = self._search.out / "best.json"
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps(config.to_dict(), indent=2) + "\n", encoding="utf-8")
        return path, best.value

    def _propose(self, count: int) -> dict[int, dict[str, Any]]:
        """New trials. Each batch has a sampler of its own, so that none depends on what this process did before."""
        seed = self._search.seed * 100_003 + len(self._study.trials)
        self._study.sampler = self._optuna.samplers.TPESampler(seed=seed, constant_liar=count > 1)
        space = {one.name: one.distribution(self._optuna) for one in self._search.ranges}
        return {(trial := self._study.ask(space)).number: trial.params for _ in range(count)}

    def _take(self, direction: str) -> None:
        """Remembers what is searched; refuses a folder with another search."""
        search = self._search
        setup = {
            "task": search.base.TASK,
            "config": search.base.to_dict(),
            "search": {one.name: [one.low, one.high, one.log, *one.words] for one in search.ranges},
            "inputs": sorted(search.inputs),
            "goal": [search.goal, direction],
            "seed": search.seed,
        }
        stored = self._study.user_attrs.get("setup")
        if stored is None:
            self._study.set_user_attr("setup", as_json(setup))
        elif differences := json_differences(stored, as_json(setup)):
            raise InputError(
                f"{search.out}: holds a search with {'; '.join(differences)}; go on with the same, or choose another "
                "folder"
            )
