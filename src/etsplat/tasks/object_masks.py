"""Masks for posed photos of an object: by the colours of a plain background, or by what it stands on."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree
from typing import Literal

import torch

from etsplat.core.errors import InputError
from etsplat.core.precision import usual_defaults
from etsplat.data.dataset import Dataset
from etsplat.data.photo_masks import LEAST_SHARE, mask_file, posed_photos, write_mask, write_masks
from etsplat.data.pictures import as_float
from etsplat.data.plain_borders import at_plain_borders
from etsplat.data.standing_object import find_standing, mask_of
from etsplat.data.undistortion import check_output
from etsplat.io.atomic import write_error
from etsplat.io.images import image_size
from etsplat.io.locks import scratch_folder
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.loop import Event, PrepareEvent, StepEvent
from etsplat.tasks.coarse_soup import depth_where
from etsplat.tasks.judgement import spread
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.sources import load_scene
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig

By = Literal["auto", "background", "surface"]
"""What tells an object from the rest: a plain background, or the surface that it stands on; the first that can."""

Progress = Callable[[str, int, int], None]
"""Called with (phase, done, of how many)."""

WIDTH, STEPS, TRIANGLES = 400, 1500, 40_000
"""The soup whose depths tell: of photos of so many pixels at most, in so many steps, of so many triangles."""

DETAIL = 2
"""Masks are found in pictures so many times as wide."""

TRIED = 12
"""Of many photos so many are asked first whether their background is plain: if not, the others need not be."""

MAPS = 48
"""Depth maps by which an object is found, of photos all around."""

_COVERED = 0.5
"""Of a pixel, where its depth is known."""


@dataclass(frozen=True)
class MaskedPhotos:
    """What masks were written.

    Attributes:
        count: how many.
        by: what told the object from the rest.
        refused: why there is none, for the photos without.
    """

    count: int
    by: Literal["background", "surface"]
    refused: dict[str, str]


@usual_defaults()
def mask_capture(
    scene: Path | str,
    out: Path | str,
    *,
    by: By = "auto",
    soup: Path | str | None = None,
    progress: Progress | None = None,
) -> MaskedPhotos:
    """Writes a mask for each posed photo of an object.

    Args:
        scene: a folder with posed photos, of any layout.
        out: folder for the masks, which every reader of photos then takes; must not exist or be empty.
        by: "background": what differs from the colours of a plain background. "surface": what stands on a table, a
            floor or the ground, in the middle of the photos, by the depths of a soup of triangles. "auto": by the
            background if half of the photos have a plain one, else by the surface.
        soup: run of `etsplat.train` over the scene, whose depths tell; None fits a small soup, which is thrown away.
        progress: called with (phase, done, of how many).

    Raises:
        InputError: there is none for more than half of the photos; the scene, a photo or the soup cannot be read; `out`
            cannot be used.
    """
    scene, out = Path(scene), Path(out)
    check_output(out)
    report = progress or (lambda phase, done, total: None)
    photos = posed_photos(scene)
    try:
        with scratch_folder(out) as work:
            masked = _write(photos, scene, work, by if soup is None else "surface", soup, report)
            os.replace(work / "masks", out)
    except OSError as error:
        raise write_error(out, error) from error
    return masked


def _write(
    photos: dict[str, Path], scene: Path, work: Path, by: By, soup: Path | str | None, report: Progress
) -> MaskedPhotos:
    """Masks in a folder of `work`."""
    if by != "surface":
        try:
            if by == "auto" and len(photos) > 2 * TRIED:
                names = list(photos)
                few = {names[index]: photos[names[index]] for index in spread(range(len(names)), TRIED)}
                write_masks(few, work / "few", report)
            refused = write_masks(photos, work / "masks", report)
            return MaskedPhotos(len(photos) - len(refused), "background", refused)
        except InputError:
            if by == "background":
                raise
            rmtree(work / "masks", ignore_errors=True)
    capture = load_scene(scene, DETAIL * WIDTH, preload=False)
    shown = _own_soup(scene, work, report) if soup is None else _given_soup(soup, scene)
    refused = _write_standing(photos, capture, shown, work / "masks", report)
    if len(refused) <= (1 - LEAST_SHARE) * len(photos):
        return MaskedPhotos(len(photos) - len(refused), "surface", refused)
    raise InputError(
        "masks: nothing was found that stands on a surface below the cameras and that nearly all photos have whole in"
        " their frame; take photos from all sides with some of the surface around the object, or draw masks"
    )


def _given_soup(path: Path | str, scene: Path) -> TriangleSoup:
    run = open_run(path, scene)
    if run.other_scene:
        raise InputError(f"{path}: is of another scene than {scene}; name a run of that one, or none")
    return run.soup


def _own_soup(scene: Path, work: Path, report: Progress) -> TriangleSoup:
    """A small soup of all photos."""
    capture = load_scene(scene, WIDTH)
    capture = replace(capture, train=list(range(len(capture))), test=[])

    def hear(event: Event) -> None:
        if isinstance(event, PrepareEvent):
            report("Reading the photos", event.done, event.total)
        if isinstance(event, StepEvent):
            report("Fitting a coarse soup", event.iteration, event.iterations)

    config = TrainConfig.of("quick").changed(
        {"iterations": STEPS, "max_triangles": TRIANGLES, "asset": False, "watch": 0, "drawing.sh_degree": 1}
    )
    return train(capture, work / "soup", config, callbacks=[hear]).soup


@torch.no_grad()
def _write_standing(
    photos: dict[str, Path], capture: Dataset, soup: TriangleSoup, folder: Path, report: Progress
) -> dict[str, str]:
    """Masks of what stands on a surface; and why there is none, for the photos without."""
    some = spread(range(len(capture)), MAPS)
    maps = {}
    for done, view in enumerate(some):
        report("Looking for what stands on a surface", done, len(some))
        maps[view] = depth_where(soup, capture, view, _COVERED)
    steps = {view: max(1, depth.shape[1] // WIDTH) for view, depth in maps.items()}
    found = find_standing(capture, {view: depth[:: steps[view], :: steps[view]] for view, depth in maps.items()})
    if found is None:
        return dict.fromkeys(photos, "nothing was found")
    refused = {}
    for view, (name, photo) in enumerate(photos.items()):
        report("Masking", view, len(photos))
        depth = maps[view] if view in maps else depth_where(soup, capture, view, _COVERED)
        mask = mask_of(found, capture, view, depth).numpy()
        if not mask.any():
            refused[name] = "it does not show what stands on the surface"
            continue
        mask = at_plain_borders(mask, as_float(capture.images[view])[..., :3].double().numpy())
        write_mask(mask_file(folder, name), mask, image_size(photo))
    report("Masking", len(photos), len(photos))
    return refused
