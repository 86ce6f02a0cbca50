"""How what is exported is turned, scaled and moved: `--up`, `--scale` and `--place`, of soups and of meshes."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.spelling import file_kind, option
from etsplat.geometry.similarity import Similarity, rotation_between
from etsplat.io.georeference import GEOREFERENCE_FILE, Georeference
from etsplat.io.writers import suffixes, writer_of
from etsplat.tasks.export_config import ExportConfig


def check_placed(path: Path, config: ExportConfig) -> None:
    """Raises InputError for an `up` or `place` that files of this kind have no room for, or that contradict each other.

    Args:
        path: of one of the kinds of `etsplat.io.writers`.
        config: with an `up`.
    """
    holds = writer_of(path).HOLDS
    if config.up == "z" and "z_up" not in holds:
        kinds = (suffix[1:] for suffix in suffixes("z_up"))
        remedy = f"leave out {option('up', 'z')}, or choose {file_kind(*kinds)}"
        raise InputError(f"{path}: files of this kind have +y up, which programs turn to their own axis; {remedy}")
    if config.place == "world" and "offset" not in holds:
        kinds = (suffix[1:] for suffix in suffixes("offset"))
        raise InputError(f"{path}: files of this kind hold no coordinates of maps; choose {file_kind(*kinds)}")
    if config.place == "ground" and config.up == "keep":
        ground, upright = option("place", "ground"), option("up", "y", "z")
        raise InputError(f"{ground} needs to know which way is up; take {upright}")


def leave_unplaced() -> str:
    """What to do with settings of placement, for files that keep units and axes."""
    return f"leave out {option('up')}, {option('scale')} and {option('place')}"


def placement(
    run: Path,
    config: ExportConfig,
    corners: Float[Tensor, "*N 3"],
    up: Float[Tensor, "3"] | None,
    georeference: Georeference | None,
    strays: float = 0.0,
) -> Similarity:
    """How the capture's frame is turned, scaled and moved.

    Args:
        run: for messages.
        config: up, scale and place. The world's axes are those of the capture, and GLB's nodes turn them if need be.
        corners: of what is placed, on the CPU.
        up: where up is, a unit vector; None turns nothing, and +y or +z is up as it is.
        georeference: where the capture lies in the world, if that is known.
        strays: so large a share of the corners at either end of each axis is beyond what has its middle in the middle,
            and its lowest parts on the ground.
    """
    if config.place == "world":
        if georeference is None:
            raise InputError(f"{run}: does not say where it lies in the world; write {GEOREFERENCE_FILE}, or run anew")
        place = torch.tensor(georeference.offset, dtype=torch.float64)
        return Similarity(scale=georeference.scale * config.scale, translation=place * config.scale)
    axis = torch.eye(3, dtype=torch.float64)[2 if config.up == "z" else 1]
    turned = Similarity(scale=config.scale)
    if up is not None and config.up != "keep":
        turned = replace(turned, rotation=rotation_between(up, axis))
    if config.place == "keep" or not len(corners):
        return turned
    ordered = turned.apply(corners.reshape(-1, 3)).sort(dim=0).values
    last = len(ordered) - 1
    low, high = ordered[round(strays * last)], ordered[round((1 - strays) * last)]
    middle = (low + high) / 2
    return turned.moved(-(middle if config.place == "center" else middle + (low - middle) * axis))


def placed_record(config: ExportConfig, transform: Similarity, georeference: Georeference | None) -> dict[str, Any]:
    """What a file says of its placement, by which `etsplat.io.export_records` leads back to the capture."""
    return {
        **({} if georeference is None else {"georeference": asdict(georeference)}),
        "transform": transform.matrix.tolist(),
        **{name: getattr(config, name) for name in ("up", "scale", "place")},
    }


def apart_from_world(
    transform: Similarity, config: ExportConfig, georeference: Georeference | None
) -> tuple[Similarity, Georeference | None]:
    """A placement in two: what vertices are moved by, and with --place world an offset that float32 could not hold."""
    if config.place != "world" or georeference is None:
        return transform, None
    x, y, z = transform.translation.tolist()
    return replace(transform, translation=torch.zeros(3).double()), replace(georeference, offset=(x, y, z))
