"""How trained soups look at other sizes than that which they were trained at.

    python -m benchmarks.zooming runs/bonsai runs/fox

A row of a table in Markdown for each run: PSNR of its test views, soft, against the photos at a quarter, half, once and
twice the size of training (a capture whose photos are not so large has none). At a quarter and half: with one sample a
pixel; as `etsplat render` draws them; and drawn at the size of training, then shrunk by the mean of the pixels.
"""

import sys
from pathlib import Path
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.loader import ViewLoader
from etsplat.data.pictures import as_float
from etsplat.io.images import over_background
from etsplat.io.run_directory import RunDirectory
from etsplat.metrics.image import psnr
from etsplat.tasks.opened_runs import SoupRun, open_run
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.render_soup import draw
from etsplat.tasks.sources import load_scene

FACTORS = (0.25, 0.5, 1.0, 2.0)


def photos_at(run: SoupRun, factor: float) -> Dataset | None:
    """The capture at a multiple of the size of training; None if its photos are smaller than that."""
    capture, record = run.needed_capture(), RunDirectory(run.path).read_config()
    width, _ = capture.images.sizes[0]
    wanted = round(factor * width)
    sized = load_scene(record["paths"]["source"], wanted, record["paths"].get("images"), record["paths"].get("masks"))
    return sized if sized.images.sizes[0][0] == wanted else None


@torch.no_grad()
def psnr_at(run: SoupRun, factor: float, config: RenderConfig) -> tuple[float, float] | None:
    """Mean PSNR of the test views as they are drawn, and as they are drawn at the size of training and shrunk."""
    sized = photos_at(run, factor)
    if sized is None:
        return None
    loader, behind = ViewLoader(sized, run.device), torch.tensor(run.soup.appearance.background)
    cameras, direct, shrunk = run.needed_capture().cameras, [], []
    for index in sized.test:
        view = loader.view(index)
        photo = as_float(view.photo[0])
        photo = over_background(photo, behind) if photo.shape[-1] == 4 else photo
        counts = 1.0 if view.mask is None else as_float(view.mask[0])[..., None]

        def score(picture: Float[Tensor, "H W 3"], photo: Tensor = photo, counts: Tensor | float = counts) -> float:
            return psnr(photo + counts * (picture.clamp(0, 1) - photo), photo)

        direct.append(score(draw(run.soup, view.camera, config)["color"]))
        whole = run.soup.render(cameras[index], backgrounds=behind[None]).color.movedim(-1, 1)
        small = torch.nn.functional.interpolate(whole, size=photo.shape[:2], mode="area")
        shrunk.append(score(small[0].movedim(0, -1)))
    return fmean(direct), fmean(shrunk)


def row(path: Path) -> list[str]:
    """The numbers of one run."""
    run, cells = open_run(path), []
    for factor in FACTORS:
        aliased, drawn = (psnr_at(run, factor, RenderConfig(antialias=antialias)) for antialias in (False, True))
        if aliased is None or drawn is None:
            cells.append("-")
        elif factor >= 1:
            cells.append(f"{drawn[0]:.2f}")
        else:
            cells.append(f"{aliased[0]:.2f} / {drawn[0]:.2f} / {drawn[1]:.2f}")
    return [path.name, *cells]


if __name__ == "__main__":
    print("| run | a quarter: one sample / drawn / shrunk | half: the same | once | twice |\n|---|---|---|---|---|")
    for name in sys.argv[1:]:
        print("| " + " | ".join(row(Path(name))) + " |", flush=True)
