"""What a grid compares: named changes of a preset's settings."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.io.paths import kind_of
from etsplat.tasks.reconstruct_config import METHODS, ReconstructConfig

LAMBDA_SIGMAS = (1e-3, 1e-4)
"""The two softness weights of the paper's tables."""

SUBSET = ("boot", "bunny_hr", "goathead", "hand_closed")
"""Our subset for the sensitivity to regularizers; which one the paper used it does not say."""


@dataclass(frozen=True)
class Variant:
    """One column of a table.

    Attributes:
        name: unique within a grid; also the name of a folder.
        changes: settings that differ from the preset's, by their dotted names.
    """

    name: str
    changes: dict[str, Any]

    def config(self, base: ReconstructConfig, seed: int) -> ReconstructConfig:
        """The settings of a run."""
        return base.changed({**self.changes, "seed": seed})


def method_variants(methods: Sequence[str], lambda_sigmas: Sequence[float]) -> list[Variant]:
    """The paper's table: soft methods at each weight of sigma^-2, opaque ones once.

    Raises:
        InputError: an unknown method.
    """
    variants = []
    for method in methods:
        if method not in METHODS:
            raise InputError(f"methods: {method} is none; choose from {', '.join(METHODS)}")
        if method.startswith("raster"):
            variants.append(Variant(method, {"method": method}))
            continue
        variants += [
            Variant(f"{method} {w:g}", {"method": method, "regularization.lambda_sigma": w}) for w in lambda_sigmas
        ]
    return variants


def regularizer_variants(base: ReconstructConfig) -> list[Variant]:
    """The paper's table reg_ablation: one weight at a time at 0.1, 1 and 10 times its value."""
    variants = [Variant("1x", {})]
    for name in ("lambda_edge", "lambda_smooth_normal", "lambda_laplacian"):
        for factor in (0.1, 10.0):
            value = factor * getattr(base.regularization, name)
            variants.append(Variant(f"{factor:g}x {name}", {f"regularization.{name}": value}))
    return variants


def distance_variants(methods: Sequence[str]) -> list[Variant]:
    """Barycentric against signed distance, for each kernel."""
    return [
        Variant(f"{method} {distance}", {"method": method, "drawing.distance": distance})
        for method in methods
        for distance in ("barycentric", "sdf")
    ]


def setting_variants(base: ReconstructConfig, settings: Sequence[str]) -> list[Variant]:
    """Free ones: lists of changes such as "optimizer.lr_vertices=5e-3,drawing.colors=vertex"; "" is the preset itself.

    Raises:
        InputError: not a setting, or not a value of its type.
    """
    return [Variant(text or "preset", base.read_changes(text)) for text in settings]


def find_meshes(folder: Path, objects: Sequence[str]) -> dict[str, Path]:
    """The mesh files of a folder by name, ascending, or those asked for.

    Raises:
        InputError: no such folder, no meshes in it, or one that was asked for is missing.
    """
    if not folder.is_dir():
        raise InputError(f"meshes {folder}: no such folder; fetch the paper's with `etsplat data download famous`")
    suffixes = (".obj", ".ply", ".glb", ".off", ".stl")
    found = {path.stem: path for path in sorted(folder.rglob("*")) if kind_of(path) in suffixes}
    if not found:
        raise InputError(f"meshes {folder}: no mesh files ({', '.join(suffixes)}) in it")
    if missing := [name for name in objects if name not in found]:
        raise InputError(f"meshes {folder}: no mesh named {missing[0]}; there are {', '.join(found)}")
    return {name: found[name] for name in objects} if objects else found
