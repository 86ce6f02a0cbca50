"""The problem that the loop drives in novel-view synthesis: a soup, its optimizer, and the photos it is fitted to."""

from collections.abc import Callable, Hashable
from dataclasses import replace
from itertools import takewhile

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.rasterization import TriangleStatistics
from etsplat.core.validation import first_not_finite
from etsplat.data.dataset import Dataset
from etsplat.data.loader import View, ViewLoader
from etsplat.engines.choice import engine_for
from etsplat.model.soup_rendering import SoupAppearance, render_soup
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.adam import Adam
from etsplat.optim.densification import PruneRules, SoupStatistics, dead_triangles, densify_plan, grown_count
from etsplat.optim.edit import RowPlan, apply_rows
from etsplat.optim.loop import DivergedError, Progress
from etsplat.optim.soup_objective import SoupWeights, soup_objective
from etsplat.optim.step_queue import MAX_STEPS, QueuedStep, StepQueue
from etsplat.optim.view_sampler import ViewSampler
from etsplat.tasks.running import progress_tensor, read_progress
from etsplat.tasks.soup_schedule import SoupSchedule
from etsplat.tasks.train_config import TrainConfig

READ_AHEAD = 8
"""Views whose photos are decoded ahead of their turn, where the capture does not fit into memory."""

Evaluate = Callable[[TriangleSoup, SoupAppearance], dict[str, float]]


class SoupFitting:
    """One run's state, and what changes it: steps, densification and pruning. Implements `tasks.running.Resumable`.

    Attributes:
        soup: the soup as it is now.
        adam: its optimizer.
        statistics: what densification and pruning know of each triangle.
    """

    def __init__(
        self,
        soup: TriangleSoup,
        capture: Dataset,
        config: TrainConfig,
        generator: torch.Generator,
        evaluate: Evaluate,
        *,
        squared: bool = False,
    ) -> None:
        """Starts a run.

        Args:
            soup: the start; changed in place.
            capture: what it is fitted to (the views in `capture.train`).
            config: settings.
            generator: of every random choice from here on.
            evaluate: cheap metrics of a soup.
            squared: the pixel loss is L2.
        """
        self.soup = soup
        self._device = soup.vertices.device
        self.statistics = SoupStatistics.zeros(len(soup), self._device)
        self._capture = capture
        self._config = config
        self._schedule = SoupSchedule(config, squared)
        self._evaluate = evaluate
        self._sampler = ViewSampler(capture.train, generator)
        self._iteration = 0
        self._surroundings = Surroundings.of(capture).to(self._device) if config.sky == "sphere" else None
        self.adam = Adam(soup.parameters(), self._schedule.rates(1))
        self._queue: StepQueue | None = None
        self._phase: tuple[SoupAppearance, SoupWeights] | None = None
        self._drawn: TriangleStatistics | None = None  # by the step that is being captured
        self._views = ViewLoader(capture, self._device)
        if engine_for(soup.vertices).queues_steps:
            columns = 8 + len(self.adam.parameters) + 1
            self._queue = StepQueue(self._queued_gradients, self._commit, columns, self._device)

    @property
    def count(self) -> int:
        """Number of triangles."""
        return len(self.soup)

    @property
    def appearance(self) -> SoupAppearance:
        """How the soup is drawn at this iteration."""
        return self._schedule.appearance(self._iteration)

    def describe(self) -> dict[str, float]:
        """For the log: number of triangles, and deciles of softness and opacity as they are drawn."""
        appearance = self.appearance
        values = {"sigma": appearance.sigma(self.soup), "opacity": appearance.opacities(self.soup)}
        state: dict[str, float] = {"triangles": self.count}
        for name, tensor in values.items():
            ordered = tensor.detach().sort().values
            for suffix, fraction in (("_10", 0.1), ("", 0.5), ("_90", 0.9)):
                state[name + suffix] = float(ordered[int(fraction * (len(ordered) - 1))])
        return state

    def advance(self, first: int, last: int) -> list[float]:
        """Steps with one view each; on a device many together. Returns the losses before them."""
        if self._queue is None:
            return [self._step(first)]
        phase = self._schedule.phase(first)
        if phase != self._phase:
            self._phase = phase
            self._queue.restart()
        most = READ_AHEAD if self._views.streamed else MAX_STEPS
        steps = range(first, min(last, first + most - 1, self._schedule.next_edit(first)) + 1)
        unchanged = takewhile(lambda i: self._schedule.phase(i) == phase, steps)
        losses = self._queue.run([self._queued_step(i) for i in unchanged])
        self._iteration = first + len(losses) - 1
        return losses

    def _step(self, iteration: int) -> float:
        self._iteration = iteration
        view = self._sampler.next_view()
        self._views.expect([view, *self._sampler.upcoming(READ_AHEAD)])
        appearance, weights = self._schedule.appearance(iteration), self._schedule.weights(iteration)
        background = self._background().to(self._device)
        loss, drawn = self._gradients(self._views.view(view), background, appearance, weights)
        self.adam.learning_rates = self._schedule.rates(iteration)
        self.adam.step()
        self.statistics.update(drawn, len(self._capture.train), epoch_starts=self._sampler.epoch_starts)
        return float(loss)

    def _queued_step(self, iteration: int) -> QueuedStep:
        """A row: camera and place, background, opacity floor, sigma ceiling, whether an epoch starts, Adam's rates."""
        view = self._sampler.next_view()
        self._views.expect([view, *self._sampler.upcoming(READ_AHEAD)])
        kind, place = self._views.kind_and_place(view)
        appearance = self._schedule.appearance(iteration)
        limits = appearance.opacity_floor, appearance.sigma_ceiling
        self.adam.learning_rates = self._schedule.rates(iteration)
        self.adam.step_count += 1
        rates = self.adam.rates(list(self.adam.parameters))
        scheduled = *limits, float(self._sampler.epoch_starts), *rates
        row = [*place, *self._background()[0].tolist(), *scheduled]
        return QueuedStep(row, kind, self._views.upload(view))

    def _queued_gradients(self, row: Tensor, kind: Hashable) -> Tensor:
        assert self._phase is not None
        view = self._views.look_up(kind, row[:2])
        loss, self._drawn = self._gradients(view, row[2:5][None], *self._phase, limits=row[5:7])
        return loss

    def _commit(self, row: Tensor, halted: Tensor) -> None:
        assert self._drawn is not None
        self.adam.step_on_device(row[8:], halted)
        self.statistics.update_on_device(self._drawn, len(self._capture.train), row[7:8], halted)
        self._drawn = None

    def _gradients(
        self,
        view: View,
        background: Float[Tensor, "1 3"],
        appearance: SoupAppearance,
        weights: SoupWeights,
        limits: Float[Tensor, "2"] | None = None,
    ) -> tuple[Tensor, TriangleStatistics]:
        """Those of the objective, whose value is returned with what was seen of each triangle."""
        soup = self.soup
        rendering = render_soup(
            soup,
            view.camera,
            appearance,
            limits=limits,
            backgrounds=background,
            median_depth=weights.normal > 0,
            depth="centroid" if weights.normal > 0 or weights.distortion > 0 else None,
            normals=weights.normal > 0,
            distortion=weights.distortion > 0,
            statistics=True,
        )
        counts = None if view.mask is None else view.mask.float() / 255
        opacities = soup.opacities
        if self._surroundings is not None:  # where no view looks, nothing would hold against the pull to transparency
            opacities = torch.where(self._surroundings.outermost(soup.vertices), 0.0, opacities)
        loss = soup_objective(rendering, view.photo, counts, background, soup.vertices, opacities, view.camera, weights)
        self.adam.zero_grad()
        loss.backward()
        assert rendering.statistics is not None
        return loss.detach(), rendering.statistics

    def refine(self, iteration: int) -> int:
        """Densifies or prunes if it is time to; returns by how many triangles the soup grew."""
        config, before = self._config, self.count
        every = config.at(config.densification.every)
        if iteration % every or iteration <= config.at(config.densification.begin) or iteration == config.iterations:
            return 0
        if iteration < config.at(config.densification.end):
            self.densify(iteration)
        else:
            self.prune(iteration)
        return self.count - before

    def densify(self, iteration: int) -> None:
        """Removes dead triangles and lets others multiply, whatever the schedule says."""
        self._edit(self._densification(iteration, self._dead(iteration)))

    def prune(self, iteration: int) -> None:
        """Removes dead triangles, whatever the schedule says."""
        self._edit(RowPlan.keeping(~self._dead(iteration)))

    def evaluate(self) -> dict[str, float]:
        """Cheap metrics of the present state."""
        return self._evaluate(self.soup, self.appearance)

    def first_not_finite(self) -> str | None:
        """The name of a parameter that holds NaN or infinity, or None."""
        return first_not_finite(self.soup.parameters())

    def finished(self) -> tuple[TriangleSoup, SoupAppearance]:
        """The soup with all that was squeezed written into its parameters, detached, and how it is drawn."""
        appearance = self.appearance
        parameters = {name: parameter.detach() for name, parameter in self.soup.parameters().items()}
        if appearance.opacity_floor > 0:
            parameters["opacity_logits"] = torch.logit(appearance.opacities(self.soup).detach().double()).float()
        if appearance.sigma_ceiling < float("inf"):
            highest = torch.tensor(appearance.sigma_ceiling - 0.01).log()
            parameters["sigma_raw"] = parameters["sigma_raw"].clamp_max(float(highest))
        plain = replace(appearance, opacity_floor=0.0, sigma_ceiling=float("inf"))
        return TriangleSoup(**parameters), plain

    def state(self, progress: Progress) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint."""
        state = {}
        for name, parameter in self.soup.parameters().items():
            state[f"soup.{name}"] = parameter.detach()
            state[f"adam.first.{name}"] = self.adam.first_moments[name]
            state[f"adam.second.{name}"] = self.adam.second_moments[name]
        state["adam.step_count"] = torch.tensor(self.adam.step_count)
        state |= {f"statistics.{name}": tensor for name, tensor in self.statistics.tensors().items()}
        state |= {f"sampler.{name}": tensor for name, tensor in self._sampler.state().items()}
        state["progress"] = progress_tensor(progress)
        return state

    def load_state(self, state: dict[str, Tensor], iteration: int) -> Progress:
        """Continues where `state` was taken; returns where that was."""
        for name in TriangleSoup.PARAMETERS:
            saved = (state[f"{kind}.{name}"].to(self._device) for kind in ("soup", "adam.first", "adam.second"))
            parameter, *moments = saved
            setattr(self.soup, name, parameter.requires_grad_(True))
            self.adam.replace(name, parameter, *moments)
        self.adam.step_count = int(state["adam.step_count"])
        names = self.statistics.tensors()
        self.statistics = SoupStatistics(**{name: state[f"statistics.{name}"].to(self._device) for name in names})
        self._sampler.load_state({name: state[f"sampler.{name}"] for name in self._sampler.state()})
        self._iteration = iteration
        if self._queue is not None:
            self._queue.restart()
        return read_progress(state["progress"], iteration)

    def _background(self) -> Float[Tensor, "1 3"]:
        if self._config.background == "random":
            return self._sampler.background()
        return torch.full((1, 3), 1.0 if self._config.background == "white" else 0.0)

    def _dead(self, iteration: int) -> Tensor:
        config = self._config
        first = iteration <= config.at(config.densification.begin) + config.at(config.densification.every)
        densifying = iteration < config.at(config.densification.end)
        limit = config.pruning.screen_size if densifying and not first else None
        rules = PruneRules(
            opacity=config.pruning.opacity,
            importance=self._schedule.least_importance,
            views=0 if first else min(config.pruning.views, len(self._capture.train)),
            screen_size=float("inf") if limit is None else limit,
        )
        with torch.no_grad():
            dead = dead_triangles(
                self.appearance.opacities(self.soup), self.statistics, rules, len(self._capture.train)
            )
        if self._surroundings is not None:
            dead &= ~(self._surroundings.outermost(self.soup.vertices) & (self.statistics.screen_size == 0))
        if bool(dead.all()):
            raise DivergedError(
                f"no triangle is left at iteration {iteration}; lower loss.lambda_opacity or pruning.importance"
            )
        return dead

    def _densification(self, iteration: int, dead: Tensor) -> RowPlan:
        config, soup = self._config, self.soup
        even = iteration // config.at(config.densification.every) % 2 == 0
        by = {"opacity": True, "sharpness": False, "alternate": even}[config.densification.sample_by]
        count = self.count if self._schedule.replaces_dead else self.count - int(dead.sum())
        return densify_plan(
            soup.vertices.detach(),
            soup.opacity_logits.detach(),
            soup.sigma.detach(),
            self.statistics.screen_size,
            dead,
            target=grown_count(count, config.densification.growth, config.max_triangles),
            by="opacity" if by else "sharpness",
            split_size=config.densification.split_size,
            noise=config.densification.clone_noise,
            generator=self._sampler.generator,
        )

    def _edit(self, plan: RowPlan) -> None:
        parameters, statistics = apply_rows(plan, self.adam, self.statistics.tensors())
        for name, parameter in parameters.items():
            setattr(self.soup, name, parameter)
        self.statistics = SoupStatistics(**statistics)
        self.statistics.restart(self.statistics.judged(len(self._capture.train)))
        if self._queue is not None:
            self._queue.restart()
