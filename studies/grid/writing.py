"""What the tables of all grids share: where numbers come from, and text in CSV, Markdown and LaTeX."""

import csv
import io
import platform
import subprocess
from collections.abc import Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from etsplat.engines.threads import num_threads
from etsplat.io.atomic import atomic_write


def origin_of(command: str) -> dict[str, str]:
    """What a reader must know of a table: the command, the commit, the machine and the day."""
    machine = f"{num_threads()} cores, {platform.machine()}"
    return {"command": command, "commit": _commit(), "machine": machine, "date": date.today().isoformat()}


def versions_of() -> dict[str, str]:
    """Of what computes."""
    return {"etsplat": version("etsplat"), "torch": version("torch"), "python": platform.python_version()}


def csv_text(rows: Sequence[dict[str, Any]]) -> str:
    """Rows with the same keys, as CSV with a head."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def latex_tabular(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table in LaTeX with booktabs; the first column is text."""
    lines = [" & ".join(_escape(cell) for cell in line) + r" \\" for line in body]
    return "\n".join(
        [
            rf"\begin{{tabular}}{{l{'c' * (len(head) - 1)}}}",
            r"\toprule",
            " & ".join(_escape(cell) for cell in head) + r" \\",
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}",
        ]
    )


def bold(text: str, winner: bool, mark: str) -> str:
    """The text, set in bold as Markdown (`mark` "**") or LaTeX has it, if it is the winner."""
    if not winner:
        return text
    return f"**{text}**" if mark == "**" else rf"\textbf{{{text}}}"


def write_text(path: Path, text: str) -> None:
    """Writes a file, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _escape(text: str) -> str:
    return text.replace("_", r"\_").replace("%", r"\%").replace("±", r"$\pm$")


def _commit() -> str:
    """Of the source tree that this package runs from, or its version if it is installed."""
    try:
        found = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return f"of etsplat {version('etsplat')}"
    return found.stdout.strip()
