"""Our soups and OpenSplat's Gaussians on the same captures, at equal steps and at equal processor seconds."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.tasks.sweeps.cells import run_cells
from etsplat.tasks.sweeps.places import Where
from studies.grid.cells import Cell
from studies.grid.writing import bold, origin_of, versions_of, write_text
from studies.peers.opensplat import OpenSplat, OpenSplatRun, processor_seconds

TRIES, TOLERANCE = 3, 0.05
"""So many lengths of runs are tried until the seconds of one are so close to those of ours."""


@dataclass(frozen=True)
class Comparison:
    """Of one capture.

    Attributes:
        scene: its name.
        agreement: of our pictures of OpenSplat's Gaussians with its own, in dB.
        ours: our run: "psnr", "ssim", "triangles", "iterations", "processor_seconds", "seconds".
        equal_seconds: OpenSplat at as many processor seconds.
        equal_steps: and at as many steps; None if that was not asked for.
    """

    scene: str
    agreement: float
    ours: dict[str, float]
    equal_seconds: OpenSplatRun
    equal_steps: OpenSplatRun | None


def compare(cell: Cell, peer: OpenSplat, *, equal_steps: bool) -> Comparison:
    """Runs all that is not finished yet, one after the other.

    Args:
        cell: our run.
        peer: OpenSplat on the same capture.
        equal_steps: let it take as many steps as well, however long that takes.

    Raises:
        InputError: a run fails; what `OpenSplat.check` raises.
    """
    checked = peer.check()
    ours = train_ours(cell)
    seconds = ours["processor_seconds"]
    fitted = fit_steps(peer.train, seconds / checked.seconds_per_step, seconds)
    long = peer.train(int(ours["iterations"])) if equal_steps else None
    return Comparison(cell.object, checked.agreement, ours, fitted, long)


def train_ours(cell: Cell) -> dict[str, float]:
    """Our run's numbers, those of `Comparison.ours`. One that was interrupted begins again: its seconds are unknown.

    Raises:
        InputError: it fails.
    """
    record = cell.folder.parent / f"{cell.folder.name}.seconds.json"
    if cell.state != "done" or not record.is_file():
        shutil.rmtree(cell.folder, ignore_errors=True)
        cell.state, before = "waiting", processor_seconds()
        run_cells([cell], Where(jobs=1), lambda: None)
        if cell.state != "done":
            raise InputError(f"{cell.folder}: {cell.error}")
        write_text(record, json.dumps({"processor_seconds": processor_seconds() - before}))
    metrics = cell.metrics()
    own = {name: metrics[name] for name in ("psnr", "ssim", "triangles", "iterations", "seconds")}
    return {**own, **json.loads(record.read_text(encoding="utf-8"))}


def fit_steps(train: Callable[[int], OpenSplatRun], steps: float, seconds: float) -> OpenSplatRun:
    """The run that takes closest to so many processor seconds, of those that are tried.

    Args:
        train: makes a run of so many steps.
        steps: to begin with.
        seconds: wanted.
    """
    tried: list[OpenSplatRun] = []
    for _ in range(TRIES):
        tried.append(train(max(1, round(steps))))
        if abs(tried[-1].processor_seconds / seconds - 1) <= TOLERANCE:
            break
        steps = tried[-1].steps * seconds / tried[-1].processor_seconds
    return min(tried, key=lambda run: abs(run.processor_seconds / seconds - 1))


def write_comparison(found: Sequence[Comparison], out: Path, command: str) -> None:
    """Writes opensplat.json and opensplat.md."""
    origin = origin_of(command)
    document = {**origin, "versions": versions_of(), "scenes": [asdict(each) for each in found]}
    write_text(out / "opensplat.json", json.dumps(document, indent=2) + "\n")
    write_text(out / "opensplat.md", _markdown(found, origin))


def _markdown(found: Sequence[Comparison], origin: dict[str, str]) -> str:
    head = ["capture", "", "steps", "processor seconds", "PSNR", "SSIM", "primitives"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for each in found:
        ours = {**each.ours, "steps": each.ours["iterations"], "primitives": each.ours["triangles"]}
        rows = [("ours", ours), ("OpenSplat, equal seconds", _row(each.equal_seconds))]
        if each.equal_steps:
            rows.append(("OpenSplat, equal steps", _row(each.equal_steps)))
        best = max(row["psnr"] for _, row in rows[:2])
        for number, (name, row) in enumerate(rows):
            texts = [f"{row['steps']:,}", f"{row['processor_seconds']:.0f}"]
            texts += [bold(f"{row['psnr']:.2f}", number < 2 and row["psnr"] == best, "**"), f"{row['ssim']:.4f}"]
            lines.append("| " + " | ".join([each.scene, name, *texts, f"{row['primitives']:,}"]) + " |")
    worst = min(each.agreement for each in found)
    note = (
        "Means over the test photos. Processor seconds are of whole processes; the better of equal seconds in bold. Our"
        f" pictures of OpenSplat's Gaussians are at least {worst:.1f} dB from its own."
    )
    start = f"`{origin['command']}`, {origin['date']}, commit {origin['commit']}, {origin['machine']}."
    return "\n\n".join([start, note, "\n".join(lines)]) + "\n"


def _row(run: OpenSplatRun) -> dict[str, Any]:
    return {**asdict(run), "primitives": run.gaussians}
