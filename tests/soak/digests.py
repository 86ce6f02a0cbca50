"""What is compared of a run's folder."""

import hashlib
import json
from pathlib import Path
from typing import Any

from safetensors.numpy import load_file

WHOLE = ("report.html", "convergence.png")
"""Files that show times."""

TIMES = {
    "metrics.json": ("seconds", "fps", "ms_per_"),
    "evaluation.json": ("seconds", "fps", "ms_per_"),
    "history.jsonl": ("seconds",),
}
"""Keys with times, by how they begin."""


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of a run, times left out."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and path.name not in WHOLE:
            found[name] = hashlib.sha256(_without_times(path)).hexdigest()
    return found


def _without_times(path: Path) -> bytes:
    data = path.read_bytes()
    if path.parent.name == "checkpoints":  # of progress, the first number is seconds
        tensors = load_file(path)
        tensors["progress"] = tensors["progress"][1:]
        return b"".join(
            f"{name} {value.dtype} {value.shape}".encode() + value.tobytes() for name, value in sorted(tensors.items())
        )
    if path.name not in TIMES:
        return data
    lines = data.decode().splitlines() if path.suffix == ".jsonl" else [data.decode()]
    return "\n".join(json.dumps(_stripped(json.loads(line), TIMES[path.name])) for line in lines).encode()


def _stripped(value: Any, times: tuple[str, ...]) -> Any:
    if not isinstance(value, dict):
        return value
    return {key: _stripped(entry, times) for key, entry in value.items() if not key.startswith(times)}
