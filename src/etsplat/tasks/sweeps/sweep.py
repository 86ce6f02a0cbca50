"""A sweep: settings by inputs by seeds, each a run. Imports no torch."""

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Generic

from etsplat.core.errors import InputError
from etsplat.io.paths import path_remedy
from etsplat.tasks import demos
from etsplat.tasks.settings import AnySettings, did_you_mean, settings_of
from etsplat.tasks.sweeps.cells import Cell

_LONGEST = 120
"""Of the name of a folder; what is longer is cut, and has a hash instead."""


@dataclass(frozen=True)
class Sweep(Generic[AnySettings]):
    """What is run.

    Attributes:
        base: settings that all runs have in common.
        values: what is set beside them, by dotted name: every combination is run.
        inputs: by name.
        seeds: each combination is run with each of them.
        images: of scenes, the folder of their photos; None for their own.
        relabel: whether a preset among the values stands for its own settings; not if the base has changes.
    """

    base: AnySettings
    values: Mapping[str, tuple[Any, ...]]
    inputs: Mapping[str, Path]
    seeds: tuple[int, ...] = (0,)
    images: str | None = None
    relabel: bool = True

    @property
    def varied(self) -> list[str]:
        """The settings that have more than one value."""
        return [name for name, values in self.values.items() if len(values) > 1]

    def combinations(self) -> list[dict[str, Any]]:
        """The settings of each, by dotted name."""
        return [dict(zip(self.values, chosen, strict=True)) for chosen in product(*self.values.values())]

    def config(self, chosen: Mapping[str, Any], seed: int) -> AnySettings:
        """The settings of a run.

        Raises:
            InputError: a value is out of its range, or has no effect.
        """
        labels = {name: value for name, value in chosen.items() if name in self.base.LABELS}
        if not labels:
            return self.base.changed({**chosen, "seed": seed})
        if not self.relabel:
            raise InputError(f"set {next(iter(labels))}: contradicts --config; leave one of them out")
        own = {name: getattr(self.base, name) for name in self.base.LABELS}
        rest = {name: value for name, value in chosen.items() if name not in labels}
        return type(self.base).based_on({**own, **labels}).changed({**rest, "seed": seed})

    def cells(self, out: Path, store: str | None = None) -> list[Cell]:
        """All runs, input by input, in OUT/runs/INPUT/COMBINATION[ seed N]; those that are finished are "done".

        Args:
            out: folder.
            store: where the run directories are kept beside it, as fsspec names it; None for nowhere.

        Raises:
            InputError: settings cannot be used.
        """
        cells = []
        for (name, source), chosen, seed in product(self.inputs.items(), self.combinations(), self.seeds):
            variant = name_of(chosen)
            place = f"runs/{name}/{_folder_of(variant)} seed {seed}"
            kept = None if store is None else f"{store.rstrip('/')}/{place}"
            config = self.config(chosen, seed)
            cell = Cell(name, source, variant, config, out / place, images=self.images, store=kept)
            cell.look()
            cells.append(cell)
        return cells


def read_values(kind: type[AnySettings], given: Sequence[Sequence[str]]) -> dict[str, tuple[Any, ...]]:
    """What options such as ``--set optimizer.lr_vertices 0.0003 0.0006`` say.

    Args:
        kind: of settings.
        given: for each option its words.

    Raises:
        InputError: no such setting, one that is named twice, or no value.
    """
    known, found = settings_of(kind), {}
    for words in given:
        name, values = words[0].replace("-", "_"), words[1:]
        if name not in known or name == "seed":
            hint = "; seeds have an option of their own, --seeds" if name == "seed" else did_you_mean(name, known)
            raise InputError(f"set {name}: is no setting{hint}")
        if name in found:
            raise InputError(f"set {name}: is given twice; name all its values once")
        if not values:
            raise InputError(f"set {name}: has no value; name at least one after it")
        read = tuple(known[name].read(value) for value in values)
        if len(set(read)) < len(read):
            raise InputError(f"set {name}: has a value twice; leave one out")
        found[name] = read
    return found


def read_inputs(sources: Sequence[str], task: str) -> dict[str, Path]:
    """Inputs by their names: those of files without suffix, or of folders.

    Raises:
        InputError: one is missing, is for another task, or two have the same name.
    """
    found: dict[str, Path] = {}
    for source in sources:
        demos.check_demo(source, task)
        path = Path(source)
        if source not in demos.TASKS and not path.exists():
            raise InputError(f"{source}: no such file or folder; {path_remedy(path)}")
        name = source.partition(":")[2] if source in demos.TASKS else path.resolve().stem
        if name in found:
            raise InputError(f"{source}: another input is named {name} too; rename one of them")
        found[name] = path
    return found


def name_of(chosen: Mapping[str, Any]) -> str:
    """Of a combination: its settings, by the last part of their names where that is clear."""
    shown = short_names(chosen)
    return ", ".join(f"{shown[name]}={_word(value)}" for name, value in chosen.items()) or "as it is"


def short_names(names: Iterable[str]) -> dict[str, str]:
    """The last part of each dotted name; all of it where another ends in the same."""
    last = {name: name.rpartition(".")[2] for name in names}
    counts = Counter(last.values())
    return {name: short if counts[short] == 1 else name for name, short in last.items()}


def shown(value: Any) -> str:
    """A value of a setting for readers, with no more digits than they want."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else str(value)


def _folder_of(variant: str) -> str:
    name = re.sub(r"[^\w=.,+ -]", "_", variant)
    if name == variant and len(name) <= _LONGEST:
        return name
    return f"{name[:_LONGEST]} {hashlib.sha256(variant.encode()).hexdigest()[:8]}"
