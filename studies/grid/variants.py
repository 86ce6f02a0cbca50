"""What a grid compares: named changes of a preset's settings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from etsplat.core.errors import InputError
from etsplat.io.paths import kind_of
from etsplat.tasks.reconstruct_config import METHODS, ReconstructConfig
from etsplat.tasks.train_config import TrainConfig

LAMBDA_SIGMAS = (1e-3, 1e-4)
"""The two softness weights of the paper's tables."""

SUBSET = ("boot", "bunny_hr", "goathead", "hand_closed")
"""Our subset for the sensitivity to regularizers; which one the paper used it does not say."""


@dataclass(frozen=True)
class Variant:
    """One column of a table.

    Attributes:
        name: unique within a grid; also the name of a folder.
        changes: settings that differ from the preset's.
    """

    name: str
    changes: dict[str, Any]

    def config(self, base: ReconstructConfig, seed: int) -> ReconstructConfig:
        """The settings of a run."""
        return replace(base, seed=seed, **self.changes)


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
        variants += [Variant(f"{method} {w:g}", {"method": method, "lambda_sigma": w}) for w in lambda_sigmas]
    return variants


def regularizer_variants(base: ReconstructConfig) -> list[Variant]:
    """The paper's table reg_ablation: one weight at a time at 0.1, 1 and 10 times its value."""
    variants = [Variant("1x", {})]
    for name in ("lambda_edge", "lambda_normal", "lambda_laplacian"):
        for factor in (0.1, 10.0):
            variants.append(Variant(f"{factor:g}x {name}", {name: factor * getattr(base, name)}))
    return variants


def distance_variants(methods: Sequence[str]) -> list[Variant]:
    """Barycentric against signed distance, for each kernel."""
    return [
        Variant(f"{method} {distance}", {"method": method, "distance": distance})
        for method in methods
        for distance in ("barycentric", "sdf")
    ]


def setting_variants(base: ReconstructConfig, settings: Sequence[str]) -> list[Variant]:
    """Free ones: each setting is a list of changes such as "lr_vertices=5e-3,colors=vertex"; "" is the preset itself.

    Raises:
        InputError: not a setting, or not a value of its type.
    """
    return [Variant(setting or "preset", changes_of(base, setting)) for setting in settings]


def changes_of(base: ReconstructConfig | TrainConfig, setting: str) -> dict[str, Any]:
    """What a list such as "iterations=1000,start_limit=none" changes; a value has the type of the one that it replaces.

    Raises:
        InputError: as `setting_variants`.
    """
    changes: dict[str, Any] = {}
    hints = get_type_hints(type(base))
    for item in filter(None, setting.split(",")):
        name, _, text = item.partition("=")
        if not hasattr(base, name) or not text:
            raise InputError(f"{item}: is not a setting and its value; write NAME=VALUE,NAME=VALUE")
        types = get_args(hints[name]) if NoneType in get_args(hints[name]) else (hints[name],)
        kind = str if get_origin(types[0]) is Literal else types[0]
        try:
            if text.lower() == "none" and NoneType in types:
                changes[name] = None
            elif kind is bool:
                changes[name] = {"true": True, "false": False}[text.lower()]
            else:
                changes[name] = int(float(text)) if kind is int else kind(text)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{item}: {text} is no value for {name}, which is now {getattr(base, name)}") from error
    return changes


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
