"""Camera paths as files: key poses in JSON, between which a film moves (docs/conventions.md, Camera paths)."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.io.json_text import is_number, parse_json

FORMAT = "etsplat path 1"

MOST_KEYS = 10_000

_STRAIGHT = 1e-3
"""By which the rotation of a pose may be none."""


@dataclass(frozen=True)
class KeyPoses:
    """Poses that a camera goes through.

    Attributes:
        viewmats: (K, 4, 4) float64, world to camera, in the capture's units.
        fovs: (K,) float64, vertical fields of view in degrees.
        aspect: width of the pictures by their height; None for that of the photos.
    """

    viewmats: Float[Tensor, "K 4 4"]
    fovs: Float[Tensor, " K"]
    aspect: float | None = None

    def __len__(self) -> int:
        return len(self.viewmats)

    def to_json(self) -> str:
        """What a file says of them."""
        both = zip(self.viewmats.tolist(), self.fovs.tolist(), strict=True)
        keys = [{"viewmat": viewmat, "fov": fov} for viewmat, fov in both]
        aspect = {} if self.aspect is None else {"aspect": self.aspect}
        return json.dumps({"format": FORMAT, **aspect, "keys": keys}, indent=1) + "\n"


def read_camera_path(path: Path | str) -> KeyPoses:
    """The key poses of a file.

    Raises:
        InputError: it cannot be read, is no camera path, or has a pose that is none.
    """
    path = Path(path)
    try:
        found = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a file that the viewer saved") from error
    except ValueError as error:
        raise InputError(f"{path}: is not JSON ({error}); name a file that the viewer saved") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError(f'{path}: is no camera path ("format" must be "{FORMAT}"); name one that the viewer saved')
    keys, aspect = found.get("keys"), found.get("aspect")
    if not isinstance(keys, list) or not 1 <= len(keys) <= MOST_KEYS:
        raise InputError(f"{path}: `keys` must be a list of 1 to {MOST_KEYS} poses; record some")
    if aspect is not None and not (is_number(aspect) and 0.05 <= aspect <= 20):
        raise InputError(f"{path}: `aspect` must be a number between 0.05 and 20; leave it out for that of the photos")
    for number, key in enumerate(keys):
        if problem := _problem(key):
            raise InputError(f"{path}: keys[{number}]: {problem}; record it again or take it out")
    viewmats = torch.tensor([key["viewmat"] for key in keys], dtype=torch.float64)
    return KeyPoses(viewmats, torch.tensor([key["fov"] for key in keys], dtype=torch.float64), aspect)


def _problem(key: object) -> str | None:
    """What is wrong with one pose, or None."""
    if not isinstance(key, dict):
        return "is no object with `viewmat` and `fov`"
    if not (is_number(key.get("fov")) and 1 <= key["fov"] <= 170):
        return "`fov` must be a number of degrees between 1 and 170"
    problem = pose_problem(key.get("viewmat"))
    return None if problem is None else f"`viewmat` {problem}"


def pose_problem(rows: object) -> str | None:
    """What is wrong with a world-to-camera matrix of a JSON file, or None."""
    if not (
        isinstance(rows, list)
        and len(rows) == 4
        and all(isinstance(row, list) and len(row) == 4 and all(map(is_number, row)) for row in rows)
    ):
        return "must be 4 rows of 4 numbers"
    viewmat = torch.tensor(rows, dtype=torch.float64)
    rotation = viewmat[:3, :3]
    rigid = (rotation @ rotation.T - torch.eye(3)).abs().max() < _STRAIGHT and torch.linalg.det(rotation) > 0
    if not rigid or viewmat[3].tolist() != [0, 0, 0, 1]:
        return "must be a rotation and a shift, with 0 0 0 1 below"
    return None
