"""Where each photo was taken from, corrected beside the model: a small motion of every camera, and lenses of photos.

Poses of structure from motion are off by a pixel, those of a phone by a degree. A motion (optim/camera_motion.py) of
each training photo is learned by steps of its own (optim/visit_steps.py) while the model takes shape. What moves all
cameras together is taken out after every step: the model stays where it is, and so does what the cameras of test photos
mean.

Photos that are kept aside have poses that are as wrong. They are aligned to the model (`optim/camera_alignment.py`),
which does not learn of them; whether refined poses stay, they decide (`optim/camera_trial.py`).
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.validation import check_choice, check_count
from etsplat.data.dataset import Dataset
from etsplat.data.loader import View
from etsplat.ops.adam import Adam
from etsplat.optim.camera_motion import common_motions, moved, unit_motions, zoomed
from etsplat.optim.schedules import NEVER, Scheduled, at, exponential_decay
from etsplat.optim.visit_steps import VisitSteps

Choice = Literal["off", "poses", "all"]

RATE, FINAL = 0.02, 0.02
"""How far the picture of a photo moves each time that it is seen, in parts of its longer side, at first, over the root
of how often each is seen while cameras move; and what is left of that at the end. Lenses, which every step shows, move
no faster than the root of the number of photos times that in an epoch."""

BEGIN, JUDGED, END = 0.05, 0.3, 0.9
"""When cameras begin to move, when it is judged whether that does good, and when they rest again; parts of a run."""

SEEN = 5
"""Not before every photo was seen so often with cameras that move is it judged."""


class CameraRefinement:
    """The motions of a run's cameras, with their optimizers. A trainer has one, or none.

    Attributes:
        begin: iteration after which cameras may move.
        judged: iteration after which photos that are kept aside judge it.
        end: the last iteration that moves cameras.
        active: whether refined cameras are in use.
        learned: "poses", (P, 6), of all training views and those kept aside, of which only the former move; and, if
            they are learned, "lenses", (C, 3), of photos that had the same intrinsics.

    Example:
        >>> cameras = etsplat.CameraRefinement.of("poses", iterations=3000, epoch=40)
        >>> 0 < cameras.begin < cameras.judged <= cameras.end <= 3000
        True
        >>> etsplat.CameraRefinement.of("off", iterations=3000, epoch=40).wanted
        False
    """

    learned: dict[str, Tensor]

    @staticmethod
    def of(choice: Choice, iterations: int, epoch: float) -> "CameraRefinement":
        """Of a run: nothing, poses, or lenses too.

        Args:
            choice: which of these.
            iterations: of the run.
            epoch: how many iterations show every photo once.

        Raises:
            ValueError: there is no such choice.
        """
        check_choice("choice", choice, get_args(Choice))
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

        Raises:
            ValueError: an iteration is none; `of` takes a choice by name.
        """
        for name, iteration in (("begin", begin), ("judged", judged), ("end", end)):
            check_count(name, iteration, least=0)
        self.begin, self.judged, self.end, self.active = begin, judged, end, False
        self._rate, self._lenses = rate, lenses

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
        self._slower = (batch / max(1, self._moving)) ** 0.5

    def activate(self, vertices: Float[Tensor, "V 3"]) -> None:
        """From now on cameras are refined, from where they were given.

        Args:
            vertices: of the model as it is now: they say how far away is what a camera shows.
        """
        self.active = True
        self._restart({name: torch.zeros_like(values) for name, values in self.learned.items()})
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
            numbers = self.learned["lenses"].index_select(0, lens)[0]
            camera = zoomed(camera, numbers if learning else numbers.detach())
        return replace(view, camera=camera)

    def unaligned(self, view: View) -> View:
        """A view where its camera was given, through its lens as that is known by now."""
        if not (self.active and self._lenses):
            return view
        lens = self._rows.index_select(0, view.index)[0, 1:]
        return replace(view, camera=zoomed(view.camera, self.learned["lenses"].detach()[lens][0]))

    @torch.no_grad()
    def align(self, motions: Mapping[int, Float[Tensor, "6"]]) -> None:
        """Puts cameras of photos that are kept aside where these motions lead, by the index of their view."""
        for view, motion in motions.items():
            row = int(self._rows[view, 0])
            self.poses[row] = torch.linalg.solve(self._units[row].double(), motion.double().to(self._units.device))

    def zero_grad(self) -> None:
        """Drops all gradients."""
        for values in self.learned.values():
            values.grad = None

    def step(self, iteration: int) -> None:
        """From the gradients; then what moves all cameras alike is taken out."""
        self._steps.step(at(self._rate, iteration))
        if self._adam is not None:
            self._adam.learning_rates["lenses"] = self._lens_rate(iteration)
            self._adam.step()
        self._fix_gauge(None)

    @property
    def row(self) -> int:
        """How many numbers a queued step needs."""
        return 3 if self._lenses else 1

    def queued_rates(self, iteration: int) -> list[float]:
        """What a queued step needs, `row` numbers; zeros where no camera moves. Counts the step."""
        if not self.moving(iteration):
            return [0.0] * self.row
        rates = [at(self._rate, iteration)]
        if self._adam is not None:
            self._adam.learning_rates["lenses"] = self._lens_rate(iteration)
            self._adam.step_count += 1
            rates += self._adam.rates(["lenses"])
        return rates

    def step_on_device(self, rates: Float[Tensor, " R"], halted: Tensor) -> None:
        """As `step`, from `queued_rates` in device memory; changes nothing where () `halted` is not 0."""
        self._steps.step(rates[0], halted)
        if self._adam is not None:
            self._adam.step_on_device(rates[1:], halted)
        self._fix_gauge(halted)

    @property
    def poses(self) -> Float[Tensor, "P 6"]:
        """What is learned of each camera's pose; as long as its picture moves, in parts of its longer side."""
        return self.learned["poses"]

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
                camera = zoomed(camera, self.learned["lenses"][lens].double().cpu())
            camera = moved(camera, motion)
            viewmats[view], Ks[view] = camera.viewmats[0], camera.Ks[0]
        return replace(dataset, viewmats=viewmats, Ks=Ks)

    def state(self) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint."""
        if not self.active:
            return {}
        state = {name: values.detach() for name, values in self.learned.items()}
        if self._adam is not None:
            moments = self._adam.first_moments, self._adam.second_moments
            state |= {"first.lenses": moments[0]["lenses"], "second.lenses": moments[1]["lenses"]}
            state["step_count"] = torch.tensor(self._adam.step_count)
        return {**state, **self._steps.state(), "units": self._exact_units}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        self.active = "poses" in state
        if not self.active:
            return
        self._use_units(state["units"].cpu())
        self._restart(state)
        self._steps.load_state(state)
        if self._adam is not None:
            first, second = (state[f"{kind}.lenses"].to(**self._place).clone() for kind in ("first", "second"))
            self._adam.replace("lenses", self.learned["lenses"], first, second)
            self._adam.step_count = int(state["step_count"])

    def _restart(self, values: Mapping[str, Tensor]) -> None:
        names = ("poses", "lenses") if self._lenses else ("poses",)
        self.learned = {name: values[name].detach().to(**self._place).clone().requires_grad_(True) for name in names}
        self._steps = VisitSteps(self.poses)
        self._adam = Adam({"lenses": self.learned["lenses"]}, {"lenses": 0.0}) if self._lenses else None

    def _use_units(self, units: Float[Tensor, "P 6 6"]) -> None:
        self._exact_units = units
        self._units = units.to(**self._place)
        trained = slice(0, self._moving)
        basis = common_motions(self._dataset.viewmats[self._views[trained]], units[trained])
        self._common = basis.to(**self._place)

    def _lens_rate(self, iteration: int) -> float:
        return at(self._rate, iteration) * self._slower

    @torch.no_grad()
    def _fix_gauge(self, halted: Tensor | None) -> None:
        values = self.poses[: self._moving]
        flat = values.view(-1)
        shared = self._common @ (self._common.T @ flat)
        flat.sub_(shared if halted is None else torch.where(halted == 0, shared, 0.0))


def _falling(iteration: int, first: float, begin: int, end: int) -> float:
    return first * exponential_decay(iteration - begin, end - begin, FINAL)
