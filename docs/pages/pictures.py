"""What the shortest examples draw, for their pages."""

import os
import subprocess
import sys
from pathlib import Path

from docs.pages.examples import DRAWN


def draw(folder: Path, examples: Path) -> None:
    """Runs those examples whose source is newer than their picture."""
    folder.mkdir(parents=True, exist_ok=True)
    for stem in DRAWN:
        program, picture = examples / f"{stem}.py", folder / f"{stem}.png"
        if not picture.is_file() or picture.stat().st_mtime < program.stat().st_mtime:
            command = [sys.executable, str(program), "--out", str(picture)]
            environment = {**os.environ, "MPLBACKEND": "Agg"}
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
