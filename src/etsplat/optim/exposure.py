"""How each photo was exposed: a gain and a colour matrix for each, learned beside the model.

A camera that chooses exposure and white balance anew for each photo saw of the colour c

    e^g (I + D) c

with a gain g and a matrix D of its own, both near zero. After every step the means of g and of D over the photos are
zero: the model has the colours of the mean photo, and cannot drift away from it. The colours are those of the photos,
as they are displayed.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import camera_centers
from etsplat.core.rasterization import Rasterization
from etsplat.core.validation import check_count
from etsplat.core.workers import workers
from etsplat.data.loader import View
from etsplat.data.pictures import as_float
from etsplat.model.model import Model
from etsplat.ops.adam import Adam
from etsplat.optim.schedules import NEVER, Scheduled, at, exponential_decay

RATE, FINAL = 0.03, 0.02
"""How far a number of a photo moves each time that the photo is seen, at first; what is left of that at the end."""

WEIGHTS = (0.001, 0.05)
"""Of g^2 and of |D|^2, mean over the photos of a step, in the objective. Cameras change brightness much, and colours
little; a matrix that is free makes of the side of an object that some photos show another colour than it has."""

NEEDED, SURE = 0.1, 0.2
"""Exposures are learned where they explain more than this part of the squared error. Early on up to the second is in
doubt: of photos that were exposed alike that may be what the model does not have yet."""

MEASURED_AT, EPOCHS, ENOUGH = 0.1, 5, 10
"""When it is measured whether photos need it, as a fraction of a run; how often each must have been seen by then, so
that the model is not that of the last few; and how often, so that there is no doubt."""

BESIDE = 2
"""Photos by the nearest cameras, whose mean gain says what a photo's would be if it followed the camera."""

TILES, COVERED, FARTHEST = 8, 0.95, 0.7
"""Fields along each side of a photo, every other of which predicts the rest; how opaque pixels of objects are that
count; the largest logarithm of a gain that is started from."""


class Exposure:
    """The gains and matrices of a run's photos, with their optimizer. A trainer has one, or none.

    Attributes:
        measured_at: iteration after which it is measured whether photos need it.
        again_at: iteration after which that is measured again if the answer was in doubt.
        learned: whether it is, by now.
        explained: the part of the squared error that exposures explained when it was measured last, but for what
            follows the cameras where the model may know that; None before.
        adam: the optimizer of "values", (P, 10): of each photo g, then D by rows.

    Example:
        >>> exposure = etsplat.Exposure(measured_at=500)
        >>> exposure.learned, exposure.explained
        (False, None)
    """

    adam: Adam

    @staticmethod
    def of(
        choice: Literal["auto", "on", "off"], iterations: int, epoch: float, *, by_direction: bool = False
    ) -> "Exposure":
        """Learned if a measurement says so, in any case, or not at all. Runs too short for it are not measured.

        Args:
            choice: which of these.
            iterations: of the run.
            epoch: how many iterations show every photo once.
            by_direction: see `Exposure`.
        """
        early = max(1, round(MEASURED_AT * iterations), round(EPOCHS * epoch))
        half = max(1, iterations // 2)
        measured = {"auto": early, "on": min(early, half), "off": NEVER}[choice]
        again = min(round(ENOUGH * epoch), half) if choice == "auto" else 0
        needed = -math.inf if choice == "on" else NEEDED
        rate = partial(_falling, iterations=iterations)
        return Exposure(measured, again_at=again, needed=needed, by_direction=by_direction, rate=rate)

    def __init__(
        self,
        measured_at: int,
        *,
        again_at: int = 0,
        needed: float = NEEDED,
        by_direction: bool = False,
        rate: Scheduled = RATE,
        weights: tuple[float, float] = WEIGHTS,
    ) -> None:
        """Takes when and how fast it is learned.

        Args:
            measured_at: iteration after which photos are measured; `NEVER` for photos that are taken as they are.
            again_at: iteration after which they are measured again where exposures explain no more than `SURE`; none
                that is later than the first for an answer at once.
            needed: learned from then on if it explains more than this part of the squared error. It starts from what
                was measured.
            by_direction: whether the model's colours depend on the direction. Exposures that follow the cameras, as
                along a film, are then learned with them, and views between two photos come out as exposed as these;
                what they explain does not count.
            rate: how far a number of a photo moves each time that the photo is seen.
            weights: of what holds the gains and the matrices near zero.

        Raises:
            ValueError: an iteration is none; `of` takes a choice by name.
        """
        self.measured_at = check_count("measured_at", measured_at, least=0)
        self.again_at, self.learned = check_count("again_at", again_at, least=0), False
        self.explained: float | None = None
        self._needed, self._by_direction, self._rate, self._weights = needed, by_direction, rate, weights

    def start(self, views: Sequence[int], batch: int, like: Tensor) -> None:
        """All photos are neutral.

        Args:
            views: indices of the training views.
            batch: views of a step.
            like: a tensor of the model, for device and precision.
        """
        self._views = list(views)
        self._restart(torch.zeros((len(self._views), 10), dtype=like.dtype, device=like.device))
        rows = torch.zeros(max(self._views, default=0) + 1, dtype=torch.int64)
        rows[torch.tensor(self._views)] = torch.arange(len(self._views))
        self._rows = rows.to(like.device)
        self._neutral = torch.eye(3, dtype=like.dtype, device=like.device)
        # Adam divides by the root of a mean over all steps, of which those with other photos count as zero.
        self._visits = (batch / max(1, len(self._views))) ** 0.5

    def applied(self, rendering: Rasterization, view: View, background: Float[Tensor, "1 3"]) -> Rasterization:
        """A picture of the model as the camera of a view's photo saw it.

        Of a photo with transparency that is the object; what was put behind it stays. Of others it is all.
        """
        matrix = self.matrix(view.index)
        color = torch.nn.functional.linear(rendering.color, matrix)
        if view.photo.shape[-1] == 4:
            change = background - torch.nn.functional.linear(background, matrix)
            color = torch.addcmul(color, 1 - rendering.alpha, change)
        return replace(rendering, color=color)

    def penalty(self, view: View) -> Float[Tensor, ""]:
        """What holds the numbers of a view's photo near zero."""
        gain, offsets = self._numbers(view.index).square().split([1, 9])
        return self._weights[0] * gain.sum() + self._weights[1] * offsets.sum()

    def matrix(self, index: Tensor) -> Float[Tensor, "3 3"]:
        """e^g (I + D) of a photo; differentiable.

        Args:
            index: (1,) int64 of its view, on the device.
        """
        gain, offsets = self._numbers(index).split([1, 9])
        return gain.exp() * (self._neutral + offsets.view(3, 3))

    @torch.no_grad()
    def matrices(self) -> dict[int, Float[Tensor, "3 3"]]:
        """e^g (I + D) of every photo, by the index of its view, on the CPU."""
        return {view: self.matrix(torch.tensor([view], device=self._rows.device)).cpu() for view in self._views}

    def step(self, iteration: int) -> None:
        """Adam's, from the gradients; then the means become zero."""
        self.adam.learning_rates["values"] = self._rate_at(iteration)
        self.adam.step()
        self._center(None)

    def queued_rates(self, iteration: int) -> list[float]:
        """What a queued step needs, two numbers; zeros where nothing is learned. Counts the step."""
        if not self.learned:
            return [0.0, 0.0]
        self.adam.learning_rates["values"] = self._rate_at(iteration)
        self.adam.step_count += 1
        return self.adam.rates(["values"])

    def step_on_device(self, rates: Float[Tensor, "2"], halted: Tensor) -> None:
        """As `step`, from `queued_rates` in device memory; changes nothing where () `halted` is not 0."""
        self.adam.step_on_device(rates, halted)
        self._center(halted)

    def measure(self, model: Model, views: Sequence[View], background: Float[Tensor, "1 3"]) -> None:
        """Measures whether photos need it, and learns from now on if they do. Changes nothing else.

        Where that is in doubt the next measurement says it.

        Args:
            model: as it is now.
            views: of all photos, in their order.
            background: behind photos without transparency.
        """
        first = self.explained is None and self.again_at > self.measured_at
        explained, gains = explained_error(model, views, background)
        self.explained = explained * share_of_their_own(gains, views) if self._by_direction else explained
        self.learned = self.explained > (max(SURE, self._needed) if first else self._needed)
        if self.learned:
            overall = gains.mean(dim=1)
            offsets = torch.diag_embed((gains - overall[:, None]).exp() - 1)
            with torch.no_grad():
                self.values.copy_(torch.cat([overall[:, None], offsets.flatten(1)], dim=1))
            self._center(None)

    def next_measurement(self, iteration: int) -> int:
        """The iteration, this one or later, after whose step photos are measured."""
        doubtful = self.explained is not None and self._needed < self.explained <= SURE and not self.learned
        times = (self.measured_at, self.again_at) if doubtful else (self.measured_at,)
        return min((time for time in times if time >= iteration), default=NEVER)

    def state(self) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint."""
        found = {} if self.explained is None else {"explained": torch.tensor(self.explained, dtype=torch.float64)}
        if not self.learned:
            return found
        first, second = self.adam.first_moments["values"], self.adam.second_moments["values"]
        count = torch.tensor(self.adam.step_count)
        return {**found, "values": self.values.detach(), "first": first, "second": second, "step_count": count}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        self.learned = "values" in state
        self.explained = float(state["explained"]) if "explained" in state else None
        self._restart(torch.zeros_like(self.values))
        if self.learned:
            values, first, second = (state[name].to(self.values.device) for name in ("values", "first", "second"))
            self.adam.replace("values", values.clone().requires_grad_(True), first.clone(), second.clone())
            self.adam.step_count = int(state["step_count"])

    def take_over(self, known: "Exposure") -> None:
        """Begins with what another has learned of the same photos, and measures nothing.

        Args:
            known: of some of these photos, which come first here. Others are neutral.
        """
        self.measured_at = self.again_at = NEVER
        state = known.state()
        if known.learned:
            others = (0, 0, 0, len(self.values) - len(known.values))
            state |= {name: torch.nn.functional.pad(state[name], others) for name in ("values", "first", "second")}
        self.load_state(state)

    @property
    def values(self) -> Float[Tensor, "P 10"]:
        """What is learned: of each photo g, then D by rows."""
        return self.adam.parameters["values"]

    def _restart(self, zeros: Float[Tensor, "P 10"]) -> None:
        self.adam = Adam({"values": zeros.detach().requires_grad_(True)}, {"values": 0.0})

    def _numbers(self, index: Tensor) -> Float[Tensor, "10"]:
        return self.values.index_select(0, self._rows.index_select(0, index))[0]

    def _rate_at(self, iteration: int) -> float:
        return at(self._rate, iteration) * self._visits

    @torch.no_grad()
    def _center(self, halted: Tensor | None) -> None:
        mean = self.values.mean(dim=0)
        self.values.sub_(mean if halted is None else torch.where(halted == 0, mean, 0.0))


def _falling(iteration: int, iterations: int) -> float:
    return RATE * exponential_decay(iteration, iterations, FINAL)


@torch.no_grad()
def explained_error(
    model: Model, views: Sequence[View], background: Float[Tensor, "1 3"]
) -> tuple[float, Float[Tensor, "P 3"]]:
    """The part of the squared error of a model's pictures that exposures of their photos explain, and these.

    A photo is divided like a chess board. The gains of the three channels that fit the fields of one colour predict
    those of the other, so that what differs from place to place explains nothing. Gains count by how they differ from
    their mean over the photos.

    Args:
        model: as it is now.
        views: with their photos.
        background: behind photos without transparency. Of others the pixels count that the object fills.

    Returns:
        That part, at most 1; and the logarithm of the gain of each channel of each photo, beside the mean photo.
    """
    sums = workers().map(lambda view: _products(model, view, background), views)
    squares, products, wanted = torch.stack(sums).unbind(dim=2)

    def error(gains: Float[Tensor, "P 2 3"]) -> float:
        return float((wanted - 2 * gains * products + gains**2 * squares).sum())

    fitted = _ratio(products, squares)
    predicted = 1 + (fitted - fitted.mean(dim=(0, 1))).flip(1)
    before = error(torch.ones_like(fitted))
    logs = _ratio(products.sum(dim=1), squares.sum(dim=1)).clamp_min(1e-3).log()
    gains = (logs - logs.mean(dim=0)).clamp(-FARTHEST, FARTHEST)
    return (1 - error(predicted) / before if before > 0 else 0.0), gains


def share_of_their_own(gains: Float[Tensor, "P 3"], views: Sequence[View]) -> float:
    """The part of the variance of photos' gains that those of the photos by the nearest cameras do not predict, 0 to 1.

    Args:
        gains: logarithms, beside their mean.
        views: of these photos; near are cameras at nearly one place that look in nearly one direction.
    """
    variance = float(gains.square().sum())
    if len(views) <= BESIDE or variance == 0:
        return 1.0
    viewmats = torch.cat([view.camera.viewmats for view in views]).to(gains.device)
    centers, ahead = camera_centers(viewmats), viewmats[:, 2, :3]
    spread = (centers - centers.mean(dim=0)).norm(dim=1).mean().clamp_min(1e-12)
    apart = torch.cdist(centers, centers) / spread + torch.cdist(ahead, ahead)
    beside = apart.fill_diagonal_(torch.inf).topk(BESIDE, largest=False).indices
    return min(1.0, float((gains - gains[beside].mean(dim=1)).square().sum()) / variance)


def _products(model: Model, view: View, background: Float[Tensor, "1 3"]) -> Float[Tensor, "2 3 3"]:
    """Of black and white fields: the sums over pixels of x^2, x y and y^2 of each channel, x drawn, y in the photo."""
    photo, sums = as_float(view.photo[0]), []
    rendering = model.render(view.camera, backgrounds=background)
    counts = torch.ones_like(photo[..., 0]) if view.mask is None else as_float(view.mask[0])
    if photo.shape[-1] == 4:
        counts = counts * ((photo[..., 3] > COVERED) & (rendering.alpha[0, ..., 0] > COVERED))
    for field in _chess_board(counts):
        x, y = (field[..., None] * image[..., :3].double() for image in (rendering.color[0], photo))
        sums.append(torch.stack([(x * x).sum(dim=(0, 1)), (x * y).sum(dim=(0, 1)), (y * y).sum(dim=(0, 1))]))
    return torch.stack(sums).cpu()


def _ratio(products: Tensor, squares: Tensor) -> Tensor:
    """The gains that fit; 1 where there is nothing to fit to."""
    return torch.where(squares > 0, products / squares.clamp_min(1e-30), 1.0)


def _chess_board(counts: Float[Tensor, "H W"]) -> list[Float[Tensor, "H W"]]:
    """What counts on the black fields, and on the white ones."""
    rows, columns = (torch.arange(side, device=counts.device) * TILES // side for side in counts.shape)
    black = (rows[:, None] + columns) % 2 == 0
    return [counts * black, counts * ~black]
