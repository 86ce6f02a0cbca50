"""Exported GLB files as three.js, <model-viewer> and Blender show them, beside our own picture and the test photos.

    npm install --prefix FOLDER three @google/model-viewer gltf-validator
    python -m benchmarks.elsewhere RUNS [--npm FOLDER] [--blender PYTHON] [--samples N] [--file NAME] [--keep FOLDER]

Of each run it takes textured.glb (`etsplat reconstruct --texture`, `etsplat export --texture`) or opaque.glb (`etsplat
train`). A row for each program: PSNR of the test views against the photos, and against our own picture with 4 x 4
samples a pixel. three.js and <model-viewer> run in Chromium, with WebGL in software and 4 samples a pixel;
<model-viewer>, whose camera stands upright around a point, is compared with our picture from there, of objects alone.
Blender needs a Python with bpy (`pip install bpy`). Khronos' validator is asked about the file.
"""

import argparse
import base64
import io
import json
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.elsewhere.server import PAGES, serving
from benchmarks.elsewhere.subject import Shot, Subject, around, subject_of
from etsplat.io.images import save_image
from etsplat.metrics.image import psnr
from tests.helpers.browser import Page, browser_page

VALIDATE = """
const [folder, file] = process.argv.slice(1);
require(folder + "/gltf-validator").validateBytes(new Uint8Array(require("fs").readFileSync(file)))
  .then((report) => console.log(JSON.stringify(report.issues)));
"""


@dataclass(frozen=True)
class Row:
    """What a program made of a file, in dB: against photos where it saw the test views, and against our pictures."""

    program: str
    photos: float | None
    ours: float | None

    def __str__(self) -> str:
        return " | ".join(
            [self.program, *("" if value is None else f"{value:.2f}" for value in (self.photos, self.ours))]
        )


def rows_of(subject: Subject, options: argparse.Namespace) -> Iterator[Row]:
    """A row for each program, ours first."""
    shots = subject.shots()
    yield Row("etsplat", fmean(psnr(shot.ours, shot.photo) for shot in shots), None)
    if options.npm:
        with serving(options.npm, subject.file) as server, browser_page() as page:
            for samples in (1, 4):
                pictures = three_pictures(page, server, subject, shots, samples)
                yield compared(f"three.js, {samples} x {samples}", shots, pictures, options.keep)
    if options.npm and subject.is_object:
        with serving(options.npm, subject.file) as server, browser_page() as page:
            circle = around(subject)
            yield compared("model-viewer", circle, model_viewer_pictures(page, server, circle), options.keep)
    if options.blender:
        pictures = blender_pictures(options.blender, subject, shots, options.samples)
        yield compared("Blender, Cycles", shots, pictures, options.keep)


def compared(program: str, shots: Sequence[Shot], pictures: Sequence[Tensor], keep: Path | None) -> Row:
    """Means over the views; each picture is kept beside ours and the photo where there is a folder for that."""
    photos, ours = [], []
    for shot, found in zip(shots, pictures, strict=True):
        picture = shot.counting(found)
        ours.append(psnr(picture, shot.ours))
        if shot.photo is not shot.ours:
            photos.append(psnr(picture, shot.photo))
        if keep:
            sheet = [shot.photo, shot.ours, picture, 0.5 + 4 * (picture - shot.ours)]
            save_image(keep / f"{program.replace(', ', '_').replace(' ', '')}_{shot.name}.png", torch.cat(sheet, dim=1))
    return Row(program, fmean(photos) if photos else None, fmean(ours))


def three_pictures(page: Page, server: str, subject: Subject, shots: Sequence[Shot], samples: int) -> list[Tensor]:
    """Each test view, drawn so many times larger along each side and averaged."""
    page.visit(f"{server}/three.html")
    materials = page.value(f"load('{server}/file.glb')")
    if samples == 1:
        print(f"    three.js: {', '.join(materials)}", flush=True)
    found = []
    for shot in shots:
        view = {**shot.view(samples), "background": list(subject.background)}
        found.append(averaged(torch.from_numpy(page.picture(f"photograph({json.dumps(view)})")).float(), samples))
    _complain(page)
    return found


def model_viewer_pictures(page: Page, server: str, shots: Sequence[Shot]) -> list[Tensor]:
    """From around the origin."""
    page.ask("Emulation.setDeviceMetricsOverride", width=1280, height=1280, deviceScaleFactor=1, mobile=False)
    page.visit(f"{server}/model_viewer.html")
    page.value(f"load('{server}/file.glb', {json.dumps(shots[0].view(1))})")
    found = []
    for shot in shots:
        text = page.value(f"photograph({json.dumps({**shot.view(1), **shot.orbit})})")
        found.append(over(io.BytesIO(base64.b64decode(text.split(",")[1])), (0.0, 0.0, 0.0)))
    _complain(page)
    return found


def _complain(page: Page) -> None:
    for error in page.errors:
        if not error.startswith("asked for"):
            print(f"    the page says: {error}", flush=True)


def blender_pictures(python: Path, subject: Subject, shots: Sequence[Shot], samples: int) -> list[Tensor]:
    """Each test view over the background, of so many samples a pixel."""
    with TemporaryDirectory() as folder:
        places = [Path(folder) / f"{number}.png" for number in range(len(shots))]
        views = [{**shot.view(1), "picture": str(place)} for shot, place in zip(shots, places, strict=True)]
        request = {"file": str(subject.file.resolve()), "samples": samples, "views": views}
        (Path(folder) / "request.json").write_text(json.dumps(request))
        command = [python, PAGES / "in_blender.py", Path(folder) / "request.json"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if ended.returncode:
            raise SystemExit(f"Blender failed:\n{ended.stderr[-2000:]}")
        return [over(place, subject.background) for place in places]


def over(file: Path | io.BytesIO, background: Sequence[float]) -> Tensor:
    """(H, W, 3) in [0, 1]: a picture with transparency over a colour."""
    rgba = torch.from_numpy(np.asarray(Image.open(file).convert("RGBA")) / 255).float()
    return rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * torch.tensor(background)


def averaged(picture: Tensor, samples: int) -> Tensor:
    """(H, W, 3) means of blocks of (sH, sW, 3)."""
    height, width = picture.shape[0] // samples, picture.shape[1] // samples
    return picture.view(height, samples, width, samples, 3).mean(dim=(1, 3))


def validated(npm: Path, file: Path) -> str:
    """What Khronos' validator finds, in a line."""
    command = ["node", "-e", VALIDATE, (npm / "node_modules").resolve(), file.resolve()]
    issues: dict[str, Any] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    kinds = ", ".join(sorted({issue["code"] for issue in issues["messages"]}))
    counts = ", ".join(f"{issues[f'num{kind}']} {kind.lower()}" for kind in ("Errors", "Warnings", "Infos", "Hints"))
    return f"{counts} {kinds}".strip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument(
        "--npm", type=Path, help="folder with node_modules: three, @google/model-viewer, gltf-validator"
    )
    parser.add_argument("--blender", type=Path, help="a Python that has bpy")
    parser.add_argument("--samples", type=int, default=64, help="of Blender, a pixel")
    parser.add_argument("--file", help="in the run's folder, in the place of textured.glb or opaque.glb")
    parser.add_argument(
        "--keep", type=Path, help="folder for photo, our picture, theirs, and four times the difference"
    )
    options = parser.parse_args()
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
    for run in options.runs:
        subject = subject_of(run, options.file)
        size = subject.file.stat().st_size / 1e6
        print(f"{run.name}, {subject.file.name}: {subject.model.count:,} faces, {size:.2f} MB", flush=True)
        if options.npm:
            print(f"    validator: {validated(options.npm, subject.file)}", flush=True)
        for row in rows_of(subject, options):
            print(f"    {row}", flush=True)


if __name__ == "__main__":
    main()
