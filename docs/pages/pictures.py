"""What the examples draw, for their pages."""

import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from docs.pages.examples import SHORTER


def draw(folder: Path, examples: Path) -> None:
    """Runs the examples whose source is newer than their picture, two at a time."""
    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(2) as both:
        list(both.map(lambda program: _draw(program, folder / f"{program.stem}.png"), sorted(examples.glob("*.py"))))


def _draw(program: Path, picture: Path) -> None:
    if picture.is_file() and picture.stat().st_mtime >= program.stat().st_mtime:
        return
    environment = {**os.environ, "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1", "ETSPLAT_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out.png"  # a picture; or a folder with one, which may be called so too
        command = [sys.executable, str(program), *SHORTER.get(program.stem, ()), "--out", str(out)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment, cwd=scratch)
        (found,) = [out] if out.is_file() else out.glob("*.png")
        picture.write_bytes(found.read_bytes())
