"""For programs that read none of the others; colours at faces."""

from pathlib import Path

import numpy as np

from etsplat.io.writers import Content, Surface

HOLDS: frozenset[Content] = frozenset({"face_colors", "alpha", "z_up", "offset"})


def write(path: Path, surface: Surface) -> None:
    """OFF; colours follow the corners of each face as whole numbers from 0 to 255."""
    rows = np.hstack([np.full((len(surface.faces), 1), 3), surface.faces])
    if surface.face_colors is not None:
        rows = np.hstack([rows, np.floor(surface.face_colors * 255 + 0.5).astype(np.int64)])
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(f"OFF\n{len(surface.vertices)} {len(surface.faces)} 0\n")
        np.savetxt(file, surface.places, fmt=surface.digits)
        np.savetxt(file, rows, fmt="%d")
