"""What becomes of the cameras of a run that refines them: cameras.json, and what its results are measured by."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset, Normalization
from etsplat.io.refined_camera_files import RefinedCamera, write_refined_cameras
from etsplat.model.model import Model
from etsplat.optim.camera_motion import distance_shown
from etsplat.optim.loop import NoteEvent
from etsplat.optim.trainer import Trainer
from etsplat.tasks.refined_cameras import alignment_starts
from etsplat.tasks.running import Job
from etsplat.tasks.scoring import Scorer


def conclude_cameras(job: Job, trainer: Trainer[Any], given: Dataset, scorer: Scorer) -> Dataset:
    """Writes cameras.json where refined cameras stayed, and says so.

    Args:
        job: within its `writing`.
        trainer: at the end.
        given: the capture that it was fitted to.
        scorer: sees training views by refined cameras from now on, and aligns test views where cameras were to be
            refined, whether or not that did good.

    Returns:
        The capture with refined cameras.
    """
    refined = trainer.cameras.refined(given)
    if trainer.cameras.wanted:
        scorer.see_by(refined, alignment_starts(given, refined))
    if trainer.cameras.active:
        job.announce(NoteEvent(write_cameras(job.run.path, given, refined, trainer.model)))
    return refined


def write_cameras(folder: Path, given: Dataset, refined: Dataset, model: Model) -> str:
    """Writes cameras.json.

    Args:
        folder: of the run.
        given: the capture in the frame that is trained in.
        refined: the same with refined cameras.
        model: the result, in that frame.

    Returns:
        A sentence about how far cameras moved.

    Raises:
        InputError: the file cannot be written.
    """
    points, frame = model.parameters()["vertices"].detach().reshape(-1, 3), given.normalization
    shifts = (refined.centers - given.centers).norm(dim=1)
    rows = {}
    for view in sorted([*given.train, *given.watched]):
        rows[given.names[view]] = RefinedCamera(
            _in_own_units(refined.viewmats[view], frame).tolist(),
            refined.Ks[view].tolist(),
            *given.images.sizes[view],
            training=view in given.train,
            turned_degrees=angle(given.viewmats[view], refined.viewmats[view]),
            shifted=float(shifts[view]) * frame.radius,
            shifted_of_distance=float(shifts[view]) / distance_shown(points, refined.cameras[view]),
        )
    write_refined_cameras(folder, rows)
    trained = [row for row in rows.values() if row.training]
    turn, shift = (
        float(torch.tensor([getattr(row, name) for row in trained]).median())
        for name in ("turned_degrees", "shifted_of_distance")
    )
    return (
        f"cameras: half of the photos were turned by {turn:.2g} degrees or more, and half shifted by {100 * shift:.2g} "
        "% of the distance or more; cameras.json has them"
    )


def angle(before: Float[Tensor, "4 4"], after: Float[Tensor, "4 4"]) -> float:
    """Degrees between the rotations of two poses, exact where they are small too."""
    chord = float((after[:3, :3] - before[:3, :3]).double().norm()) / 8**0.5
    return float(torch.rad2deg(2 * torch.asin(torch.tensor(min(1.0, chord), dtype=torch.float64))))


def _in_own_units(viewmat: Float[Tensor, "4 4"], frame: Normalization) -> Float[Tensor, "4 4"]:
    own = viewmat.clone()
    own[:3, 3] = frame.radius * viewmat[:3, 3] - viewmat[:3, :3] @ frame.center.double()
    return own
