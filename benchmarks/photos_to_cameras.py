"""How well cameras are found: of photos as they are, as two phones would have written them, and of a video.

python -m benchmarks.photos_to_cameras kitchen25 --inputs plain phones video --mappers incremental global

Scenes are those of `data/scenes`. Their cameras are what is compared with, after a similarity: places in
parts of the root mean square distance of the cameras from their middle, angles in degrees.

plain   the photos in one folder
phones  every second photo with EXIF (model, focal length), most of these stored on their side or upside down, a third
        as HEIC, in one subfolder; the others, cut to 3/4 of their sides, so of a longer focal length, without EXIF,
        in another
video   every photo for five frames, all but one of them blurred by motion
"""

import argparse
import math
import subprocess
import sys
import time
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.table import Table

from etsplat.core.cameras import camera_centers
from etsplat.data.colmap_process import Mapper
from etsplat.data.dataset import Dataset
from etsplat.data.load import load_dataset
from etsplat.data.structure_from_motion import find_cameras

SCENES = Path(__file__).parents[2] / "shared" / "data" / "scenes"

TURNS = (
    (1, None),
    (6, Image.Transpose.ROTATE_90),
    (8, Image.Transpose.ROTATE_270),
    (3, Image.Transpose.ROTATE_180),
)
"""Values of EXIF's Orientation, and what makes such pixels of upright ones."""

HELD = 5
"""Frames that a photo takes in a video."""


def write_plain(photos: list[Path], folder: Path) -> Path:
    """Links to the photos."""
    for photo in photos:
        (folder / photo.name).symlink_to(photo)
    return folder


def write_phones(photos: list[Path], folder: Path) -> Path:
    """See above."""
    import pillow_heif

    exif = Image.Exif()
    exif[0x0110] = "Phone"  # Model
    exif.get_ifd(0x8769).update({0x920A: 4.3, 0xA405: 37})  # FocalLength, FocalLengthIn35mmFilm
    for name in ("phone", "tele"):
        (folder / name).mkdir()
    for index, photo in enumerate(photos):
        image = Image.open(photo).convert("RGB")
        if index % 2:
            width, height = image.size
            box = (width / 8, height / 8, 7 * width / 8, 7 * height / 8)
            image = image.resize((round(0.9 * width), round(0.9 * height)), Image.Resampling.BICUBIC, box)
            image.save(folder / "tele" / f"{photo.stem}.jpg", quality=95, subsampling=0)
            continue
        exif[0x0112], turn = TURNS[index // 2 % 4]
        stored = image if turn is None else image.transpose(turn)
        if index % 3 == 0:
            pillow_heif.from_pillow(stored).save(
                folder / "phone" / f"{photo.stem}.heic", exif=exif.tobytes(), quality=92
            )
        else:
            stored.save(folder / "phone" / f"{photo.stem}.jpg", exif=exif.tobytes(), quality=95, subsampling=0)
    return folder


def write_video(photos: list[Path], folder: Path) -> Path:
    """See above; which of the five is sharp is drawn by lot."""
    from imageio_ffmpeg import get_ffmpeg_exe

    rng = np.random.default_rng(0)
    width, height = (side // 2 * 2 for side in Image.open(photos[0]).size)
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", "10", "-i", "-"]
    path = folder / "walk.mp4"
    encode = ["-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p", str(path)]
    frames = []
    for photo in photos:
        pixels = np.asarray(Image.open(photo).convert("RGB"))[:height, :width].astype(np.float32)
        sharp = int(rng.integers(HELD))
        for number in range(HELD):
            reach = 0 if number == sharp else int(rng.integers(2, 6))
            blurred = np.mean([np.roll(pixels, step, axis=1) for step in range(-reach, reach + 1)], axis=0)
            frames.append(blurred.astype(np.uint8).tobytes())
    command = [get_ffmpeg_exe(), "-y", "-loglevel", "error", *source, *encode]
    subprocess.run(command, input=b"".join(frames), check=True)
    return path


WRITERS = {"plain": write_plain, "phones": write_phones, "video": write_video}


def photo_of(name: str, photos: list[Path]) -> str:
    """The stem of the photo that a photo or frame of an input shows."""
    stem = PurePosixPath(name).stem
    return photos[int(stem.removeprefix("frame_")) // HELD].stem if stem.startswith("frame_") else stem


def pose_errors(found: Dataset, truth: Dataset, pairs: list[tuple[int, int]]) -> tuple[list[float], list[float]]:
    """Distances of cameras, and angles between them in degrees; after the best similarity of the centres."""
    a, b = (torch.tensor(indices) for indices in zip(*pairs, strict=True))
    X, Y = camera_centers(found.viewmats[a]).double(), camera_centers(truth.viewmats[b]).double()
    x, y = X - X.mean(dim=0), Y - Y.mean(dim=0)
    U, S, Vt = torch.linalg.svd(y.T @ x)
    signs = torch.tensor([1.0, 1.0, float(torch.sign(torch.linalg.det(U @ Vt)))], dtype=torch.float64)
    R = U @ torch.diag(signs) @ Vt
    moved = float((S * signs).sum() / (x**2).sum()) * x @ R.T
    spread = float((y**2).sum(dim=1).mean()) ** 0.5
    turned = found.viewmats[a][:, :3, :3].double() @ R.T @ truth.viewmats[b][:, :3, :3].double().mT
    cosines = (turned.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2
    angles = [math.degrees(math.acos(min(1.0, max(-1.0, float(c))))) for c in cosines]
    return ((moved - y).norm(dim=1) / spread).tolist(), angles


def measure(scene: str, kind: str, mapper: Mapper, threads: int) -> list[str]:
    """A row of the table."""
    photos = sorted((SCENES / scene / "images").iterdir())
    truth = load_dataset(SCENES / scene, preload=False)
    with TemporaryDirectory() as name:
        (Path(name) / "input").mkdir()
        source = WRITERS[kind](photos, Path(name) / "input")
        begun = time.perf_counter()
        found = find_cameras(source, Path(name) / "scene", mapper=mapper, frames=len(photos), threads=threads)
        seconds = time.perf_counter() - begun
        capture = load_dataset(found.scene, preload=False)
        index = {view: number for number, view in enumerate(truth.names)}
        pairs = [(number, index[photo_of(view, photos)]) for number, view in enumerate(found.placed)]
        places, angles = pose_errors(capture, truth, pairs)
    count = len(found.placed) + len(found.unplaced)
    return [
        scene,
        kind,
        mapper,
        f"{len(found.placed)} of {count}",
        str(found.cameras),
        f"{100 * float(np.median(places)):.2f} / {100 * max(places):.2f} %",
        f"{float(np.median(angles)):.2f} / {max(angles):.2f}",
        f"{found.points:,}",
        f"{seconds:.0f}",
    ]


def main() -> int:
    """The exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--inputs", nargs="+", choices=list(WRITERS), default=["plain", "phones"])
    parser.add_argument("--mappers", nargs="+", choices=["incremental", "global"], default=["incremental"])
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    table = Table("scene", "input", "mapper", "placed", "cameras", "place, median / largest", "angle", "points", "s")
    console = Console(width=140)
    for scene in options.scenes:
        for kind in options.inputs:
            for mapper in options.mappers:
                row = measure(scene, kind, mapper, options.threads)
                print(" | ".join(row), flush=True)
                table.add_row(*row)
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
