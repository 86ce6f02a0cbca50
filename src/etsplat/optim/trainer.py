"""Fits a model to photos: one trainer for every model, objective, strategy and data set."""

import contextlib
import copy
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Generic, NoReturn, TypeVar

import torch
from torch import Tensor

from etsplat.core.precision import usual_defaults
from etsplat.core.validation import check_count, first_not_finite
from etsplat.core.workers import workers
from etsplat.data.dataset import Dataset, middles_of
from etsplat.engines.choice import engine_for
from etsplat.io.kernel_files import adopt_kernel, kernel_tensors
from etsplat.io.run_directory import RunDirectory
from etsplat.model.model import Model
from etsplat.ops.adam import Adam
from etsplat.optim.camera_refinement import CameraRefinement
from etsplat.optim.camera_trial import CameraTrial
from etsplat.optim.depth_trust import DepthTrust
from etsplat.optim.drive import drive, kept_in
from etsplat.optim.exposure import Exposure
from etsplat.optim.gauge import Gauge
from etsplat.optim.guard import Guard
from etsplat.optim.loop import Callback, DivergedError, LoopSettings, Progress, Return, UndoEvent
from etsplat.optim.objective import Objective
from etsplat.optim.schedules import NEVER, Schedule
from etsplat.optim.stepper import Stepper
from etsplat.optim.strategies import Fixed, Strategy
from etsplat.optim.trainer_checks import (
    check_callbacks,
    check_edited,
    check_parts,
    check_unreplaced,
    checked_background,
    checked_metrics,
    doubts_before,
    generator_of,
    plain_settings,
    state_of,
    tell,
    tell_of_going_on,
)
from etsplat.optim.watch import Outcome, Watch

GUARD_SIDE, GUARD_VIEWS = 128, 32
"""Edits are judged by pictures with at most so many pixels on a side, of at most so many training views."""

WATCH_SIDE = 512
"""The photos that are kept aside are measured with at most so many pixels on a side."""


M = TypeVar("M", bound=Model)


class Trainer(Generic[M]):
    """One run's state, and what changes it: steps and edits. Implements `optim.loop.Problem`.

    Attributes:
        model: as it is now; changed in place.
        adam: its optimizer.
        strategy: what adds and removes triangles.
        exposure: what is learned of each photo's exposure.
        depths: which depth maps are believed.
        cameras: what is learned of each photo's camera.
        trial: whether that stays.
        progress: where the run stands.
        guard: what undoes edits; None lets all of them stay.
        onlooker: called after steps, before an edit, with the iterations done; it may look at the model, not change it.

    Example:
        >>> photos = etsplat.photograph(etsplat.demo_object(), 32, 32, elevations=(0.0,), azimuths=5, supersampling=1)
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(2), colors=0.7, opacity=0.98, sigma=0.25)
        >>> objective = etsplat.Objective(etsplat.Photometric(), [etsplat.EdgeLength(0.5)])
        >>> trainer = etsplat.Trainer(mesh, photos, objective, etsplat.SubdivideAndUntangle({2: 400}))
        >>> outcome = trainer.fit(4)
        >>> 320 < mesh.count <= 400
        True
    """

    onlooker: Callable[[int], None] | None = None

    @usual_defaults()
    def __init__(
        self,
        model: M,
        dataset: Dataset,
        objective: Objective,
        strategy: Strategy | None = None,
        *,
        schedule: Schedule | None = None,
        batch: int = 1,
        background: Sequence[float] | None = None,
        exposure: Exposure | None = None,
        depths: DepthTrust | None = None,
        cameras: CameraRefinement | None = None,
        update: Callable[[Adam, Any], None] | None = None,
        paces: Mapping[str, Callable[[Tensor], Tensor]] | None = None,
        evaluate: Callable[[Any], dict[str, float]] | None = None,
        guard: Guard | None = None,
        seed: int | torch.Generator = 0,
    ) -> None:
        """Starts a run.

        Args:
            model: the start, on the device where the run is to be. All of its parameters are learned; one that is to
                stay as it is has the rate 0 in the schedule.
            dataset: photos and cameras; the views in `dataset.train` are fitted to, those in `dataset.watched` are
                measured at every evaluation, and choose the state that `outcome` gives.
            objective: what is minimised.
            strategy: what adds and removes triangles; None for `Fixed`.
            schedule: learning rates, and what else changes over the run; None for the model's own rates throughout.
            batch: views that each step sees; the rates are multiplied by its square root.
            background: colour behind the pictures; None for another random one behind each.
            exposure: what is learned of each photo's exposure; None for photos that were all exposed alike.
            depths: which depth maps are believed, as the objective's term has it; None where none are used.
            cameras: what is learned of the cameras of photos, judged by those in `dataset.watched`; None for cameras
                as they are given.
            update: takes the step from the gradients, in the place of `Adam.step`.
            paces: by name of a parameter, what says of its values how much faster each row moves than its rate (rows,).
                Asked at the start and after every edit.
            evaluate: cheap metrics of the model; of several workers the first one measures them.
            guard: undoes edits of the strategy after which the training photos are explained worse.
            seed: of the order of views and every other random choice; or a generator to go on with.

        Raises:
            ValueError: cameras are to be refined, and no photos are kept aside to judge them; there is no view to fit
                to; the schedule or the paces name other parameters than the model's; an argument is of another kind.
        """
        others: dict[str, tuple[object, type]] = {"schedule": (schedule, Schedule), "exposure": (exposure, Exposure)}
        others |= {"cameras": (cameras, CameraRefinement), "guard": (guard, Guard)}
        check_parts(model, dataset, objective, strategy, others, paces or {})
        batch, generator = check_count("batch", batch), generator_of(seed)
        self.model, self.strategy, self.progress = model.learnable(), strategy or Fixed(), Progress()
        self.exposure, self.depths, self.guard = exposure or Exposure(NEVER), depths or DepthTrust([]), guard
        self.cameras = cameras or CameraRefinement()
        self._objective, self._dataset, self._batch, self._evaluate = objective, dataset, batch, evaluate
        self._paces, self._doubts = dict(paces or {}), doubts_before(dataset, own_rates=schedule is None)
        self._began = generator.get_state()
        parts = (strategy, objective.photometric, objective.terms, exposure, depths, cameras, guard)
        rates = {} if schedule is None else {**schedule.rates, **schedule.values}
        self._settings = plain_settings([*parts, rates])
        self._kernel = getattr(model.appearance, "kernel", None)  # of what is soft at first; None for other models
        self._background = checked_background(background)
        behind = None if self._background is None else torch.tensor([self._background])
        self._stepper = Stepper(
            model,
            dataset,
            objective,
            self.strategy,
            schedule or Schedule(model.rates),
            self.exposure,
            self.cameras,
            batch=batch,
            background=behind,
            update=update,
            generator=generator,
        )
        self.adam = self._stepper.adam
        self._set_paces()
        some = next(iter(model.parameters().values()))
        self._device = some.device
        judges = middles_of(dataset.train, min(len(dataset.train), GUARD_VIEWS))
        placed = self.cameras.placed
        self._judging = Gauge(dataset, judges, GUARD_SIDE, self._device, behind, placed=placed)
        self._known_loss: float | None = None
        kept = None
        if dataset.watched:
            kept = Gauge(dataset, dataset.watched, WATCH_SIDE, self._device, behind, placed=placed)
        self._watch = None if kept is None else Watch(kept, objective, self._stepper.look)
        self.trial = CameraTrial(self.cameras, kept, objective)
        self._edited_after = -1
        self.strategy.start(model, self.adam, len(dataset.train), generator)
        self.exposure.start(dataset.train, batch, some)
        self.cameras.start(dataset, batch, some)
        self.depths.start(some)

    @usual_defaults()
    def fit(
        self,
        iterations: int,
        *,
        callbacks: Sequence[Callback] = (),
        log_every: int = 50,
        evaluate_every: int = 0,
        checkpoint_every: int = 0,
        run: RunDirectory | Path | str | None = None,
        run_hash: str | None = None,
    ) -> Progress:
        """Makes all steps up to an iteration that have not been made, and the edits between them.

        Ctrl-C finishes the iteration at hand first, and saves a checkpoint if there is a run directory. What a callback
        raises ends it after the iteration at hand, too; the trainer can be gone on with.

        Args:
            iterations: length of the run, counted from its start.
            callbacks: each is called with every event (`optim/loop.py`), in the thread of the caller. The first are
                notes of what is probably wrong with the data set, which are warnings where there is no callback.
            log_every: iterations between StepEvents.
            evaluate_every: iterations between evaluations; 0 for one at the end only.
            checkpoint_every: iterations between checkpoints; 0 for one at the end only.
            run: gets checkpoints and history.jsonl, and is gone on with if it has a checkpoint; made if it is missing.
                None writes nothing.
            run_hash: identifies all that the result depends on; a checkpoint of another run is refused. None for one of
                the photos, the seed, the kinds of the parts and such of their settings as are numbers or texts, rates
                that do not change, the kernel and the background; not of the model, which a checkpoint replaces, and of
                functions the names alone.

        Returns:
            Where the run stands.

        Raises:
            DivergedError: a loss or parameter is not finite; no triangle is left.
            InputError: a checkpoint is damaged or of another run; somebody else writes the run; the disk is full.
            ValueError: a number is out of its range; `callbacks` are no functions; `evaluate` returned no numbers;
                somebody else has replaced tensors of the model.
        """
        settings = LoopSettings(iterations, log_every, evaluate_every, checkpoint_every)
        check_callbacks(callbacks)
        check_unreplaced(self.model, self.adam)
        if run_hash is None and (run is not None or workers().count > 1):
            run_hash = self._hash()
        if not isinstance(run, RunDirectory) and workers().leads:  # of a task, which has told what is to be told
            tell(self._doubts, callbacks)
            self._doubts = ()
        with contextlib.ExitStack() as stack:
            stack.enter_context(engine_for(next(iter(self.model.parameters().values()))).looping())
            kept = stack.enter_context(kept_in(run, settings))
            going_on = partial(tell_of_going_on, run, callbacks)
            drive(self, self.progress, settings, callbacks, kept, run_hash or "", going_on)
        return self.progress

    def stop(self) -> None:
        """Lets `fit` end after the iteration at hand, with a checkpoint if there is a run directory; for callbacks.

        Another `fit` goes on from there.
        """
        self.progress.ending = True

    def __repr__(self) -> str:
        model = f"{type(self.model).__name__} of {self.count:,} triangles"
        return f"Trainer({model}, {len(self._dataset.train)} photos, {self.progress.iteration} steps)"

    def __deepcopy__(self, memo: dict[int, Any]) -> "Trainer[M]":
        twin = memo[id(self)] = object.__new__(type(self))
        vars(twin).update(copy.deepcopy(vars(self), memo))
        return twin

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a Trainer cannot be pickled, as it holds functions: fit(n, run=FOLDER, checkpoint_every=m) writes"
            " checkpoints, with which fit(n, run=FOLDER) of a Trainer that is made anew goes on; models, data sets and"
            " Adam can be"
        )

    @property
    def count(self) -> int:
        """Number of triangles."""
        return self.model.count

    def describe(self) -> dict[str, float]:
        """What the model says of itself."""
        return self.model.describe()

    def advance(self, first: int, last: int) -> list[float]:
        """Steps; on a device many together. Returns the losses before them."""
        judged = NEVER if self.guard is None else self.guard.due
        measured = self.exposure.next_measurement(first), self.depths.next_measurement(first)
        stops = self.strategy.next_edit(first), judged, *measured
        self._known_loss = None
        losses = self._stepper.advance(first, last, stops)
        if self.onlooker is not None:
            self.onlooker(first + len(losses) - 1)
        return losses

    def refine(self, iteration: int) -> int:
        """Edits if it is time to; returns by how many triangles the model grew."""
        if iteration == self.exposure.next_measurement(iteration):
            self._stepper.measure_exposure()
            self._known_loss = None
        if iteration == self.depths.measured_at:
            self._stepper.measure_depths(self.depths)
        self._edited_after = iteration
        return self._edit(iteration)

    def _edit(self, iteration: int) -> int:
        before = self.count
        guard = self.guard if self.strategy.next_edit(iteration) == iteration else None
        if guard is not None:
            self.strategy.undone = guard.undone.count(iteration)
            if self.strategy.undone == self.strategy.attempts(iteration):
                return 0
            following = min(self.strategy.next_edit(iteration + 1), self._stepper.alike_until(iteration))
            loss = self._loss()
            guard.hold(self.progress, following, loss, self._state())
        parameters = self.model.parameters()
        edited, self._known_loss = self.strategy.edit(iteration), None  # it may change tensors in place
        check_edited(self.strategy, iteration, edited, parameters, self.model, self.adam)
        if edited:
            if not self.count:
                raise DivergedError(f"{type(self.strategy).__name__} left no triangle at iteration {iteration}")
            self._set_paces()
            self.edited()
        elif guard is not None:
            guard.release_if_same(self._state())
        return self.count - before

    def review(self, progress: Progress) -> Return | None:
        """Judges the last edit, or refined cameras, if it is time to.

        If an edit is undone, everything is as it was, and a milder one is made.
        """
        undone = self._review_edit(progress)
        if undone is not None or not self.cameras.wanted or self._edited_after != progress.iteration:
            return undone
        event = self.trial.review(self.model, progress, self._state_of_run, self._go_back)
        self._known_loss = None
        if event is not None and event.refined is None and self.guard is not None:
            self.guard.held = None  # an edit before it stays: what is held of it knows nothing of refined cameras
        return event

    def _review_edit(self, progress: Progress) -> UndoEvent | None:
        if self.guard is None or progress.iteration < self.guard.due:
            return None
        loss = self._loss()
        held = self.guard.judge(loss)
        if held is None:
            return None
        judged = progress.iteration
        self._load(held.state, held.iteration)
        self._known_loss = held.loss
        progress.iteration, (progress.loss_sum, progress.loss_count) = held.iteration, held.losses
        left = self.guard.undone.count(held.iteration) < self.strategy.attempts(held.iteration)
        undone = UndoEvent(held.iteration, judged, held.loss, loss, milder=left)
        self._edit(held.iteration)
        return self._review_edit(progress) or undone

    def _set_paces(self) -> None:
        for name, measure in self._paces.items():
            self.adam.paces[name] = measure(self.adam.parameters[name].detach())

    def edited(self) -> None:
        """To be called when tensors of the model were replaced."""
        self._stepper.restart()
        self._known_loss = None

    @usual_defaults()
    def evaluate(self) -> dict[str, float]:
        """Cheap metrics of the present state, which is kept if the watched photos speak for it."""
        metrics = checked_metrics(self._evaluate(self.model)) if self._evaluate and workers().leads else {}
        watched = self._watch.observe(self.model, self.progress.iteration) if self._watch else {}
        if watched and self.progress.iteration <= self._stepper.alike_until(0):  # what opaque ones say is another thing
            self.depths.observe(watched["watched_psnr"])
        return metrics | watched

    @usual_defaults()
    def outcome(self) -> Outcome[M]:
        """What the run gives: the last state, or an earlier one where the watched photos speak for it (optim/watch.py).

        Changes nothing, so that the run can be gone on with.
        """
        last = self.progress.iteration
        if self._watch is None:
            return Outcome(self.model, last)

        def finish(model: M) -> None:
            self.strategy.undone = 0 if self.guard is None else self.guard.undone.count(last)
            if self.strategy.undone < self.strategy.attempts(last):
                self.strategy.finish(model)

        return self._watch.outcome(self.model, last, finish)

    def first_not_finite(self) -> str | None:
        """The name of a parameter that holds NaN or infinity, or None."""
        cameras = {f"cameras.{name}": learned for name, learned in self.cameras.learned.items()}
        return first_not_finite({**self.model.parameters(), "exposure": self.exposure.values, **cameras})

    def state(self) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint."""
        return {**self._state_of_run(), **{f"trial.{name}": tensor for name, tensor in self.trial.state().items()}}

    def _state_of_run(self) -> dict[str, Tensor]:
        """All but the trial's."""
        judgements = {} if self.guard is None else self.guard.state()
        return {**self._state(), **{f"guard.{name}": tensor for name, tensor in judgements.items()}}

    def _state(self) -> dict[str, Tensor]:
        """All but the guard's."""
        parts = {
            "model": self.model.state(),
            "adam.first": self.adam.first_moments,
            "adam.second": self.adam.second_moments,
            "adam.paces": self.adam.paces,
            "strategy": state_of(self.strategy),
            "sampler": self._stepper.sampler.state(),
            "watch": self._watch.state() if self._watch else {},
            "exposure": self.exposure.state(),
            "depths": self.depths.state(),
            "cameras": self.cameras.state(),
        }
        state = {f"{part}.{name}": tensor for part, tensors in parts.items() for name, tensor in tensors.items()}
        return {**state, **kernel_tensors(self._kernel), "adam.step_count": torch.tensor(self.adam.step_count)}

    def load_state(self, state: dict[str, Tensor], iteration: int) -> None:
        """Continues where `state` was taken."""
        self._go_back(state, iteration)
        self.trial.load_state(_part(state, "trial"))

    def _go_back(self, state: dict[str, Tensor], iteration: int) -> None:
        """To where the state of the run was taken, whatever the trial holds."""
        self._load(state, iteration)
        if self.guard is not None:
            self.guard.load_state(_part(state, "guard"))
        self._edited_after = -1

    def _load(self, state: dict[str, Tensor], iteration: int) -> None:
        adopt_kernel(Path("checkpoint"), self._kernel, state)  # refuses one of another kernel of this name
        self.model.load_state(_part(state, "model"))
        first, second = _part(state, "adam.first"), _part(state, "adam.second")
        for name, parameter in self.model.parameters().items():
            self.adam.replace(name, parameter, first[name].to(self._device), second[name].to(self._device))
        self.adam.paces = {name: paces.to(self._device) for name, paces in _part(state, "adam.paces").items()}
        self.adam.step_count = int(state["adam.step_count"])
        self.strategy.load_state(_part(state, "strategy"))
        self._stepper.sampler.load_state(_part(state, "sampler"))
        if self._watch is not None:
            self._watch.load_state(_part(state, "watch"))
        self.exposure.load_state(_part(state, "exposure"))
        self.depths.load_state(_part(state, "depths"))
        self.cameras.load_state(_part(state, "cameras"))
        self._stepper.arrive(iteration)
        self.edited()

    def _loss(self) -> float:
        """By which edits are judged; measured once of each state."""
        if self._known_loss is None:
            self._known_loss = self._judging.measure(self.model, self._objective, self.exposure).loss
        return self._known_loss

    def _hash(self) -> str:
        kinds = [
            type(self.model).__name__,
            type(self.strategy).__name__,
            self._kernel,
            self._background,
            self._settings,
        ]
        about = [self._dataset.fingerprint(), self._batch, kinds, self._objective.weights(1), self._began.tolist()]
        return hashlib.sha256(json.dumps(about).encode()).hexdigest()


def _part(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    return {key.removeprefix(f"{name}."): tensor for key, tensor in state.items() if key.startswith(f"{name}.")}
