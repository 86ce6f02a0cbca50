"""Where the frame of a capture lies in the world, in float64, which float32 coordinates of maps could not say."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from etsplat.core.errors import InputError
from etsplat.io.atomic import atomic_write
from etsplat.io.json_text import is_number, parse_json

GEOREFERENCE_FILE = "georeference.json"
"""In the folder of a capture, and of a run."""

Up = Literal["y", "z"]


@dataclass(frozen=True)
class Georeference:
    """x_world = offset + scale * x, without a turn.

    Attributes:
        offset: of the origin, in units of the world.
        scale: > 0, of lengths.
        up: which axis of the world points up; None where that is not known.
        crs: the world's coordinate system, as text such as "EPSG:25832"; empty where that is not known.

    Example:
        >>> etsplat.Georeference(offset=(500000.0, 4600000.0, 0.0), crs="EPSG:32633").scale
        1.0
    """

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0
    up: Up | None = None
    crs: str = ""

    def to_json(self) -> str:
        """What files and notes hold."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str, source: Path | str) -> "Georeference":
        """What `to_json` gave, or somebody wrote; `scale`, `up` and `crs` may be missing.

        Raises:
            InputError: it is no such thing; `source` is where it stands.
        """
        try:
            said = parse_json(text)
        except ValueError as error:
            raise InputError(f"{source}: not valid JSON ({str(error).splitlines()[0]}); correct it") from error
        if problem := _problem(said):
            raise InputError(f"{source}: {problem}")
        x, y, z = map(float, said["offset"])
        return cls((x, y, z), float(said.get("scale", 1.0)), said.get("up"), said.get("crs", ""))

    @classmethod
    def read(cls, path: Path) -> "Georeference":
        """Of a file.

        Raises:
            InputError: it cannot be read, or as `from_json`.
        """
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read ({error}); correct it") from error
        return cls.from_json(text, path)

    def write(self, folder: Path) -> None:
        """As georeference.json into a folder. Atomic.

        Raises:
            InputError: the file cannot be written.
        """
        with atomic_write(folder / GEOREFERENCE_FILE) as temporary:
            temporary.write_text(self.to_json() + "\n", encoding="utf-8")

    def after(self, shift: tuple[float, float, float]) -> "Georeference":
        """Of a frame whose origin lies at `shift` in this one."""
        x, y, z = (offset + self.scale * move for offset, move in zip(self.offset, shift, strict=True))
        return Georeference((x, y, z), self.scale, self.up, self.crs)


def _problem(said: Any) -> str | None:
    """What is wrong with it, or None."""
    if not isinstance(said, dict):
        return "holds no JSON object; write offset, scale, up and crs"
    if odd := said.keys() - {"offset", "scale", "up", "crs"}:
        return f"has {min(odd)!r:.40}, which is not understood; it may have offset, scale, up and crs"
    offset = said.get("offset")
    if (
        not isinstance(offset, list)
        or len(offset) != 3
        or not all(is_number(value) and abs(value) < 1e15 for value in offset)
    ):
        return "has no offset of three numbers; write where the origin of the capture lies"
    if not is_number(said.get("scale", 1.0)) or not 1e-9 <= said.get("scale", 1.0) <= 1e9:
        return "has a scale that is not a number from 1e-9 to 1e9; correct it"
    if said.get("up") not in (None, "y", "z"):
        return f"has up = {said['up']!r:.40}; it must be y or z, or be left out"
    if not isinstance(said.get("crs", ""), str) or len(said.get("crs", "")) > 10_000:
        return 'has a crs that is no text; write for example "EPSG:25832"'
    return None
