"""How a model steps: draws some views, adds up their gradients and updates; on a device many steps together."""

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.rasterization import Rasterization
from etsplat.core.workers import workers
from etsplat.data.dataset import Dataset
from etsplat.data.loader import View, ViewLoader
from etsplat.engines.choice import engine_for
from etsplat.model.model import Model
from etsplat.ops.adam import Adam
from etsplat.ops.soup_colors import EndAtColors
from etsplat.optim.camera_refinement import CameraRefinement
from etsplat.optim.depth_trust import DepthTrust
from etsplat.optim.exposure import Exposure
from etsplat.optim.objective import Drawing, Objective
from etsplat.optim.schedules import NEVER, Schedule, at, begun_anew
from etsplat.optim.shared_steps import Apart, owners, shared_gradients
from etsplat.optim.step_queue import MAX_STEPS, QueuedStep, RowLayout, StepQueue
from etsplat.optim.strategies import Strategy
from etsplat.optim.view_sampler import ViewSampler

READ_AHEAD = 8
"""Views whose photos are decoded ahead of their turn, where they do not fit into memory."""


@dataclass(frozen=True)
class _Chosen:
    """A view of a step to come: its index, what is behind it, whether it is the first of an epoch."""

    view: int
    background: Float[Tensor, "1 3"]
    epoch_starts: bool


M = TypeVar("M", bound=Model)


class Stepper(Generic[M]):
    """Steps of a run, and all that is scheduled in it.

    A step draws some views, adds up the gradients of each in their order, and updates. On engine "cuda" what changes
    from step to step is a row of numbers, and many steps are queued together.

    Attributes:
        adam: the model's optimizer.
        sampler: the order of the views, and all else that is random.
        queue: of a model on an engine that queues steps; None elsewhere.
    """

    def __init__(
        self,
        model: M,
        dataset: Dataset,
        objective: Objective,
        strategy: Strategy,
        schedule: Schedule,
        exposure: Exposure,
        cameras: CameraRefinement,
        *,
        batch: int,
        background: Float[Tensor, "1 3"] | None,
        update: Callable[[Adam, Any], None] | None,
        generator: torch.Generator,
    ) -> None:
        """Arrives at the start of a run; arguments are those of `Trainer`."""
        self._model, self._strategy, self._exposure, self._cameras = model, strategy, exposure, cameras
        self._objective, self._dataset, self._batch = objective, dataset, batch
        self._schedule, appearance = schedule, model.appearance
        self._appearance = schedule.appearance or (lambda _: appearance)
        self._background, self._update = background, update
        self.sampler, self._trained = ViewSampler(dataset.train, generator), frozenset(dataset.train)
        parameters = model.parameters()
        _check_names(schedule, model)
        self._device = next(iter(parameters.values())).device
        self.adam = Adam(parameters, dict.fromkeys(parameters, 0.0))
        self.adam.learning_rates = self._rates(1)  # may ask for its decays
        self._halvings = -1
        self.arrive(0)
        self.queue: StepQueue | None = None
        self._phase: tuple[Any, ...] = ()
        self._seen: list[Rasterization] = []  # by the step that is being captured
        self._ended: EndAtColors | None = None  # where its gradients did, if before the coefficients
        queues = engine_for(next(iter(parameters.values()))).queues_steps
        if queues and update is None and not model.appearance.needs_host and workers().count == 1:
            self._row = RowLayout(
                places=2 * batch,
                backgrounds=3 * batch,
                epochs=batch,
                scale=1,
                appearance=len(model.appearance.numbers),
                values=len(schedule.values),
                rates=len(parameters) + 1,
                decays=len(parameters),
                exposure=2,
                cameras=cameras.row,
            )
            self.queue = StepQueue(self._queued_gradients, self._commit, self._row.width, self._device)

    def advance(self, first: int, last: int, stops: Sequence[int]) -> list[float]:
        """Makes the step `first`, and on a device as many behind it as go together.

        Args:
            first: iteration of the first step.
            last: of the last one, at most.
            stops: iterations behind which something else is due.

        Returns:
            The losses before the steps.
        """
        if self.queue is None:
            return [self._step(first)]
        phase = self._phase_at(first)
        if phase != self._phase:
            self._phase = phase
            self.arrive(first)
            self._calm(first)
            self.queue.restart()
        most = max(1, READ_AHEAD // self._batch) if self._loader.streamed else MAX_STEPS
        steps = range(first, min(last, first + most - 1, *stops) + 1)
        unchanged = takewhile(lambda i: self._phase_at(i) == phase, steps)
        losses = self.queue.run([self._queued_step(i) for i in unchanged])
        self.arrive(first + len(losses) - 1)
        return losses

    def restart(self) -> None:
        """To be called when tensors of the model were replaced."""
        if self.queue is not None:
            self.queue.restart()

    def arrive(self, iteration: int) -> None:
        """Lets all that is scheduled be as it is after an iteration."""
        self._model.appearance = self._appearance(iteration).whole
        if iteration:
            self._set(self._values(iteration))
        halvings = self._schedule.halvings(max(1, iteration))
        if halvings != self._halvings:
            dataset = self._dataset
            for _ in range(halvings):
                dataset = dataset.halved()
            self._halvings, self._loader = halvings, ViewLoader(dataset, self._device, self._batch)

    def look(self, iteration: int) -> tuple[Any, ...]:
        """How the model is drawn after an iteration, which photos it is fitted to, and where photos are seen from."""
        values = self._values(iteration) if iteration else {}
        halvings = self._schedule.halvings(max(1, iteration))
        return self._appearance(iteration).whole, halvings, values, self._cameras.stage(iteration)

    def alike_until(self, iteration: int) -> int:
        """The last iteration, from this one on, before steps are of another kind; NEVER if they stay as they are."""
        return min((first - 1 for first in self._schedule.calm_from.values() if first > iteration), default=NEVER)

    def measure_exposure(self) -> None:
        """Measures whether the photos that are fitted to were exposed unlike each other."""
        behind = torch.zeros(1, 3) if self._background is None else self._background
        views = self._loader.views(self._dataset.train, self._cameras.placed)
        self._exposure.measure(self._model, views, behind.to(self._device))
        if self._exposure.learned:
            self.restart()

    def measure_depths(self, trust: DepthTrust) -> None:
        """Compares depth maps with the model as it is now."""
        with_maps = (index for index in self._dataset.train if index in self._dataset.images.with_depth)
        trust.measure(self._model, (self._cameras.placed(self._loader.view(index)) for index in with_maps))
        self.restart()

    def _step(self, iteration: int) -> float:
        self.arrive(iteration)
        self._calm(iteration)
        self.adam.learning_rates = self._rates(iteration)
        chosen = self._choose(iteration)
        weights, scale = self._objective.weights(iteration), at(self._objective.scale, iteration)
        moving, decayed = self._cameras.moving(iteration), self._update is None

        def gradients(places: range) -> tuple[Tensor, list[Rasterization]]:
            some = (chosen[place] for place in places)
            views = ((self._loader.view(c.view), c.background.to(self._device)) for c in some)
            separate = apart is not None and apart.of_parameters is not None
            options = {"moving": moving, "first": places.start, "separate": separate, "decayed": decayed}
            return self._gradients(views, weights, scale, **options)

        group, apart = workers(), None
        if group.count > 1 and self._model.COLORED is not None:
            separable = self._objective.separable(weights)
            alone = partial(self._of_parameters, weights, scale, decayed=decayed)
            apart = Apart(self._model.COLORED, alone if separable else None)
        indices, optimizers = [c.view for c in chosen], [self.adam, self._exposure.adam]
        self._model.appearance = self._appearance(iteration)
        loss, seen = shared_gradients(group, indices, gradients, optimizers, self._strategy.outputs, apart)
        self._model.appearance = self._model.appearance.whole
        if self._update is None:
            self.adam.step(self._objective.decays(self._model, weights, scale))
        else:
            self._update(self.adam, self._model)
        if self._exposure.learned:
            self._exposure.step(iteration)
        if moving:
            self._cameras.step(iteration)
        for each, rendering in zip(chosen, seen, strict=True):
            self._strategy.observe(rendering, epoch_starts=each.epoch_starts)
        return float(loss)

    def _queued_step(self, iteration: int) -> QueuedStep:
        chosen = self._choose(iteration)
        found = [self._loader.kind_and_place(each.view, number) for number, each in enumerate(chosen)]
        uploads = [self._loader.upload(each.view, number) for number, each in enumerate(chosen)]
        self.adam.learning_rates = self._rates(iteration)
        self.adam.step_count += 1
        weights, scale = self._objective.weights(iteration), at(self._objective.scale, iteration)
        decays = self._objective.decays(self._model, weights, scale)
        row = self._row.pack(
            places=[number for _, place in found for number in place],
            backgrounds=torch.cat([c.background for c in chosen]).flatten().tolist(),
            epochs=[c.epoch_starts for c in chosen],
            scale=[scale],
            appearance=self._appearance(iteration).numbers,
            values=list(self._values(iteration).values()),
            rates=self.adam.rates(list(self.adam.parameters)),
            decays=[decays.get(name, 0.0) for name in self.adam.parameters],
            exposure=self._exposure.queued_rates(iteration),
            cameras=self._cameras.queued_rates(iteration),
        )

        def prepare() -> None:
            for upload in uploads:
                upload()

        return QueuedStep(row, tuple(kind for kind, _ in found), prepare)

    def _queued_gradients(self, row: Tensor, kinds: Hashable) -> Tensor:
        assert isinstance(kinds, tuple)
        fields = self._row.unpack(row)
        _, structure, weights, _, moving = self._phase
        self._model.appearance = structure.on_device(fields["appearance"])
        self._set(dict(zip(self._schedule.values, fields["values"].unbind(), strict=True)))
        places, backgrounds = fields["places"].split(2), fields["backgrounds"].split(3)
        views = (
            (self._loader.look_up(kind, place), background[None])
            for kind, place, background in zip(kinds, places, backgrounds, strict=True)
        )
        with self._ending() as self._ended:
            loss, self._seen = self._gradients(views, weights, fields["scale"][0], moving=moving, decayed=True)
        return loss

    def _ending(self) -> AbstractContextManager[EndAtColors | None]:
        """Adam carries gradients on from colours, where they are those of one view."""
        names = self._model.COLORED
        if names is None or self._batch > 1:
            return nullcontext()
        return EndAtColors(*(self.adam.parameters[name] for name in names))

    def _commit(self, row: Tensor, halted: Tensor) -> None:
        fields = self._row.unpack(row)
        self.adam.step_on_device(fields["rates"], halted, fields["decays"], self._ended)
        if self._exposure.learned:
            self._exposure.step_on_device(fields["exposure"], halted)
        if self._phase[-1]:
            self._cameras.step_on_device(fields["cameras"], halted)
        for rendering, epoch_starts in zip(self._seen, fields["epochs"].split(1), strict=True):
            self._strategy.observe_on_device(rendering, epoch_starts, halted)
        self._seen, self._ended = [], None

    def _gradients(
        self,
        views: Iterable[tuple[View, Tensor]],
        weights: Sequence[float],
        scale: float | Tensor,
        *,
        moving: bool,
        first: int = 0,
        separate: bool = False,
        decayed: bool = False,
    ) -> tuple[Tensor, list[Rasterization]]:
        """Those of the objective, one view after the other, from place `first` on; its value, and what was seen.

        Where `separate`, terms that depend on the parameters alone have their gradients in `_of_parameters`; where
        `decayed`, Adam adds those of sums of squares.
        """
        outputs = (*self._objective.outputs(weights), *self._strategy.outputs)
        losses, seen, exposure = [], [], self._exposure
        for number, (view, background) in enumerate(views, start=first + 1):
            view = self._cameras.placed(view, learning=moving)
            rendering = self._model.render(
                view.camera, backgrounds=background, outputs=outputs, depth_of=self._objective.depth_of
            )
            shot = exposure.applied(rendering, view, background) if exposure.learned else rendering
            drawing = Drawing(
                self._model, view.camera, view.photo, view.mask, background, shot, index=view.index, depth=view.depth
            )
            whole = number == self._batch
            loss = self._objective(
                drawing, weights, scale, views=self._batch, whole=whole, apart=separate, decayed=decayed
            )
            if exposure.learned:
                loss = loss + exposure.penalty(view) / self._batch
            if not losses:
                self.adam.zero_grad()
                exposure.adam.zero_grad()
                self._cameras.zero_grad()
            loss.backward()
            self._complete_gradients()
            losses.append(loss.detach())
            seen.append(rendering)
        return sum(losses[1:], start=losses[0]), seen

    def _complete_gradients(self) -> None:
        """Of what rests, and pictures do not depend on, as opaque ones do not on opacities, they are 0."""
        for name, parameter in self.adam.parameters.items():
            if parameter.grad is None and self.adam.learning_rates[name] == 0.0:
                parameter.grad = torch.zeros_like(parameter)

    def _of_parameters(self, weights: Sequence[float], scale: float, *, decayed: bool) -> None:
        value = self._objective.of_parameters(self._model, weights, scale, decayed=decayed)
        if value is not None:
            value.backward()

    def _choose(self, iteration: int) -> list[_Chosen]:
        """Views and backgrounds of the next step; photos that come after them are decoded ahead."""
        if (shown := self._schedule.views) is not None:
            some = list(shown(iteration))
            if not some or not set(some) <= self._trained:
                raise ValueError(f"schedule: its views of iteration {iteration} are no training views of the dataset")
            self.sampler.show(some, anew=iteration > 1 and list(shown(iteration - 1)) != some)
        views, firsts = [], []
        for _ in range(self._batch):
            views.append(self.sampler.next_view())
            firsts.append(self.sampler.epoch_starts)
        self._loader.expect(self._own([*views, *self.sampler.upcoming(READ_AHEAD)]))
        backgrounds = [self.sampler.background() if self._background is None else self._background for _ in views]
        return [_Chosen(*each) for each in zip(views, backgrounds, firsts, strict=True)]

    def _own(self, views: list[int]) -> list[int]:
        """Those of the views to come that this worker is going to draw."""
        group, size = workers(), self._batch
        steps = [views[start : start + size] for start in range(0, len(views), size)]
        whose = [owner for step in steps for owner in owners(step, group.count)]
        return [view for view, owner in zip(views, whose, strict=True) if owner == group.rank]

    def _calm(self, iteration: int) -> None:
        """To be called before a step."""
        starts = self._schedule.calm_from
        self.adam.calmed = frozenset(name for name, first in starts.items() if iteration >= first)
        for name, first in starts.items():
            if iteration == first:
                self.adam.forget(name)

    def _phase_at(self, iteration: int) -> tuple[Any, ...]:
        """What changes seldom: how often photos are halved, how the model is drawn, weights, whether cameras move."""
        look, moving = self._appearance(iteration).structure, self._cameras.moving(iteration)
        calmed = tuple(iteration >= first for first in self._schedule.calm_from.values())
        return self._schedule.halvings(iteration), look, self._objective.weights(iteration), calmed, moving

    def _rates(self, iteration: int) -> dict[str, float]:
        """Times the square root of the batch: by that the gradients of so many views have less noise."""
        longer = math.sqrt(self._batch)
        rates = {name: longer * at(self._schedule.rates[name], iteration) for name in self._model.parameters()}
        for name, first in self._schedule.calm_from.items():
            if iteration >= first:
                rates[name] *= begun_anew(iteration, first, self.adam.betas)
        return rates

    def _values(self, iteration: int) -> dict[str, float]:
        return {name: at(value, iteration) for name, value in self._schedule.values.items()}

    @torch.no_grad()
    def _set(self, values: dict[str, float] | dict[str, Tensor]) -> None:
        for name, value in values.items():
            self._model.parameters()[name].fill_(value)


def _check_names(schedule: Schedule, model: Model) -> None:
    """Raises ValueError where a schedule names what such models never have, or has no rate for what this one has."""
    parameters = list(model.parameters())
    named = {"rates": schedule.rates, "values": schedule.values, "calm_from": schedule.calm_from}
    for what, given in named.items():
        if unknown := sorted(set(given) - {*model.RATES, *parameters}):
            raise ValueError(f"schedule.{what} names {', '.join(unknown)}; the model has {', '.join(parameters)}")
    if missing := [name for name in parameters if name not in schedule.rates]:
        raise ValueError(f"schedule.rates has none for {', '.join(missing)}: add model.rates, or 0 for what stays")
