"""What a model is measured on in the course of a run: some views at a small size, kept."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.data.loader import View, ViewLoader
from etsplat.model.model import Model
from etsplat.ops.photometric import photometric_loss
from etsplat.optim.exposure import Exposure
from etsplat.optim.objective import Drawing, Objective

_CORNERS = [[float(corner >> bit & 1) for bit in range(3)] for corner in range(8)]
"""Backgrounds in turn where a run has random ones, so that a picture cannot hide before all of them."""


@dataclass(frozen=True)
class Measured:
    """Means over some views.

    Attributes:
        loss: the photometric term.
        psnr: in dB; pixels that a mask leaves out count as right.
    """

    loss: float
    psnr: float


class Gauge:
    """Measures models on some views. Measuring changes nothing and draws no random number.

    Photos are halved until none has a longer side than asked for, whatever size a run trains on at the time. They are
    made when they are first needed, and kept.

    Attributes:
        views: how many they are.
    """

    def __init__(
        self,
        dataset: Dataset,
        views: Sequence[int],
        side: int,
        device: torch.device,
        background: Tensor | None = None,
        *,
        placed: Callable[[View], View] = lambda view: view,
    ) -> None:
        """Takes what to measure on.

        Args:
            dataset: whose views they are.
            views: their indices, at least one.
            side: of the largest picture, in pixels, at most.
            device: of the models.
            background: (1, 3) behind pictures and photos; None for the corners of the colour cube, in turn.
            placed: gives views the cameras that they are to be seen by.
        """
        self.views = len(views)
        self._dataset, self._indices, self._side, self._device = dataset, list(views), side, device
        colors = torch.tensor(_CORNERS) if background is None else background
        self._backgrounds, self._placed = colors.to(device), placed

    def placing(self, cameras: Mapping[int, Cameras]) -> "Gauge":
        """One of the same views from other cameras, by their indices."""
        other = copy(self)
        other._placed = lambda view: replace(view, camera=cameras[int(view.index)])
        return other

    @property
    def scenes(self) -> Iterator[tuple[View, Tensor]]:
        """Every view with its camera as given, and the (1, 3) colour behind it."""
        for number, view in enumerate(self._views):
            yield view, self._backgrounds[number % len(self._backgrounds)][None]

    @torch.no_grad()
    def measure(self, model: Model, objective: Objective, exposure: Exposure | None = None) -> Measured:
        """The photometric term of an objective, and the PSNR; means over the views.

        Args:
            model: as it is now.
            objective: of the run.
            exposure: of training photos, as which their pictures are exposed where it is learned; None for others.
        """
        term, losses, errors = objective.photometric, [], []
        for view, background in ((self._placed(view), background) for view, background in self.scenes):
            rendering = model.render(
                view.camera, backgrounds=background, outputs=("color", *term.outputs), depth_of=objective.depth_of
            )
            if exposure is not None and exposure.learned:
                rendering = exposure.applied(rendering, view, background)
            losses.append(term(Drawing(model, view.camera, view.photo, view.mask, background, rendering)))
            mask = None if view.mask is None else view.mask.float() / 255
            color = rendering.color.clamp(0.0, 1.0)
            errors.append(photometric_loss(color, view.photo, 0.0, mask, backgrounds=background, pixel="l2"))
        psnr = -10 * torch.stack(errors).double().log10()
        return Measured(float(torch.stack(losses).double().mean()), float(psnr.mean()))

    @cached_property
    def _views(self) -> list[View]:
        dataset = self._dataset
        while max(max(dataset.images.sizes[index]) for index in self._indices) > self._side:
            dataset = dataset.halved()
        loader = ViewLoader(dataset, self._device)
        loader.expect(self._indices)
        return [loader.view(index) for index in self._indices]
