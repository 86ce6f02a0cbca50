"""The `etsplat` command: in a process of its own, and what came of it."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

PROGRAM = [sys.executable, "-c", "from etsplat.cli import main; main()"]


Result = subprocess.CompletedProcess[str]


Run = Callable[..., Result]


def in_own_process(*arguments: str, cwd: Path) -> Result:
    return subprocess.run([*PROGRAM, *arguments], cwd=cwd, capture_output=True, text=True, check=False)


def assert_one_line_error(result: Result, *words: str) -> None:
    """Status 2, nothing but one line on standard error, which holds the words."""
    assert result.returncode == 2, result.stderr
    assert result.stderr.startswith("etsplat: ")
    assert result.stderr.count("\n") == 1
    assert all(word in result.stderr for word in words), result.stderr
