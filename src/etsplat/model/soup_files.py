"""Triangle soups on disk: `soup.safetensors` holds the parameters, how they are drawn, and where they came from."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

import torch
from safetensors import SafetensorError

from etsplat.core.errors import InputError
from etsplat.io.paths import kind_of
from etsplat.io.tensors import read_tensors, save_tensors
from etsplat.model.soup_rendering import SoupAppearance
from etsplat.model.triangle_soup import TriangleSoup

FORMAT = "etsplat soup 1"


@dataclass(frozen=True)
class SoupFile:
    """A soup with what is needed to draw it.

    Attributes:
        soup: the triangles, in the input's own units.
        appearance: how it was trained to be drawn; its near plane is in the same units.
        background: display colour behind the scene.
        notes: whatever else its maker wrote down, as text (iteration, source).
    """

    soup: TriangleSoup
    appearance: SoupAppearance = field(default_factory=SoupAppearance)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    notes: Mapping[str, str] = field(default_factory=dict)

    def to(self, device: torch.device) -> "SoupFile":
        """The same with its triangles on another device."""
        return replace(self, soup=self.soup.to(device))


def save_soup(path: Path | str, file: SoupFile) -> None:
    """Write a soup. Atomic.

    Raises:
        ValueError: `path` does not end in .safetensors.
        InputError: the file cannot be written.
    """
    path = Path(path)
    if kind_of(path) != ".safetensors":
        raise ValueError(f"path: expected the suffix .safetensors, got {path.name}")
    appearance = {name: value for name, value in asdict(file.appearance).items() if value != float("inf")}
    metadata = {
        **{f"note.{key}": value for key, value in file.notes.items()},
        "format": FORMAT,
        "appearance": json.dumps(appearance),
        "background": json.dumps(list(file.background)),
    }
    save_tensors(path, file.soup.parameters(), metadata)


def load_soup(path: Path | str) -> SoupFile:
    """Read a soup that `save_soup` wrote. Its parameters do not require gradients.

    Raises:
        InputError: the file is missing, cut short, of another kind, or holds numbers that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"soup {path}: no such file; check the path")
    try:
        tensors, metadata = read_tensors(path)
        if metadata.get("format") != FORMAT:
            raise ValueError("not a soup of this version of etsplat")
        soup = TriangleSoup(**{name: tensors[name].float() for name in TriangleSoup.PARAMETERS})
        known = {entry.name for entry in fields(SoupAppearance)}
        appearance = {name: value for name, value in json.loads(metadata["appearance"]).items() if name in known}
        background = json.loads(metadata["background"])
        red, green, blue = (float(channel) for channel in background)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        detail = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"soup {path}: cannot be read ({detail}); was it written by `etsplat train`?") from error
    notes = {key.removeprefix("note."): value for key, value in metadata.items() if key.startswith("note.")}
    check_finite_soup(path, soup)
    return SoupFile(soup, SoupAppearance(**appearance), (red, green, blue), notes)


def check_finite_soup(path: Path, soup: TriangleSoup) -> None:
    """Raises InputError, naming the file, for NaN or infinity among the parameters."""
    for name, tensor in soup.parameters().items():
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(f"soup {path}: {name} holds NaN or infinity; take another file")
