"""Where a photo was taken from, by a model that is finished: its pose is fitted, the model stays.

Photos of a capture whose poses are poor cannot judge a model from where they were given: it is drawn a little beside
them however good it is. Each is moved first to where the model looks most like it.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.loader import View
from etsplat.model.model import Model
from etsplat.ops.adam import Adam
from etsplat.optim.camera_motion import moved, unit_motions
from etsplat.optim.objective import Drawing, Term
from etsplat.optim.schedules import exponential_decay

STEPS = 40
"""Of the search for a pose."""

RATE, FINAL = 0.004, 0.05
"""How far the picture moves in a step, in parts of its longer side, at first; and what is left of that at the end."""


def aligned_motion(
    model: Model, photometric: Term, view: View, background: Float[Tensor, "1 3"], steps: int = STEPS
) -> Float[Tensor, "6"]:
    """The motion of a view's camera (optim/camera_motion.py) after which a model looks most like its photo.

    Args:
        model: stays as it is.
        photometric: says how far a picture is from a photo.
        view: where the search begins.
        background: behind the picture and the photo.
        steps: of Adam; the best of what they see counts, the camera as given among it.

    Returns:
        (6,) on the device of the model.
    """
    vertices = model.parameters()["vertices"].detach().reshape(-1, 3)
    unit = unit_motions(vertices, view.camera).to(vertices)
    adam = Adam({"pose": torch.zeros(6, dtype=unit.dtype, device=unit.device, requires_grad=True)}, {"pose": RATE})
    pose = adam.parameters["pose"]
    best, least = torch.zeros_like(pose), math.inf
    for step in range(1, steps + 2):
        camera = moved(view.camera, unit @ pose)
        rendering = model.render(camera, backgrounds=background, outputs=photometric.outputs)
        loss = photometric(Drawing(model, camera, view.photo, view.mask, background, rendering))
        if (value := float(loss.detach())) < least:
            best, least = pose.detach().clone(), value
        (pose.grad,) = torch.autograd.grad(loss, [pose])
        adam.learning_rates["pose"] = RATE * exponential_decay(step, steps, FINAL)
        adam.step()
    return unit @ best


def aligned(model: Model, photometric: Term, view: View, background: Float[Tensor, "1 3"]) -> View:
    """A view from where a model looks most like its photo; see `aligned_motion`."""
    return replace(view, camera=moved(view.camera, aligned_motion(model, photometric, view, background)))
