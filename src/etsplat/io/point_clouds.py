"""Point clouds on disk."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.io.ply_tables import read_ply_tables

GREY = 0.5
"""The colour of points without one."""


def load_points(path: Path | str) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Positions (float64) and colours (float32 in [0, 1]) of a PLY point cloud; grey where the file has no colours.

    Points that are not finite are left out.

    Raises:
        InputError: as `etsplat.io.ply_tables.read_ply_tables`, or there are no coordinates.
    """
    table = read_ply_tables(path)["vertex"]
    names = table.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"points {path}: vertices without x, y and z; export it again")
    points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    colors = np.full(points.shape, GREY, dtype=np.float32)
    if {"red", "green", "blue"} <= set(names):
        colors = np.stack([table[channel].astype(np.float32) for channel in ("red", "green", "blue")], axis=1)
        if table.dtype["red"].kind == "u":
            colors /= np.iinfo(table.dtype["red"]).max
    finite = np.isfinite(points).all(axis=1) & np.isfinite(colors).all(axis=1)
    return torch.from_numpy(points[finite]), torch.from_numpy(colors[finite].clip(0, 1))
