"""Record3D's recordings: `metadata.json` beside `rgb/0.jpg` (export "EXR + JPG"), or an .r3d file unpacked.

`poses` has seven numbers a frame: the quaternion x, y, z, w of the camera's rotation to the world, and its position in
metres, with ARKit's axes (camera: x right, y up, looking along -z; world: y up). `K` is the matrix of intrinsics column
by column, in pixels of an image of `w` x `h`; `perFrameIntrinsicCoeffs`, where it is there, has fx, fy, cx, cy of each
frame. Nothing is distorted. Depth is not read. Source: Record3D's documentation of its formats (record3d.app) and demos
(github.com/marek-simonik/record3d).
"""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Listing, Wanted, pinhole
from etsplat.data.scene_files import OPENGL, Entry, points_beside, quaternion_rotation, read_object
from etsplat.io.images import IMAGE_SUFFIXES
from etsplat.io.paths import kind_of

MARK = "metadata.json and rgb/ of Record3D"
RANK = 4


def recognises(folder: Path) -> bool:
    """Whether there are metadata and pictures beside them."""
    return _metadata(folder) is not None


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The frames whose pictures are there: number N of them has the pose at place N. Points of `points.ply`.

    Raises:
        InputError: the metadata are damaged; pictures that are no JPEG or PNG, without a number or a pose; a mask is
            missing.
    """
    path = _metadata(folder)
    if path is None:
        raise InputError(f"scene {folder}: no metadata of Record3D; export the recording again")
    record = Entry(path, "the recording", read_object(path))
    poses, each = record.said.get("poses"), record.said.get("perFrameIntrinsicCoeffs")
    if not isinstance(poses, list):
        raise record.wrong("has no list `poses`; export it again")
    each = each if isinstance(each, list) else []
    size = Entry(path, "the recording", {"width": record.number("w"), "height": record.number("h")}).size()
    shared = record.numbers("K", 9).reshape(3, 3).T
    frames = []
    for number, image in _images(path.parent, folder, wanted):
        if number >= len(poses):
            raise InputError(f"scene {path}: has {len(poses)} poses, none for {image.name}; export the recording again")
        own = number < len(each)
        entry = Entry(path, f"frame {number}", {"pose": poses[number], "camera": each[number] if own else None})
        pose = entry.numbers("pose", 7)
        K = pinhole(*entry.numbers("camera", 4).tolist()) if own else shared
        viewmat = entry.viewmat(_rotation(entry, pose[:4]), pose[4:], OPENGL)
        frames.append(Frame(image.name, image, wanted.mask_of(folder, image.name, path), viewmat, K, size))
    frames.sort(key=lambda frame: frame.name)
    return Listing(frames, points=points_beside(folder, frames) if frames else None)


def _metadata(folder: Path) -> Path | None:
    """The file, where pictures are beside it."""
    places = [folder / name for name in ("metadata.json", "metadata", "EXR_RGBD/metadata.json")]
    return next((path for path in places if path.is_file() and _pictures(path.parent) is not None), None)


def _pictures(folder: Path) -> Path | None:
    return next((folder / name for name in ("rgb", "rgbd") if (folder / name).is_dir()), None)


def _images(recording: Path, folder: Path, wanted: Wanted) -> list[tuple[int, Path]]:
    """Numbers and files, in their order."""
    place = _pictures(recording) if wanted.images is None else folder / wanted.images
    assert place is not None
    files = [file for file in place.iterdir() if kind_of(file) in IMAGE_SUFFIXES]
    if not files:
        raise InputError(f"scene {place}: holds no JPEG or PNG; export the recording with colours as JPEG")
    odd = next(
        (file for file in files if not (file.stem.isascii() and file.stem.isdigit() and len(file.stem) < 10)), None
    )
    if odd is not None:
        raise InputError(f"scene {place}: {odd.name} is not the number of a frame; remove it")
    return sorted((int(file.stem), file) for file in files)


def _rotation(entry: Entry, quaternion: Float[Tensor, "4"]) -> Float[Tensor, "3 3"]:
    """Of x, y, z, w."""
    norm = float(quaternion.norm())
    if not 0.5 < norm < 2:
        raise entry.wrong("has a pose that is no rotation; export the recording again")
    x, y, z, w = (quaternion / norm).tolist()
    return quaternion_rotation(w, x, y, z)
