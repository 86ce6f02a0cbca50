"""Refined cameras of a run: the photos that judge them, and the capture as it is seen by them ever after."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.core.workers import workers
from etsplat.data.dataset import Dataset, Normalization
from etsplat.io.refined_camera_files import read_refined_cameras

FEWEST = 4
"""Of fewer training photos none can be kept aside to judge by."""

ONE_IN = 16
"""One in so many training photos is kept aside where a run would keep none, or two of fewer than 32."""


def kept_aside(capture: Dataset, watch: int | None, refine: Literal["off", "poses", "all"]) -> Dataset:
    """The capture with the photos kept from training that a run needs, and a note where only cameras need them.

    Args:
        capture: photos.
        watch: one in so many is kept, as of `Dataset.watching`.
        refine: which cameras are refined.

    Raises:
        InputError: there are too few photos, or several workers, whose runs do not refine cameras yet.
    """
    if refine != "off" and workers().count > 1:
        raise InputError("refine_cameras: several workers cannot do that yet; start one process, without torchrun")
    kept, count = capture.watching(watch), len(capture.train)
    if refine == "off" or kept.watched:
        return kept
    if count < FEWEST:
        raise InputError(
            f"refine_cameras: some photos must be kept from training to judge by, and {count} are too few for that; "
            f"add some, for at least {FEWEST}, or set it to off"
        )
    kept = capture.watching(min(ONE_IN, count // 2))
    note = f"{len(kept.watched)} photos are kept from training, to judge whether refined cameras do good"
    return replace(kept, notes=(*kept.notes, note))


def refined_capture(capture: Dataset, folder: Path) -> Dataset:
    """A capture by the cameras that a run refined; as it is where the run has none. Test views stay where they were.

    Args:
        capture: of the run, in any frame.
        folder: of the run.

    Raises:
        InputError: the file of cameras is damaged.
    """
    found = read_refined_cameras(folder)
    if not found:
        return capture
    viewmats, Ks = capture.viewmats.clone(), capture.Ks.clone()
    for view in sorted({*range(len(capture))} - {*capture.test}):
        if (row := found.get(capture.names[view])) is None:
            continue
        (width, height), own = capture.images.sizes[view], torch.tensor(row.viewmat, dtype=torch.float64)
        viewmats[view] = _in_frame(own, capture.normalization)
        ratios = torch.tensor([width / row.width, height / row.height, 1.0], dtype=torch.float64)
        Ks[view] = torch.tensor(row.K, dtype=torch.float64) * ratios[:, None]
    return replace(capture, viewmats=viewmats, Ks=Ks)


def alignment_starts(given: Dataset, refined: Dataset) -> dict[int, Cameras]:
    """Where test photos are aligned from, by their index: as given, through the lenses that training photos got.

    Args:
        given: a capture.
        refined: the same with the cameras of a run.
    """

    def lens(view: int) -> tuple[float, ...]:
        return *given.images.sizes[view], *given.Ks[view].flatten().tolist()

    lenses = {lens(view): refined.Ks[view] for view in given.train}
    return {
        view: Cameras(
            given.viewmats[view][None].float(),
            lenses.get(lens(view), given.Ks[view])[None].float(),
            *given.images.sizes[view],
        )
        for view in given.test
    }


def _in_frame(viewmat: Float[Tensor, "4 4"], frame: Normalization) -> Float[Tensor, "4 4"]:
    moved = viewmat.clone()
    moved[:3, 3] = (viewmat[:3, 3] + viewmat[:3, :3] @ frame.center.double()) / frame.radius
    return moved
