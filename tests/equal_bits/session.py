"""Runs a case in both trees and says what differs; and the control, where something must differ."""

import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Literal

import numpy as np

from .cases import Case
from .compare import Differences, compare_runs, last_checkpoint
from .names import CHANGED, TENSORS, translated
from .runner import INTERRUPTED, KILLED, Job
from .trees import Tree, digest, locked

STATUS = {"no": 0, "kill": KILLED, "interrupt": INTERRUPTED}
"""How a run ends, by where it is stopped."""

Stop = Literal["no", "kill", "interrupt"]

COLUMNS = ("parameters", "images", "history", "resumed")
FLIPPED = {"reconstruct": "mesh.vertices", "train": "soup.vertices"}
"""What the control changes in a checkpoint, by task; BASE's names."""


class RunFailedError(RuntimeError):
    """A run did not end as it should. The message is one line."""


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes:
        name: of its line in the table.
        cells: by column, what to say there.
        passed: whether the safety net holds here.
        notes: what differs, or went wrong.
    """

    name: str
    cells: dict[str, str]
    passed: bool
    notes: Differences = field(default_factory=list)


@dataclass(frozen=True)
class Session:
    """Both trees on this machine.

    Attributes:
        base: BASE's tree.
        here: this tree.
        inputs: folder that commands run in.
        kept: folder of BASE's results, which are used again.
        drafts: folder of this session's runs.
        instruction_set: the engine's.
        machine: hash of all else that bits depend on.
        fresh: whether BASE's results are made anew.
        names: BASE's own `names`, if it has any: the cases have the names of a commit before it.
    """

    base: Tree
    here: Tree
    inputs: Path
    kept: Path
    drafts: Path
    instruction_set: str
    machine: str
    fresh: bool = False
    names: ModuleType | None = None

    def check(self, case: Case) -> Outcome:
        """Compares a run of this tree with BASE's, and a stopped and resumed run of this tree with that."""
        try:
            whole = self._whole(case, "whole")
            found = compare_runs(self._base(case), whole)
            found["resumed"] = _flat(compare_runs(whole, self._resumed(case, "resumed")))
        except RunFailedError as error:
            return Outcome(case.name, dict.fromkeys(COLUMNS, "failed"), False, [str(error)])
        cells = {column: f"{len(found[column])} differ" if found[column] else "equal" for column in COLUMNS}
        notes = [f"{column}: {text}" for column in COLUMNS for text in found[column]]
        why = CHANGED.get(case.name)
        if why is None or (self.names is not None and self.names.CHANGED.get(case.name) == why):
            return Outcome(case.name, cells, not notes, notes)
        changed = any(found[column] for column in COLUMNS[:3])
        intended = f"changes on purpose: {why}" if changed else f"is equal, though names.CHANGED says: {why}"
        return Outcome(case.name, cells, changed and not found["resumed"], [intended, *notes[:1]])

    def control(self, case: Case) -> Outcome:
        """One bit of one parameter is flipped where a run is resumed: the comparison must see it."""
        name = f"{case.name}, a bit flipped"
        try:
            whole = self._whole(case, "control-whole")
            flipped = self._resumed(case, "control", lambda path: flip_bit(path, TENSORS.here(FLIPPED[case.task])))
            found = compare_runs(whole, flipped)
        except RunFailedError as error:
            return Outcome(name, dict.fromkeys(COLUMNS, "failed"), False, [str(error)])
        cells = {column: "caught" if found.get(column) else "-" for column in COLUMNS}
        missed = [] if found["parameters"] else ["parameters: the flipped bit was not found: the comparison is blind"]
        return Outcome(name, cells, not missed, missed)

    def _base(self, case: Case) -> Path:
        """BASE's run, made or found."""
        options = case.options.split()
        words = [*case.command.split(), *(options if self.names is None else self.names.translated(case.task, options))]
        folder = self.kept / case.name
        kept = folder / digest([words, self.machine, self.inputs.name])
        with locked(folder):
            if self.fresh or not kept.is_dir():
                draft = self.drafts / f"{case.name}-base" / "run"
                self._run(self.base, words, draft)
                shutil.rmtree(kept, ignore_errors=True)
                shutil.move(draft, kept)
        return kept

    def _whole(self, case: Case, kind: str) -> Path:
        out = self.drafts / f"{case.name}-{kind}" / "run"
        self._run(self.here, self._words(case), out)
        return out

    def _resumed(self, case: Case, kind: str, between: Callable[[Path], None] | None = None) -> Path:
        """A run that was stopped and resumed; `between` is called with its last checkpoint."""
        out = self.drafts / f"{case.name}-{kind}" / "run"
        self._run(self.here, self._words(case), out, case.stop)
        if between is not None:
            between(last_checkpoint(out))
        self._run(self.here, [*self._words(case), "--resume"], out)
        return out

    def _words(self, case: Case) -> list[str]:
        return [*case.command.split(), *translated(case.task, case.options.split())]

    def _run(self, tree: Tree, words: list[str], out: Path, stop: Stop = "no") -> None:
        """Runs a command into `out`; what it prints is in log.txt beside it."""
        out.parent.mkdir(parents=True, exist_ok=True)
        log = out.with_name("log.txt")
        words = [*words, "--out", str(out)]
        status = tree.run(Job(words=words, folder=str(self.inputs), log=str(log), stop=stop), self.instruction_set)
        if status != STATUS[stop]:
            last = (log.read_text(encoding="utf-8", errors="replace").splitlines() or ["nothing"])[-1]
            place = "here" if tree is self.here else "in BASE"
            raise RunFailedError(f"{place}: ended with status {status}, not {STATUS[stop]}; {log} ends with: {last}")


def flip_bit(path: Path, name: str) -> None:
    """Flips the last bit of one number of a float32 tensor in a safetensors file: of that nearest to 0.75.

    It is as far from powers of two as can be: the bits of a number that crosses one may be rounded away.
    """
    data = bytearray(path.read_bytes())
    (length,) = struct.unpack_from("<Q", data)
    entry = json.loads(data[8 : 8 + length])[name]
    if entry["dtype"] != "F32":
        raise ValueError(f"{name}: expected F32, got {entry['dtype']}")
    first, end = (8 + length + offset for offset in entry["data_offsets"])
    distances = np.abs(np.abs(np.frombuffer(data[first:end], "<f4")) - 0.75)
    data[first + 4 * int(distances.argmin())] ^= 1
    path.write_bytes(data)


def _flat(found: dict[str, Differences]) -> Differences:
    return [text for texts in found.values() for text in texts]
