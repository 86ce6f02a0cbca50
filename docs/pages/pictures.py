"""Pictures of the site that are computed with it: the paper's figures, and what the shortest examples draw."""

import os
import subprocess
import sys
from pathlib import Path

from docs.pages.examples import DRAWN

ROOT = Path(__file__).resolve().parent.parent.parent
"""From where `python -m studies` is run."""

FIGURES = ("kernels", "edges", "soft-triangle", "axes")
"""Of `python -m studies.figures`."""


def draw(folder: Path, examples: Path) -> None:
    """Draws those that are not there yet; `make docs` on a fresh clone draws all."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in FIGURES:
        _run(folder / f"{name}.png", ["-m", "studies.figures", name, "--out", str(folder / f"{name}.png")])
    for stem in DRAWN:
        _run(folder / f"{stem}.png", [str(examples / f"{stem}.py"), "--out", str(folder / f"{stem}.png")])


def _run(picture: Path, program: list[str]) -> None:
    if not picture.is_file():
        command = [sys.executable, *program]
        environment = {**os.environ, "MPLBACKEND": "Agg"}
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment, cwd=ROOT)
