"""Disturb small runs of both tasks, let them end, and compare them with undisturbed ones."""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

import etsplat
from helpers.captures import write_transforms
from tests.soak.digests import digests

ROOT = Path("build/soak")
PATIENCE = 600
_SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


@dataclass
class Ended:
    """A process that has ended: its status, and what it said."""

    status: int
    said: str


@dataclass
class Task:
    """A command that makes a run, and what an undisturbed one leaves."""

    name: str
    command: list[str]
    seconds: float = 0.0
    expected: dict[str, str] | None = None

    def start(self, out: Path, *, clock: int = 0, size: int = 0) -> subprocess.Popen[str]:
        """The command into a folder, or on with what is there."""
        again = ["--resume"] if (out / "config.json").exists() else ["--overwrite"] if out.exists() else []
        command = [
            sys.executable,
            "-m",
            "tests.soak.child",
            str(clock),
            str(size),
            *self.command,
            "--out",
            str(out),
            *again,
        ]
        environment = {**os.environ, "ETSPLAT_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)

    def finish(self, out: Path, **conditions: int) -> Ended:
        """Wait until the command has ended."""
        process = self.start(out, **conditions)
        said = process.communicate(timeout=PATIENCE)[0]
        return Ended(process.returncode, said)


def killed(task: Task, out: Path, rng: random.Random) -> str | None:
    """Up to three signals at any time; then to the end."""
    for _ in range(rng.randint(1, 3)):
        process = task.start(out)
        try:
            process.communicate(timeout=rng.uniform(0.2, 1.0) * task.seconds)
        except subprocess.TimeoutExpired:
            chosen = rng.choice(_SIGNALS)
            process.send_signal(chosen)
            said = process.communicate(timeout=PATIENCE)[0]
            # Extension modules of others, matplotlib's among them, cannot be interrupted while they are imported.
            if (
                chosen is not signal.SIGKILL
                and "Traceback" in said
                and "ImportError: initialization failed" not in said
            ):
                return f"a traceback after {chosen.name}: {said[-300:]}"
        else:
            break
    ended = task.finish(out)
    # A run that had ended before its signal need not be resumed.
    return None if ended.status == 0 or (out / "report.html").exists() else f"did not go on: {ended.said[-300:]}"


def full_disk(task: Task, out: Path, rng: random.Random) -> str | None:
    """No file can grow beyond a number of bytes; then with room."""
    size = int(2 ** rng.uniform(6, 15))
    ended = task.finish(out, size=size)
    if ended.status == 0:
        return None
    if "Traceback" in ended.said or ended.status not in (1, 2):
        return f"with {size} bytes for each file: status {ended.status}, {ended.said[-300:]}"
    ended = task.finish(out)
    return None if ended.status == 0 else f"did not go on: {ended.said[-300:]}"


def moved_clock(task: Task, out: Path, rng: random.Random) -> str | None:
    """The wall clock jumps by months, before and after a kill."""
    process = task.start(out, clock=rng.randint(1, 1 << 30))
    try:
        process.communicate(timeout=rng.uniform(0.5, 1.0) * task.seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
    if (out / "report.html").exists():
        return None
    ended = task.finish(out, clock=rng.randint(1, 1 << 30))
    return None if ended.status == 0 else f"did not go on: {ended.said[-300:]}"


def two_processes(task: Task, out: Path, rng: random.Random) -> str | None:
    """A second process on the folder is refused while the first is at work, which does not notice."""
    first = task.start(out)
    deadline = time.monotonic() + PATIENCE
    while not (out / "config.json").exists() and first.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    first.send_signal(signal.SIGSTOP)  # so that it is at work for as long as the second asks
    try:
        second = task.finish(out)
    finally:
        first.send_signal(signal.SIGCONT)
    said = first.communicate(timeout=PATIENCE)[0]
    if second.status != 2 or "Traceback" in second.said:
        return f"the second was not refused: status {second.status}, {second.said[-300:]}"
    return None if first.returncode == 0 else f"the first ended with {first.returncode}: {said[-300:]}"


KINDS: dict[str, Callable[[Task, Path, random.Random], str | None]] = {
    "kills": killed,
    "full disk": full_disk,
    "clock": moved_clock,
    "two processes": two_processes,
}
"""What is done to a run; each says what is wrong, and leaves a folder that is finished."""


def tasks(folder: Path) -> list[Task]:
    """Both, on input that is written here."""
    write_transforms(folder / "scene", 8, width=32, height=24)
    etsplat.save_mesh(folder / "mesh.obj", *etsplat.icosphere(1))
    often = ["--preset", "tiny", "--output.checkpoint-every", "10"]
    reconstruct = ["reconstruct", str(folder / "mesh.obj"), *often, "--iterations", "60", "--resolution", "32"]
    return [
        Task("reconstruct", reconstruct),
        Task("train", ["train", str(folder / "scene"), *often, "--iterations", "200"]),
    ]


def differences(task: Task, out: Path) -> str | None:
    """Files that are not as those of the undisturbed run."""
    assert task.expected is not None
    found = digests(out)
    names = sorted({*found, *task.expected})
    wrong = [name for name in names if found.get(name) != task.expected.get(name)]
    return f"differs: {', '.join(wrong)}" if wrong else None


def main() -> int:
    """The exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--trials", type=int, default=20, help="of each kind, for each task")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    shutil.rmtree(ROOT, ignore_errors=True)
    ROOT.mkdir(parents=True)
    console, table = Console(), Table("task", "disturbed by", "trials", "equal", title="disturbed runs")
    failed = False
    for task in tasks(ROOT):
        undisturbed, begin = ROOT / f"{task.name}_undisturbed", time.monotonic()
        ended = task.finish(undisturbed)
        assert ended.status == 0, ended.said
        task.seconds, task.expected = time.monotonic() - begin, digests(undisturbed)
        control = ROOT / f"{task.name}_control"
        shutil.copytree(undisturbed, control)
        (control / "README.txt").write_text("another")
        assert differences(task, control) == "differs: README.txt"
        for kind, disturb in KINDS.items():
            equal = 0
            for trial in range(options.trials):
                out = ROOT / f"{task.name}_{kind.replace(' ', '_')}_{trial}"
                wrong = disturb(task, out, random.Random(f"{options.seed} {out.name}")) or differences(task, out)
                if wrong is None:
                    equal += 1
                    shutil.rmtree(out)
                else:
                    console.print(f"{out}: {wrong}")
            table.add_row(task.name, kind, str(options.trials), str(equal))
            failed = failed or equal < options.trials
    console.print(table)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
