"""NeRF++'s scenes (its Tanks and Temples and light fields): `train/` and `test/` with `rgb/`, `pose/`, `intrinsics/`.

Each photo has files of its name, with a matrix of four rows each in 16 numbers: `pose/NAME.txt` from the camera to the
world, with OpenCV's axes, `intrinsics/NAME.txt` in pixels of the photos, the centre of the first being at 0.5. Masks
of what counts may be in `mask/`. The paths of cameras beside them and the least depths are not read.
Source: NeRF++'s own description (github.com/Kai-46/nerfplusplus) and what it takes the files for.
"""

from pathlib import Path

from etsplat.core.errors import InputError
from etsplat.data.frames import MASK_FOLDER, Frame, Listing, Wanted, find_mask
from etsplat.data.matrix_cameras import checked_intrinsics, photo_by_name
from etsplat.data.scene_files import Entry, points_beside, read_text, unplaced_beside, unplaced_note

MARK = "train/pose/ and train/intrinsics/ of NeRF++"
RANK = 14

_TESTED = ("test", "validation")
"""The first that has poses is tested."""


def recognises(folder: Path) -> bool:
    """Whether there are poses and intrinsics for training."""
    return all((folder / "train" / name).is_dir() for name in ("pose", "intrinsics"))


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The photos, sorted by name; those of `validation/` are tested where there is no `test/`.

    Raises:
        InputError: a file is missing or damaged, or there are no poses for training; a mask is missing.
    """
    found = {part: _poses(folder / part) for part in ("train", *_TESTED)}
    if not found["train"]:
        raise InputError(f"scene {folder / 'train' / 'pose'}: holds no poses (NAME.txt); copy them there")
    tested, *others = sorted(_TESTED, key=lambda part: not found[part])
    frames = [_frame(folder, part, path, wanted) for part in ("train", tested) for path in found[part]]
    frames.sort(key=lambda frame: frame.name)
    notes = unplaced_beside(frames)
    left = sum(len(found[part]) for part in others)
    notes += unplaced_note(left, len(frames) + left, f"are for {others[0]}")
    test = [view for view, frame in enumerate(frames) if not frame.name.startswith("train/")]
    train = [view for view, frame in enumerate(frames) if frame.name.startswith("train/")]
    return Listing(frames, (train, test) if test else None, points_beside(folder, frames), notes)


def _poses(part: Path) -> list[Path]:
    return sorted((part / "pose").glob("*.txt"), key=lambda path: path.name)


def _frame(folder: Path, part: str, path: Path, wanted: Wanted) -> Frame:
    intrinsics = folder / part / "intrinsics" / path.name
    camera = Entry(intrinsics, "the camera", {"matrix": read_text(intrinsics)})
    entry = Entry(path, "the camera", {"pose": read_text(path)})
    name, image, size = photo_by_name(folder, f"{part}/rgb", f"{path.stem}.png", path, wanted)
    pose, K = entry.affine("pose"), checked_intrinsics(camera, camera.affine("matrix")[:, :3])
    mask = _mask(folder, part, name, path, wanted)
    return Frame(f"{part}/{name}", image, mask, entry.viewmat(pose[:, :3], pose[:, 3]), K, size)


def _mask(folder: Path, part: str, name: str, path: Path, wanted: Wanted) -> Path | None:
    """As of every layout, or else in the folder `mask/` of the part."""
    own = folder / part / "mask"
    if wanted.masks is not None or (folder / MASK_FOLDER).is_dir() or not own.is_dir():
        return wanted.mask_of(folder, f"{part}/{name}", path)
    return find_mask(own, name, path)
