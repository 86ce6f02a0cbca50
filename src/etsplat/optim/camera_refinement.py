"""Where each photo was taken from, corrected beside the model: a small motion of every camera, and lenses of photos.

Poses of structure from motion are off by a pixel, those of a phone by a degree. A motion (optim/camera_motion.py) of
each training photo is learned by an Adam of its own while the model takes shape. What moves all cameras together is
taken out after every step: the model stays where it is, and so does what the cameras of test photos mean.

Photos that are kept aside have poses that are as wrong. They are aligned to the model (`optim/camera_alignment.py`),
which does not learn of them; whether refined poses stay, they decide (`optim/camera_trial.py`).
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.data.loader import View
from etsplat.ops.adam import Adam
from etsplat.optim.camera_motion import common_motions, moved, unit_motions, zoomed
from etsplat.optim.schedules import NEVER, Scheduled, at, exponential_decay

Choice = Literal["off", "poses", "all"]

RATE, FINAL = 0.02, 0.02
"""How far the picture of a photo moves each time that it is seen, in parts of its longer side, at first, over the root
of how often each is seen while cameras move; and what is left of that at the end. Lenses, which every step shows, move
no faster than the root of the number of photos times that in an epoch."""

BEGIN, JUDGED, END = 0.1, 0.3, 0.7
"""When cameras begin to move, when it is judged whether that does good, and when they rest again; parts of a run."""

SEEN = 5
"""Not before every photo was seen so often with cameras that move is it judged."""


class CameraRefinement:
    """The motions of a run's cameras, with their optimizer. A trainer has one, or none.

    Attributes:
        begin: iteration after which cameras may move.
        judged: iteration after which photos that are kept aside judge it.
        end: the last iteration that moves cameras.
        active: whether refined cameras are in use.
        adam: the optimizer of "poses", (P, 6), of all training views and those kept aside, of which only the former
            move; and, if they are learned, of "lenses", (C, 3), of photos that had the same intrinsics.

    Example:
        >>> cameras = etsplat.CameraRefinement.of("poses", iterations=3000, epoch=40)
        >>> 0 < cameras.begin < cameras.judged <= cameras.end <= 3000
        True
        >>> etsplat.CameraRefinement.of("off", iterations=3000, epoch=40).wanted
        False
    """

    adam: Adam

    @staticmethod
    def of(choice: Choice, iterations: int, epoch: float) -> "CameraRefinement":
        """Of a run: nothing, poses, or lenses too.

        Args:
            choice: which of these.
            iterations: of the run.
            epoch: how many iterations show every photo once.
        """
        if choice == "off":
            return CameraRefinement()
        begin, judged, end = (max(1, round(part * iterations)) for part in (BEGIN, JUDGED, END))
        end = max(begin + 1, end)
        judged = min(end, max(begin + 1, judged, begin + round(SEEN * epoch)))
        first = RATE / max(1.0, (end - begin) / epoch) ** 0.5
        rate = partial(_falling, first=first, begin=begin, end=end)
        return CameraRefinement(begin, judged, end, rate=rate, lenses=choice == "all")

    def __init__(
        self,
        begin: int = NEVER,
        judged: int = NEVER,
        end: int = NEVER,
        *,
        rate: Scheduled = RATE,
        lenses: bool = False,
    ) -> None:
        """Takes when and how fast cameras move.

        Args:
            begin: see the attributes; `NEVER` for cameras that are taken as they are.
            judged: likewise, after `begin`.
            end: likewise.
            rate: parts of the picture's longer side, each time that a photo is seen.
            lenses: whether focal lengths and principal points are learned too.
        """
        self.begin, self.judged, self.end, self.active = begin, judged, end, False
        self._rate, self._lenses = rate, lenses
        self._names = ("poses", "lenses") if lenses else ("poses",)

    @property
    def wanted(self) -> bool:
        """Whether the run may move cameras at all."""
        return self.begin < NEVER

    def start(self, dataset: Dataset, batch: int, like: Tensor) -> None:
        """All cameras are as given.

        Args:
            dataset: whose training views move.
            batch: views of a step.
            like: a tensor of the model, for device and precision.
        """
        self._dataset, self._views = dataset, [*dataset.train, *dataset.watched]
        self._moving = len(dataset.train)
        self._place = {"dtype": like.dtype, "device": like.device}
        lenses = [(*dataset.images.sizes[view], *dataset.Ks[view].flatten().tolist()) for view in self._views]
        kinds = {lens: number for number, lens in enumerate(dict.fromkeys(lenses))}
        rows = torch.zeros((max(self._views, default=0) + 1, 2), dtype=torch.int64)
        rows[torch.tensor(self._views, dtype=torch.int64), 0] = torch.arange(len(self._views))
        rows[torch.tensor(self._views, dtype=torch.int64), 1] = torch.tensor(
            [kinds[lens] for lens in lenses], dtype=torch.int64
        )
        self._rows = rows.to(like.device)
        self._restart({"poses": torch.zeros(len(self._views), 6), "lenses": torch.zeros(len(kinds), 3)})
        self._use_units(torch.eye(6, dtype=torch.float64).expand(len(self._views), 6, 6))
        # Adam divides by the root of a mean over all steps, of which those with other photos count as zero.
        self._visits = (batch / max(1, self._moving)) ** 0.5

    def activate(self, vertices: Float[Tensor, "V 3"]) -> None:
        """From now on cameras are refined, from where they were given.

        Args:
            vertices: of the model as it is now: they say how far away is what a camera shows.
        """
        self.active = True
        self._restart({name: torch.zeros_like(values) for name, values in self.adam.parameters.items()})
        cameras = self._dataset.cameras
        self._use_units(torch.stack([unit_motions(vertices, cameras[view]) for view in self._views]))

    def moving(self, iteration: int) -> bool:
        """Whether the step of an iteration moves cameras."""
        return self.active and iteration <= self.end

    def stage(self, iteration: int) -> tuple[bool, ...]:
        """Which alignment of the photos that are kept aside is in use after an iteration: scores compare within one."""
        return (iteration >= self.judged, iteration >= self.end) if self.active else ()

    def placed(self, view: View, *, learning: bool = False) -> View:
        """A view as its refined camera saw it; as it is where none is in use.

        Args:
            view: of the data set.
            learning: whether gradients reach what is learned.
        """
        if not self.active:
            return view
        pose, lens = self._rows.index_select(0, view.index)[0].split(1)
        motion = self._units.index_select(0, pose)[0] @ self.poses.index_select(0, pose)[0]
        camera = moved(view.camera, motion if learning else motion.detach())
        if self._lenses:
            numbers = self.adam.parameters["lenses"].index_select(0, lens)[0]
            camera = zoomed(camera, numbers if learning else numbers.detach())
        return replace(view, camera=camera)

    def unaligned(self, view: View) -> View:
        """A view where its camera was given, through its lens as that is known by now."""
        if not (self.active and self._lenses):
            return view
        lens = self._rows.index_select(0, view.index)[0, 1:]
        return replace(view, camera=zoomed(view.camera, self.adam.parameters["lenses"].detach()[lens][0]))

    @torch.no_grad()
    def align(self, motions: Mapping[int, Float[Tensor, "6"]]) -> None:
        """Puts cameras of photos that are kept aside where these motions lead, by the index of their view."""
        for view, motion in motions.items():
            row = int(self._rows[view, 0])
            self.poses[row] = torch.linalg.solve(self._units[row].double(), motion.double().to(self._units.device))

    def step(self, iteration: int) -> None:
        """Adam's, from the gradients; then what moves all cameras alike is taken out."""
        self._set_rates(iteration)
        self.adam.step()
        self._fix_gauge(None)

    @property
    def row(self) -> int:
        """How many numbers a queued step needs."""
        return len(self._names) + 1

    def queued_rates(self, iteration: int) -> list[float]:
        """What a queued step needs, `row` numbers; zeros where no camera moves. Counts the step."""
        if not self.moving(iteration):
            return [0.0] * self.row
        self._set_rates(iteration)
        self.adam.step_count += 1
        return self.adam.rates(self._names)

    def step_on_device(self, rates: Float[Tensor, " R"], halted: Tensor) -> None:
        """As `step`, from `queued_rates` in device memory; changes nothing where () `halted` is not 0."""
        self.adam.step_on_device(rates, halted)
        self._fix_gauge(halted)

    @property
    def poses(self) -> Float[Tensor, "P 6"]:
        """What is learned of each camera's pose; as long as its picture moves, in parts of its longer side."""
        return self.adam.parameters["poses"]

    @torch.no_grad()
    def refined(self, dataset: Dataset) -> Dataset:
        """The data set of the run with refined cameras, in double precision; as it is where none are in use."""
        if not self.active:
            return dataset
        viewmats, Ks = dataset.viewmats.clone(), dataset.Ks.clone()
        for view in self._views:
            pose, lens = self._rows[view].tolist()
            motion = (self._units[pose].double() @ self.poses[pose].double()).cpu()
            camera = Cameras(viewmats[view][None], Ks[view][None], *dataset.images.sizes[view])
            if self._lenses:
                camera = zoomed(camera, self.adam.parameters["lenses"][lens].double().cpu())
            camera = moved(camera, motion)
            viewmats[view], Ks[view] = camera.viewmats[0], camera.Ks[0]
        return replace(dataset, viewmats=viewmats, Ks=Ks)

    def state(self) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint."""
        if not self.active:
            return {}
        moments = {
            f"{kind}.{name}": tensor
            for kind, tensors in (("first", self.adam.first_moments), ("second", self.adam.second_moments))
            for name, tensor in tensors.items()
        }
        learned = {name: parameter.detach() for name, parameter in self.adam.parameters.items()}
        count = torch.tensor(self.adam.step_count)
        return {**learned, **moments, "units": self._exact_units, "step_count": count}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        self.active = "poses" in state
        if not self.active:
            return
        self._use_units(state["units"].cpu())
        self._restart(state)
        for name, parameter in self.adam.parameters.items():
            first, second = (state[f"{kind}.{name}"].to(**self._place).clone() for kind in ("first", "second"))
            self.adam.replace(name, parameter, first, second)
        self.adam.step_count = int(state["step_count"])

    def _restart(self, values: Mapping[str, Tensor]) -> None:
        learned = {name: values[name].detach().to(**self._place).clone().requires_grad_(True) for name in self._names}
        self.adam = Adam(learned, dict.fromkeys(learned, 0.0))

    def _use_units(self, units: Float[Tensor, "P 6 6"]) -> None:
        self._exact_units = units
        self._units = units.to(**self._place)
        trained = slice(0, self._moving)
        basis = common_motions(self._dataset.viewmats[self._views[trained]], units[trained])
        self._common = basis.to(**self._place)

    def _set_rates(self, iteration: int) -> None:
        rate = at(self._rate, iteration)
        self.adam.learning_rates = dict.fromkeys(self._names, rate * self._visits)

    @torch.no_grad()
    def _fix_gauge(self, halted: Tensor | None) -> None:
        values = self.poses[: self._moving]
        flat = values.view(-1)
        shared = self._common @ (self._common.T @ flat)
        flat.sub_(shared if halted is None else torch.where(halted == 0, shared, 0.0))


def _falling(iteration: int, first: float, begin: int, end: int) -> float:
    return first * exponential_decay(iteration - begin, end - begin, FINAL)
