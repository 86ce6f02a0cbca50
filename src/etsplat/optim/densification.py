"""Which triangles of a soup multiply and which die (Triangle Splatting's rules), as plans for `optim/edit.py`.

No gradient is consulted: parents are drawn by opacity or by sharpness 1/sigma. A triangle is on trial for one whole
epoch, every training view once, that begins with the first epoch after its birth or after its last verdict; only a
finished trial gives a verdict. (Counting from edit to edit instead, as Triangle Splatting does, condemns all triangles
once there are more views than iterations between two edits.) Up to half as many views as those iterations, both are the
same.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from etsplat.core.rasterization import TriangleStatistics
from etsplat.ops.soup_statistics import update_statistics
from etsplat.optim.edit import RowPlan

SPLIT_PARTS = 4


@dataclass
class SoupStatistics:
    """What is remembered of each triangle between two verdicts.

    Attributes:
        importance: (N,) largest blend weight in any pixel.
        screen_size: (N,) largest distance from projected centroid to vertex, in pixels.
        seen: (N,) views of the trial in which the inradius was above one pixel.
        trial: (N,) views of the trial so far; 0 while it waits for the next epoch.
    """

    importance: Float[Tensor, " N"]
    screen_size: Float[Tensor, " N"]
    seen: Int[Tensor, " N"]
    trial: Int[Tensor, " N"]

    @staticmethod
    def zeros(count: int, device: torch.device | str = "cpu") -> "SoupStatistics":
        """Of triangles that nobody has seen yet."""
        number, whole = torch.zeros(count, device=device), torch.zeros(count, dtype=torch.int32, device=device)
        return SoupStatistics(number, number.clone(), whole, whole.clone())

    def update(self, view: TriangleStatistics, views: int, *, epoch_starts: bool) -> None:
        """Takes in a rendering of one training view.

        Args:
            view: its statistics, (1, N).
            views: number of training views, the length of an epoch.
            epoch_starts: whether the view is the first of an epoch.
        """
        update_statistics(list(self.tensors().values()), view, views, epoch_starts)

    def update_on_device(self, view: TriangleStatistics, views: int, epoch_starts: Tensor, halted: Tensor) -> None:
        """As `update`, as part of a queued step.

        Args:
            view: as there.
            views: as there.
            epoch_starts: (1,) float32 in device memory, 0 or 1.
            halted: () int32 in device memory: nothing is updated where it is not 0.
        """
        update_statistics(list(self.tensors().values()), view, views, epoch_starts, halted)

    def judged(self, views: int) -> Bool[Tensor, " N"]:
        """Whose trial is over."""
        return self.trial >= views

    def restart(self, rows: Bool[Tensor, " N"]) -> None:
        """Forgets what is known of the rows; their next trial begins with the next epoch."""
        for tensor in self.tensors().values():
            tensor[rows] = 0

    def tensors(self) -> dict[str, Tensor]:
        """By name, for edits and checkpoints."""
        return dict(vars(self))


@dataclass(frozen=True)
class PruneRules:
    """When a triangle dies.

    Attributes:
        opacity: at or below it.
        importance: its importance stays below it.
        views: it is larger than a pixel in fewer views than this.
        screen_size: it grows larger than this on some view's screen, in pixels.

    Example:
        >>> rules = etsplat.PruneRules(opacity=0.02, screen_size=200.0)
        >>> strategy = etsplat.DensifyAndPrune(max_triangles=5000, prune=rules)
    """

    opacity: float = 0.014
    importance: float = 0.022
    views: int = 0
    screen_size: float = math.inf

    def limited(self, *, views: int, by_size: bool) -> "PruneRules":
        """The same where there are so many views at most, and triangles may grow larger unless `by_size`."""
        return replace(self, views=min(self.views, views), screen_size=self.screen_size if by_size else math.inf)


def dead_triangles(
    opacities: Float[Tensor, " N"], statistics: SoupStatistics, rules: PruneRules, views: int
) -> Bool[Tensor, " N"]:
    """Faint triangles die at once, the others by the verdict of a finished trial.

    Args:
        opacities: (N,).
        statistics: of the same triangles.
        rules: thresholds.
        views: number of training views.
    """
    useless = statistics.importance < rules.importance
    useless |= statistics.seen < rules.views
    useless |= statistics.screen_size > rules.screen_size
    return (opacities <= rules.opacity) | (useless & statistics.judged(views))


def grown_count(count: int, growth: float, max_triangles: int) -> int:
    """How many triangles a soup of `count` may have after a densification."""
    return max(count, min(max_triangles, int(growth * count)))


@torch.no_grad()
def densify_plan(
    vertices: Float[Tensor, "N 3 3"],
    opacity_logits: Float[Tensor, " N"],
    sigma: Float[Tensor, " N"],
    screen_size: Float[Tensor, " N"],
    dead: Bool[Tensor, " N"],
    *,
    target: int,
    by: Literal["opacity", "sharpness"],
    barren: Bool[Tensor, " N"] | None = None,
    split_size: float,
    noise: float,
    generator: torch.Generator,
) -> RowPlan:
    """Removes the dead, and replaces parents by children until there are `target` triangles at most.

    Parents are drawn without replacement, with probabilities in proportion to opacity or 1/sigma. A parent that is
    larger on screen than `split_size` is split at the midpoints of its edges into four; a smaller one becomes two, one
    in its place and one shifted within its plane, both with opacity 1 - sqrt(1 - o), so that together they cover as
    much as it did. Whom no view has seen since the last verdict has no children.

    Args:
        vertices: (N, 3, 3).
        opacity_logits: (N,).
        sigma: (N,).
        screen_size: (N,) in pixels.
        dead: (N,).
        target: never exceeded, unless there are more survivors.
        by: what makes a parent.
        barren: (N,) who else has no children.
        split_size: pixels.
        noise: size of the shift along each axis, as a multiple of the triangle's extent.
        generator: of every random choice.
    """
    N = len(vertices)
    weights = torch.sigmoid(opacity_logits) if by == "opacity" else 1.0 / sigma
    childless = dead | ~weights.isfinite() | (screen_size == 0)
    weights = torch.where(childless if barren is None else childless | barren, 0.0, weights)
    parents = _draw(weights, target - (N - int(dead.sum())), generator)
    large = screen_size[parents] > split_size
    cost = torch.where(large, SPLIT_PARTS - 1, 1).cumsum(0)
    affordable = cost <= target - (N - int(dead.sum()))
    parents, large = parents[affordable], large[affordable]

    gone = dead.clone()
    gone[parents] = True
    survivors = (~gone).nonzero()[:, 0]
    cloned, split = parents[~large], parents[large]
    clones = _cloned(vertices[cloned], noise, generator)
    parts = _split(vertices[split])
    # log(expm1(s)) with s = -log(1 - o) / 2 is the logit of 1 - sqrt(1 - o).
    halved = torch.nn.functional.softplus(opacity_logits[cloned]).mul(0.5).expm1().log()
    source = torch.cat([survivors, cloned.repeat(2), split.repeat_interleave(SPLIT_PARTS)])
    fresh = torch.arange(len(source), device=source.device) >= len(survivors)
    values = {
        "vertices": torch.cat([clones, parts]),
        "opacity_logits": torch.cat([halved.repeat(2), opacity_logits[split].repeat_interleave(SPLIT_PARTS)]),
    }
    return RowPlan(N, source, fresh, values)


def _draw(weights: Float[Tensor, " N"], count: int, generator: torch.Generator) -> Int[Tensor, " K"]:
    """At most `count` rows with positive weight, without replacement, in the order in which they are drawn.

    Row i waits for an exponential time of rate weights[i]; the order of arrival is that of successive draws.
    """
    count = max(0, min(count, int((weights > 0).sum())))
    random = torch.empty(weights.shape, dtype=weights.dtype, device=generator.device)
    arrival = random.exponential_(generator=generator).to(weights.device) / weights
    return torch.topk(arrival, count, largest=False, sorted=True).indices


def _cloned(vertices: Float[Tensor, "K 3 3"], noise: float, generator: torch.Generator) -> Float[Tensor, "K2 3 3"]:
    """The triangles, followed by their shifted copies."""
    extent = vertices.amax(dim=1) - vertices.amin(dim=1)
    shift = (torch.rand(extent.shape, generator=generator).to(extent) - 0.5) * noise * extent
    normal = torch.linalg.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1)
    shift = shift - (shift * normal).sum(dim=1, keepdim=True) * normal
    return torch.cat([vertices, vertices + shift[:, None]])


def _split(vertices: Float[Tensor, "K 3 3"]) -> Float[Tensor, "K4 3 3"]:
    """Four congruent parts of each triangle, one after the other: its three corners and its middle."""
    a, b, c = vertices.unbind(dim=1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [torch.stack(corners, dim=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return torch.stack(parts, dim=1).reshape(-1, 3, 3)
