"""The surfaces of the solids, for `etsplat reconstruct` to photograph: white, and without Blender.

    PYTHON -m benchmarks.unseen_objects.surfaces teapot shelf --out FOLDER

PYTHON has numpy, scikit-image and trimesh; of etsplat it needs nothing.
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh
from skimage.measure import marching_cubes  # pyright: ignore[reportMissingImports]

from benchmarks.unseen_objects.household import SHAPES
from benchmarks.unseen_objects.shapes import Grid

GRID = 160

SPECK = 100
"""Parts with no more faces are none of the solid."""


def surface(name: str) -> trimesh.Trimesh:
    """Around the origin, its farthest vertex at distance 1."""
    grid = Grid(GRID)
    vertices, faces, _, _ = marching_cubes(SHAPES[name](grid), 0.0)
    mesh = _without_specks(trimesh.Trimesh(vertices, faces))
    if mesh.volume < 0:
        mesh.invert()
    mesh.vertices -= mesh.bounds.mean(axis=0)
    mesh.vertices /= np.linalg.norm(mesh.vertices, axis=1).max()
    return mesh


def _without_specks(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Where distances are barely negative at a single place of the grid, marching cubes leave parts of eight faces."""
    parts = mesh.split(only_watertight=False)
    large = [part for part in parts if len(part.faces) > SPECK]
    return mesh if len(large) == len(parts) else trimesh.util.concatenate(large)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", choices=list(SHAPES))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.names:
        surface(name).export(options.out / f"{name}.obj")


if __name__ == "__main__":
    main()
