"""NSVF's scenes: `intrinsics.txt`, `pose/NAME.txt` and `rgb/NAME.png`.

A pose is a matrix of four rows from the camera to the world, with OpenCV's axes. The intrinsics are such a matrix too,
or of three rows, or the file's first line says f, cx and cy; they are in pixels of the photos. Names that begin with
0_ are for training, with 1_ for validation, with 2_ for testing. The centre of a pixel is not told: the synthetic
scenes have w/2, h/2 as the middle, as we do, and other numbers are taken like these. `bbox.txt` and what else lies
there is not read. Source: NSVF's own description (github.com/facebookresearch/NSVF) and what it takes the files for.
"""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Listing, Wanted, pinhole
from etsplat.data.matrix_cameras import checked_intrinsics, photo_by_name
from etsplat.data.scene_files import Entry, points_beside, read_text, unplaced_beside, unplaced_note

MARK = "intrinsics.txt, pose/ and rgb/ of NSVF"
RANK = 13

_PARTS = ("0_", "1_", "2_")
"""How the names of photos begin that are for training, for validation and for testing."""


def recognises(folder: Path) -> bool:
    """Whether all of these are there."""
    return (folder / "intrinsics.txt").is_file() and all((folder / name).is_dir() for name in ("pose", "rgb"))


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The photos of all poses, sorted by name; those for validation are tested where none are for testing.

    Raises:
        InputError: a file is damaged, or there are no poses; a mask is missing.
    """
    K = _intrinsics(folder / "intrinsics.txt")
    paths = sorted((folder / "pose").glob("*.txt"), key=lambda path: path.name)
    if not paths:
        raise InputError(f"scene {folder / 'pose'}: holds no poses (NAME.txt); copy them there")
    frames = [_frame(folder, path, K, wanted) for path in paths]
    notes = unplaced_beside(frames)
    split, frames, left = _parted(frames)
    notes += unplaced_note(left, len(frames) + left, "are for validation")
    return Listing(frames, split, points_beside(folder, frames), notes)


def _frame(folder: Path, path: Path, K: Float[Tensor, "3 3"], wanted: Wanted) -> Frame:
    entry = Entry(path, "the camera", {"pose": read_text(path)})
    name, image, size = photo_by_name(folder, "rgb", f"{path.stem}.png", path, wanted)
    pose = entry.affine("pose")
    mask = wanted.mask_of(folder, name, path)
    return Frame(name, image, mask, entry.viewmat(pose[:, :3], pose[:, 3]), K, size)


def _intrinsics(path: Path) -> Float[Tensor, "3 3"]:
    lines = [line.split() for line in read_text(path).splitlines() if line.strip()]
    for side in (3, 4):
        if [len(line) for line in lines[:side]] == [side] * side:
            entry = Entry(path, "the camera", {"matrix": lines[:side]})
            return checked_intrinsics(entry, entry.numbers("matrix", side * side).reshape(side, side)[:3, :3])
    entry = Entry(path, "the camera", {"first line": lines[0][:3] if lines else None})
    focal, cx, cy = entry.numbers("first line", 3).tolist()
    return pinhole(focal, focal, cx, cy)


def _parted(frames: list[Frame]) -> tuple[tuple[list[int], list[int]] | None, list[Frame], int]:
    """(train, test) by how names begin, the frames that are in it, and how many are left out."""
    parts = [frame.name[:2] for frame in frames]
    train, validation, test = _PARTS
    tested = test if test in parts else validation
    if not set(parts) <= set(_PARTS) or not {train, tested} <= set(parts):
        return None, frames, 0
    kept = [frame for frame in frames if frame.name.startswith((train, tested))]
    views = {part: [view for view, frame in enumerate(kept) if frame.name.startswith(part)] for part in (train, tested)}
    return (views[train], views[tested]), kept, len(frames) - len(kept)
