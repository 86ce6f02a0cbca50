"""Runs command lines of etsplat in the tree that is given, with all pinned that their bits depend on. A script.

    python runner.py PACKAGE INSTRUCTION_SET

PACKAGE is the folder that `etsplat` must be imported from. Each line of the input is a `Job` in JSON; it runs in a
process of its own, and its exit status is a line of the output. (Forked, so that torch is imported once.)

It runs in both trees; `main` and `run` are all that the safety net asks of the Python API.
"""

import importlib
import json
import os
import re
import signal
import sys
import traceback
from pathlib import Path
from typing import Literal, NoReturn, TypedDict

CHECKPOINT = re.compile(r"step_\d+\.safetensors")
KILLED, INTERRUPTED = 137, 130
# What runs import sooner or later, of other packages.
SLOW_IMPORTS = (
    "torch",
    "scipy.ndimage",
    "scipy.sparse.csgraph",
    "matplotlib.figure",
    "trimesh",
    "tyro",
    "rich.progress",
)


class Job(TypedDict):
    """A command line.

    Attributes:
        words: what follows `etsplat`.
        folder: where it runs.
        log: file that gets what it prints.
        stop: "kill": the process ends by itself while the second checkpoint is written; "interrupt": it is interrupted
            when the first one is; "no".
    """

    words: list[str]
    folder: str
    log: str
    stop: Literal["no", "kill", "interrupt"]


def main() -> None:
    package, instruction_set = sys.argv[1:]
    for name in SLOW_IMPORTS:
        importlib.import_module(name)
    import torch

    import etsplat
    from etsplat import _native

    found = Path(etsplat.__file__).resolve().parent
    if found != Path(package).resolve():
        sys.exit(f"etsplat was imported from {found}, not from {package}")
    torch.set_num_threads(1)
    _native.set_instruction_set(instruction_set)
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            run(json.loads(line))
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def run(job: Job) -> NoReturn:
    """Runs a command line, and ends the process as it would."""
    log = os.open(job["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for number, file in enumerate((nothing, log, log)):
        os.dup2(file, number)
    os.chdir(job["folder"])
    if job["stop"] != "no":
        stop_at_checkpoint(job["stop"])
    status = 1
    try:
        from etsplat.cli import main as command_line

        sys.argv = ["etsplat", *job["words"]]
        command_line()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def stop_at_checkpoint(how: Literal["kill", "interrupt"]) -> None:
    """Ends this process at a checkpoint: files appear by renaming, and Python tells of that (os.rename, PEP 578)."""
    seen = 0

    def watch(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal seen
        if event != "os.rename" or not CHECKPOINT.fullmatch(Path(os.fsdecode(arguments[1])).name):
            return
        seen += 1
        if how == "interrupt" and seen == 1:
            signal.raise_signal(signal.SIGINT)
        if how == "kill" and seen == 2:
            os._exit(KILLED)

    sys.addaudithook(watch)


if __name__ == "__main__":
    main()
