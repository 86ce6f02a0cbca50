"""Whether refined cameras stay: photos that are kept aside decide.

The same steps are made twice, with the cameras of training photos as given and with refined ones. Then each photo that
is kept aside, whose own pose is as poor, is aligned to either model, which does not learn of it. What shows them better
goes on: the model with refined cameras if it is better by `NEEDED`, or else the other, to the bit.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from etsplat.model.model import Model
from etsplat.optim.camera_alignment import aligned_motion
from etsplat.optim.camera_event import CamerasEvent
from etsplat.optim.camera_motion import moved
from etsplat.optim.camera_refinement import CameraRefinement
from etsplat.optim.gauge import Gauge
from etsplat.optim.loop import Progress
from etsplat.optim.objective import Objective

NEEDED = 0.1
"""By so many dB photos that are kept aside must be better."""

State = dict[str, Tensor]


class CameraTrial:
    """The two attempts of a run, and what came of them.

    Attributes:
        given: PSNR of the photos that are kept aside, aligned, with cameras as given; None before.
        refined: the same with refined cameras.
    """

    def __init__(self, cameras: CameraRefinement, kept: Gauge | None, objective: Objective) -> None:
        """Has seen nothing yet.

        Args:
            cameras: that may be refined; activated by the trial.
            kept: measures the photos that are kept aside; None if there are none.
            objective: of the run.

        Raises:
            ValueError: there are none, and cameras may be refined.
        """
        if cameras.wanted and kept is None:
            raise ValueError("cameras: photos must be kept aside to judge refined cameras; see Dataset.watching")
        self._cameras, self._kept, self._objective = cameras, kept, objective
        self.given: float | None = None
        self.refined: float | None = None
        self._held: dict[str, State] = {}
        self._losses: dict[str, tuple[float, int]] = {}

    def review(
        self, model: Model, progress: Progress, state: Callable[[], State], load: Callable[[State, int], None]
    ) -> CamerasEvent | None:
        """To be called after every step and its edits; where it is time, begins, goes back, or decides.

        Args:
            model: as it is now.
            progress: where the run stands; changed where the run goes back.
            state: all of the run but this trial.
            load: continues where a state was taken, after so many iterations.
        """
        cameras, now = self._cameras, progress.iteration
        if now == cameras.begin and self.given is None:
            self._hold("begin", state(), progress)
        elif now == cameras.judged and self.refined is None:
            return self._judge(model, progress, state, load)
        elif now == cameras.end and cameras.active:
            self._align(model)
        return None

    def _judge(
        self, model: Model, progress: Progress, state: Callable[[], State], load: Callable[[State, int], None]
    ) -> CamerasEvent:
        cameras, begin, judged = self._cameras, self._cameras.begin, progress.iteration
        found = self._align(model)
        if self.given is None:
            self.given = found
            self._hold("given", state(), progress)
            self._go_on("begin", begin, progress, load)
            cameras.activate(model.parameters()["vertices"].detach().reshape(-1, 3))
            return CamerasEvent(begin, begin, judged, found)
        self.refined = found
        stays = found > self.given + NEEDED
        if not stays:
            self._go_on("given", judged, progress, load)
        self._held, self._losses = {}, {}
        return CamerasEvent(judged, begin, judged, self.given, found, stays)

    def _align(self, model: Model) -> float:
        """The PSNR of the photos that are kept aside, aligned; refined cameras remember where they are."""
        assert self._kept is not None
        motions, views = {}, {}
        for view, background in self._kept.scenes:
            index, start = int(view.index), self._cameras.unaligned(view)
            motions[index] = aligned_motion(model, self._objective.photometric, start, background)
            views[index] = moved(start.camera, motions[index])
        if self._cameras.active:
            self._cameras.align(motions)
        return self._kept.placing(views).measure(model, self._objective).psnr

    def _hold(self, name: str, state: State, progress: Progress) -> None:
        self._held[name] = {key: tensor.detach().clone() for key, tensor in state.items()}
        self._losses[name] = progress.loss_sum, progress.loss_count

    def _go_on(self, name: str, iteration: int, progress: Progress, load: Callable[[State, int], None]) -> None:
        load(self._held.pop(name), iteration)
        progress.iteration, (progress.loss_sum, progress.loss_count) = iteration, self._losses.pop(name)

    def state(self) -> State:
        """Everything that the rest of the trial depends on, by name, for a checkpoint."""
        scores = [score for score in (self.given, self.refined) if score is not None]
        state = {"scores": torch.tensor(scores, dtype=torch.float64)} if scores else {}
        for name, held in self._held.items():
            state |= {f"{name}.{key}": tensor for key, tensor in held.items()}
            state[f"losses.{name}"] = torch.tensor(self._losses[name], dtype=torch.float64)
        return state

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        scores = state["scores"].tolist() if "scores" in state else []
        self.given, self.refined = [*scores, None, None][:2]
        self._held, self._losses = {}, {}
        for name in ("begin", "given"):
            if f"losses.{name}" in state:
                loss_sum, loss_count = state[f"losses.{name}"].tolist()
                self._losses[name] = loss_sum, int(loss_count)
                held = {key: tensor for key, tensor in state.items() if key.startswith(f"{name}.")}
                self._held[name] = {key.removeprefix(f"{name}."): tensor for key, tensor in held.items()}

    @property
    def metrics(self) -> dict[str, Any]:
        """For metrics.json; nothing where no cameras may be refined."""
        if not self._cameras.wanted:
            return {}
        return {
            "cameras_refined": self._cameras.active,
            "watched_psnr_given_cameras": self.given,
            "watched_psnr_refined_cameras": self.refined,
        }
