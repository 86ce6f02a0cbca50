"""What a model is measured on in the course of a run: some views at a small size, kept."""

from collections.abc import Iterator, Sequence
from functools import cached_property

import torch
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.loader import View, ViewLoader
from etsplat.model.model import Model
from etsplat.optim.objective import Drawing, Objective

_CORNERS = [[float(corner >> bit & 1) for bit in range(3)] for corner in range(8)]
"""Backgrounds in turn where a run has random ones, so that a picture cannot hide before all of them."""


class Gauge:
    """Measures models on some views. Measuring changes nothing and draws no random number.

    Photos are halved until none has a longer side than asked for, whatever size a run trains on at the time. They are
    made when they are first needed, and kept.
    """

    def __init__(
        self,
        dataset: Dataset,
        views: Sequence[int],
        side: int,
        device: torch.device,
        background: Tensor | None = None,
    ) -> None:
        """Takes what to measure on.

        Args:
            dataset: whose views they are.
            views: their indices, at least one.
            side: of the largest picture, in pixels, at most.
            device: of the models.
            background: (1, 3) behind pictures and photos; None for the corners of the colour cube, in turn.
        """
        self._dataset, self._indices, self._side, self._device = dataset, list(views), side, device
        colors = torch.tensor(_CORNERS) if background is None else background
        self._backgrounds = colors.to(device)

    @torch.no_grad()
    def loss(self, model: Model, objective: Objective) -> float:
        """The photometric term of an objective, mean over the views."""
        values = [objective.photometric(drawing) for drawing in self._drawings(model, objective)]
        return float(torch.stack(values).double().mean())

    def _drawings(self, model: Model, objective: Objective) -> Iterator[Drawing]:
        for number, view in enumerate(self._views):
            background = self._backgrounds[number % len(self._backgrounds)][None]
            outputs, depth_of = objective.photometric.outputs, objective.depth_of
            rendering = model.render(view.camera, backgrounds=background, outputs=outputs, depth_of=depth_of)
            yield Drawing(model, view.camera, view.photo, view.mask, background, rendering)

    @cached_property
    def _views(self) -> list[View]:
        dataset = self._dataset
        while max(max(dataset.images.sizes[index]) for index in self._indices) > self._side:
            dataset = dataset.halved()
        loader = ViewLoader(dataset, self._device)
        loader.expect(self._indices)
        return [loader.view(index) for index in self._indices]
