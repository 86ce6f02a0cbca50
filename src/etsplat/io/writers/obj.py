"""For programs that read neither glb nor ply; colours at vertices."""

from pathlib import Path

import numpy as np

from etsplat.io.writers import Content, Surface

HOLDS: frozenset[Content] = frozenset({"vertex_colors"})


def write(path: Path, surface: Surface) -> None:
    """Wavefront OBJ; colours follow the coordinates, the extension that MeshLab and Blender read."""
    rows, colors = surface.vertices, surface.vertex_colors
    if colors is not None:
        rows = np.hstack([rows, colors[:, :3].astype(np.float32)])
    line = "v " + " ".join(["%.9g"] * 3 + ["%.6g"] * (rows.shape[1] - 3))
    with open(path, "w", encoding="ascii", newline="\n") as file:
        np.savetxt(file, rows, fmt=line)
        np.savetxt(file, surface.faces + 1, fmt="f %d %d %d")
