"""The examples run as they are, at their smallest."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"

SMALLEST = {
    "01_fit_one_triangle.py": ["--steps", "6", "--out", "triangle.png"],
    "02_reconstruct_demo.py": ["--preset", "tiny", "--out", "run"],
    "03_own_kernel.py": ["--preset", "tiny", "--out", "plateau"],
}


def test_every_example_is_listed() -> None:
    """A new example is run too."""
    assert sorted(path.name for path in EXAMPLES.glob("*.py")) == sorted(SMALLEST)


@pytest.mark.parametrize("name", SMALLEST)
def test_example_runs(name: str, tmp_path: Path) -> None:
    """The example ends well and writes what it was asked to."""
    command = [sys.executable, str(EXAMPLES / name), *SMALLEST[name]]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / SMALLEST[name][-1]).exists()
