"""MVSNet's scenes, of BlendedMVS and of many networks for stereo: `cams/NAME_cam.txt`, `images/NAME.jpg`, `pair.txt`.

The file of a camera has the word `extrinsic` and a matrix of four rows from the world to the camera, with OpenCV's
axes; then `intrinsic` and one of three rows, in pixels of the photos, the centre of the first being at 0.5; then the
range of depths, which is not read, like pairs of photos and depth maps (`.pfm`). BlendedMVS has its photos in
`blended_images/`, and copies of them before white, NAME_masked.jpg, which are not read either.
Source: MVSNet's own description (github.com/YoYo000/MVSNet) and that of BlendedMVS.
"""

from pathlib import Path

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Listing, Wanted
from etsplat.data.matrix_cameras import checked_intrinsics, photo_by_name
from etsplat.data.scene_files import Entry, points_beside, read_text, unplaced_beside

MARK = "cams/ of MVSNet"
RANK = 15

_ENDING = "_cam.txt"
_PHOTOS = ("blended_images", "images", "image")


def recognises(folder: Path) -> bool:
    """Whether there is the file of a camera."""
    return any((folder / "cams").glob(f"*{_ENDING}"))


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The photos of all cameras, sorted by name; points of `points.ply`.

    Raises:
        InputError: a file is damaged; there is no folder of photos; a mask is missing.
    """
    place = next((name for name in _PHOTOS if (folder / name).is_dir()), None)
    if place is None:
        raise InputError(f"scene {folder}: no folder {' or '.join(_PHOTOS)} beside cams/; copy the photos there")
    paths = sorted((folder / "cams").glob(f"*{_ENDING}"), key=lambda path: path.name)
    frames = [_frame(folder, place, path, wanted) for path in paths]
    return Listing(frames, points=points_beside(folder, frames), notes=unplaced_beside(frames))


def _frame(folder: Path, place: str, path: Path, wanted: Wanted) -> Frame:
    words = read_text(path).split()
    starts = [words.index(word) + 1 if word in words else None for word in ("extrinsic", "intrinsic")]
    extrinsic, intrinsic = starts
    if extrinsic is None or intrinsic is None or extrinsic > intrinsic:
        raise InputError(f"scene {path}: does not say `extrinsic` and then `intrinsic`; export the cameras again")
    said = {"extrinsic": words[extrinsic : intrinsic - 1], "intrinsic": words[intrinsic : intrinsic + 9]}
    entry = Entry(path, "the camera", {key: " ".join(value) for key, value in said.items()})
    name, image, size = photo_by_name(folder, place, f"{path.name.removesuffix(_ENDING)}.jpg", path, wanted)
    pose, K = entry.affine("extrinsic"), checked_intrinsics(entry, entry.numbers("intrinsic", 9).reshape(3, 3))
    viewmat = entry.viewmat(pose[:, :3].T, -pose[:, :3].T @ pose[:, 3])
    return Frame(name, image, wanted.mask_of(folder, name, path), viewmat, K, size)
