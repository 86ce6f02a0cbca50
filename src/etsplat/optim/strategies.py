"""When triangles are added and removed, and which: strategies. They edit through `optim/edit.py` alone."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from etsplat.core.rasterization import Rasterization
from etsplat.core.validation import check_choice, check_count, check_number, shown
from etsplat.geometry.discs import cut_open
from etsplat.geometry.films import slits_closed
from etsplat.geometry.flips import flipped
from etsplat.geometry.measures import face_areas
from etsplat.geometry.subdivision import longest_edge_plan
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.untangle import untangle
from etsplat.model.model import model_for
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.adam import Adam
from etsplat.optim.densification import PruneRules, SoupStatistics, dead_triangles, densify_plan, grown_count
from etsplat.optim.edit import RowPlan, apply_rows, apply_sources, apply_subdivision, halves_plan
from etsplat.optim.loop import DivergedError
from etsplat.optim.picture_errors import FaceErrors
from etsplat.optim.schedules import NEVER
from etsplat.optim.terms.soup import Spared

_SHORT = 0.5
"""Folds in which a vertex would have to move farther than this stay where a longer reach spoilt the pictures."""


_DEEPEST = 0.4
"""Slits in what nobody sees are no deeper, in units of the ball around an object; what is deeper is a hollow."""


class Strategy:
    """What a run does to the number of its triangles; this one does nothing. One of your own overrides what it needs.

    Attributes:
        outputs: what it looks at of each picture of a step, as of `etsplat.rasterize`.
        model: what is edited, from `start` on.
        adam: its optimizer.
        views: number of training views.
        generator: of every random choice.
        undone: how many attempts at the edit that is to be made were undone, because the pictures got worse.

    Example:
        >>> class Thin(etsplat.Strategy):
        ...     def next_edit(self, iteration):
        ...         return -(-iteration // 100) * 100
        >>> Thin().next_edit(101)
        200
    """

    outputs: tuple[str, ...] = ()
    undone: int = 0
    model: Any
    adam: Adam
    views: int
    generator: torch.Generator

    def start(self, model: Any, adam: Adam, views: int, generator: torch.Generator) -> None:
        """Called once, before the first step."""
        self.model, self.adam, self.views, self.generator = model, adam, views, generator

    def next_edit(self, iteration: int) -> int:
        """The first iteration, from this one on, after whose step `edit` may have something to do."""
        return NEVER

    def attempts(self, iteration: int) -> int:
        """How many ways there are of making the edit of an iteration, the milder ones later."""
        return 1

    def edit(self, iteration: int) -> bool:
        """Edits the model if it is time to. Returns whether tensors were replaced."""
        return False

    def finish(self, model: Any) -> None:
        """Does to an earlier state of the model, which is to be the result, what `edit` does after the last step."""

    def observe(self, seen: Rasterization, *, epoch_starts: bool) -> None:
        """Takes in a view of a step; `epoch_starts` if it is the first after all views had their turn."""

    def observe_on_device(self, seen: Rasterization, epoch_starts: Tensor, halted: Tensor) -> None:
        """As `observe`, without the host: `epoch_starts` (1,) is 0 or 1, nothing changes where () `halted` is not 0."""

    def state(self) -> dict[str, Tensor]:
        """Everything that later edits depend on, by name, for a checkpoint."""
        return {}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues where `state` was taken."""


class Fixed(Strategy):
    """The triangles of the start are those of the end.

    Example:
        >>> photos = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0,), azimuths=3, supersampling=1)
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
        >>> objective = etsplat.Objective(etsplat.Photometric())
        >>> outcome = etsplat.Trainer(mesh, photos, objective, etsplat.Fixed()).fit(2)
        >>> mesh.count
        80
    """


class SubdivideAndUntangle(Strategy):
    """Divides a mesh's largest faces at given times (paper, appendix Adaptive Refinement), undoes folds, removes lids.

    Example:
        >>> strategy = etsplat.SubdivideAndUntangle({100: 2500, 200: 5000}, untangle_after=[150])
        >>> [strategy.next_edit(iteration) for iteration in (0, 101, 151)]
        [100, 150, 200]
    """

    def __init__(
        self,
        budgets: Mapping[int, int],
        untangle_after: Collection[int] = (),
        *,
        flips: bool = False,
        reach: float = _SHORT,
        unseen: Callable[[Tensor, Tensor], Tensor] | None = None,
        lids: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None,
        outlines: Callable[[Tensor, MeshTopology], Tensor] | None = None,
        outlines_after: int = NEVER,
    ) -> None:
        """Takes the times.

        Args:
            budgets: by iteration, how many faces there may be after it (`optim.schedules.face_budgets`).
            untangle_after: iterations after which faces that cut through others are put right.
            flips: whether edges are flipped where that makes faces less slender, after each subdivision.
            reach: folds in which a vertex would have to move farther stay (`geometry.untangle`). If it is more than a
                half, and that spoils the pictures, a half is tried.
            unseen: of vertices and faces, on the CPU, which vertices no picture shows. Before each untangling they
                become a film (`geometry.films`), but for hollows: regularizers alone leave slits in what nobody sees,
                and deepen them.
            lids: of vertices, faces and their colours, on the CPU, which faces pictures look through. They are removed
                at each edit but the last, before what else it does, or stay where that spoils the pictures.
            outlines: of vertices and how they hang together, on the CPU, where outlines say that vertices belong.
            outlines_after: the iteration after which they are brought there.

        Raises:
            ValueError: iterations or numbers of faces are no whole numbers of at least 1.
        """
        if not isinstance(budgets, Mapping):
            raise ValueError(f"budgets must be numbers of faces by iteration, got {shown(budgets)}")
        times = {check_count("an iteration of budgets", time): faces for time, faces in budgets.items()}
        self._budgets = {time: check_count(f"budgets[{time}]", faces) for time, faces in times.items()}
        self._untangle_after, self._unseen = {check_count("untangle_after", time) for time in untangle_after}, unseen
        self._outlines, self._outlines_after = outlines, NEVER if outlines is None else outlines_after
        self._reaches = (reach, _SHORT) if reach > _SHORT else (reach,)
        self._flips, self._lids = flips, lids
        self._found: dict[int, Tensor | None] = {}

    def start(self, model: TriangleMesh, adam: Adam, views: int, generator: torch.Generator) -> None:
        """Takes a mesh. Raises ValueError for another model."""
        super().start(model_for(self, model, TriangleMesh), adam, views, generator)

    def next_edit(self, iteration: int) -> int:
        """The next of the given times."""
        times = (*self._budgets, *self._untangle_after, self._outlines_after)
        return min((i for i in times if i >= iteration), default=NEVER)

    def attempts(self, iteration: int) -> int:
        """Untangling has one for each reach; the first of all removes lids, if there are any."""
        ways = len(self._reaches) if iteration in self._untangle_after else 1
        return ways + (self._lids_at(iteration) is not None)

    def edit(self, iteration: int) -> bool:
        """Removes lids, goes by outlines, untangles, divides and flips.

        Raises DivergedError where faces have no finite area.
        """
        if self.next_edit(iteration) != iteration:
            return False
        mesh: TriangleMesh = self.model
        if not bool(face_areas(*mesh.surface()).isfinite().all()):
            raise DivergedError(f"the areas of faces are not finite at iteration {iteration}; lower the learning rates")
        lid = self._lids_at(iteration)
        opened = lid is not None and self.undone == 0
        if lid is not None and opened:
            self._remove(lid)
        if self._outlines is not None and iteration == self._outlines_after:
            topology = mesh.topology.to(torch.device("cpu"))
            mesh.vertices.detach().copy_(self._outlines(mesh.vertices.detach().cpu(), topology))
        if iteration in self._untangle_after:
            self._untangle(mesh, self.undone - (lid is not None and not opened))
        self._found.clear()
        if iteration not in self._budgets:
            return opened
        vertices, topology = mesh.vertices.detach().cpu(), mesh.topology.to(torch.device("cpu"))
        plan = longest_edge_plan(vertices, topology, face_areas(vertices, topology.faces), self._budgets[iteration])
        carried = apply_subdivision(plan, self.adam, per_vertex=mesh.vertex_parameters, per_face=mesh.face_parameters)
        faces = plan.faces
        if self._flips:
            vertices = carried["vertices"].detach().cpu()
            faces = flipped(vertices, MeshTopology.from_faces(faces, len(vertices)))
        mesh.load_state({**carried, "faces": faces})
        return True

    def finish(self, model: TriangleMesh) -> None:
        """Untangles it as far as the reach of this attempt goes, if any untangling was asked for."""
        if self._untangle_after:
            self._untangle(model, self.undone)

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Forgets which lids another mesh had."""
        self._found.clear()

    def _untangle(self, model: TriangleMesh, attempt: int) -> None:
        topology, reach = model.topology.to(torch.device("cpu")), self._reaches[attempt]
        with torch.no_grad():
            vertices, faces = model.vertices.detach().cpu(), topology.faces.long()
            if self._unseen is not None:
                vertices = slits_closed(vertices, faces, self._unseen(vertices, faces), _DEEPEST)
            model.vertices.copy_(untangle(vertices, topology, reach=reach)[0])

    def _lids_at(self, iteration: int) -> Tensor | None:
        """(F,) which faces are lids, if any are and it is time to remove them; they are looked for once."""
        times = {*self._budgets, *self._untangle_after}
        if self._lids is None or iteration not in times or iteration == max(times):
            return None
        if iteration not in self._found:
            mesh: TriangleMesh = self.model
            vertices, faces = mesh.surface()
            lid = self._lids(vertices, faces.long(), mesh.display_face_colors.cpu())
            self._found[iteration] = lid if bool(lid.any()) and not bool(lid.all()) else None
        return self._found[iteration]

    def _remove(self, removed: Tensor) -> None:
        mesh: TriangleMesh = self.model
        faces = mesh.faces.cpu().long()
        source, kept, _ = cut_open(faces[~removed], len(mesh.vertices))
        rows = dict.fromkeys(mesh.vertex_parameters, source)
        rows |= dict.fromkeys(mesh.face_parameters, (~removed).nonzero()[:, 0])
        mesh.load_state({**apply_sources(rows, self.adam), "faces": kept})


class HalveWhereWrong(Strategy):
    """Removes those of a mesh's separate triangles, at given times, that are in the way, and halves others.

    Halved are the most wrong, as many as photos of that size carry, whatever the halves may learn, and besides them
    those that photos agree to halve. Each corner is a vertex of its own, before and after: halves that shared the new
    corner would keep its colour and place in common, and fit photos worse (research/ablations.md).
    """

    def __init__(
        self,
        budgets: Mapping[int, int],
        errors: Callable[[TriangleMesh], FaceErrors],
        most_wrong: Mapping[int, int],
    ) -> None:
        """Takes the times.

        Args:
            budgets: by iteration, how many triangles there may be after it (`optim.schedules.face_budgets`).
            errors: what pictures say of each triangle.
            most_wrong: by iteration, how many of the most wrong are halved, beside as many as were removed; none of
                those that photos do not agree to halve in an iteration that is not named.
        """
        self._budgets, self._errors, self._most_wrong = dict(budgets), errors, dict(most_wrong)

    def next_edit(self, iteration: int) -> int:
        """The next of the given times."""
        return min((i for i in self._budgets if i >= iteration), default=NEVER)

    def edit(self, iteration: int) -> bool:
        """Removes and halves them, the latter at the middles of their longest edges."""
        if iteration not in self._budgets:
            return False
        mesh: TriangleMesh = self.model
        errors = self._errors(mesh)
        kept = ~errors.in_the_way
        removed = int(errors.in_the_way.sum()) if bool(kept.any()) else 0
        if removed:
            self._carry_out(RowPlan.keeping(kept.repeat_interleave(3).to(mesh.vertices.device)))
            errors = FaceErrors(errors.wrong[kept], errors.in_the_way[kept], errors.gained[kept])
        wanted = self._most_wrong[iteration] + removed if iteration in self._most_wrong else 0
        chosen = _to_halve(errors, wanted)[: max(self._budgets[iteration] - mesh.count, 0)]
        if len(chosen):
            self._carry_out(halves_plan(mesh.vertices.detach(), mesh.colors.detach(), chosen))
        return removed > 0 or len(chosen) > 0

    def _carry_out(self, plan: RowPlan) -> None:
        """Rows are corners, three of each triangle after the other."""
        parameters, _ = apply_rows(plan, self.adam, {})
        faces = torch.arange(len(plan.source), device=plan.source.device).reshape(-1, 3)
        self.model.load_state({**parameters, "faces": faces})


def _to_halve(errors: FaceErrors, most_wrong: int) -> Tensor:
    """(K,) the most wrong triangles, then those that photos agree to halve, those first by which most is gained."""
    first = errors.wrong.topk(min(most_wrong, int((errors.wrong > 0).sum()))).indices
    gained = errors.gained.clone()
    gained[first] = 0.0
    return torch.cat([first, gained.topk(int((gained > 0).sum())).indices])


@dataclass
class DensifyAndPrune(Strategy):
    """Triangles of a soup multiply and die by Triangle Splatting's rules (`optim/densification.py`).

    Attributes:
        begin: no edit up to this iteration.
        end: from this iteration on triangles only die.
        every: iterations between edits.
        last: no edit from this iteration on, the last of the run.
        max_triangles: no more than these.
        growth: each edit multiplies their number by this, at most.
        replace_dead: triangles that die count in the number that is multiplied, so that all of them are replaced.
        sample_by: what makes a parent likely: its opacity, 1/sigma, or the one and the other in turn.
        split_size: parents larger on screen than this, in pixels, are split into four; others are cloned.
        clone_noise: how far a clone is shifted, as a multiple of the triangle's extent.
        prune: when a triangle dies.
        spared: of which triangles, by their corners, those that no view has seen stay.
        barren: which triangles of the soup do not multiply.

    Raises:
        ValueError: `every` or `growth` below 1, or another word for `sample_by`.

    Example:
        >>> strategy = etsplat.DensifyAndPrune(begin=200, every=50, max_triangles=20_000)
        >>> strategy.max_triangles
        20000
    """

    begin: int = 100
    end: int = NEVER
    every: int = 100
    last: int = NEVER
    max_triangles: int = 100_000
    growth: float = 1.3
    replace_dead: bool = True
    sample_by: Literal["alternate", "opacity", "sharpness"] = "alternate"
    split_size: float = 24.0
    clone_noise: float = 1.5
    prune: PruneRules = field(default_factory=PruneRules)
    spared: Spared | None = None
    barren: Callable[[TriangleSoup], Tensor] | None = None

    outputs = ("statistics",)

    def __post_init__(self) -> None:
        self.every = check_count("every", self.every)
        check_number("growth", self.growth, 1)
        check_choice("sample_by", self.sample_by, ("alternate", "opacity", "sharpness"))

    def start(self, model: TriangleSoup, adam: Adam, views: int, generator: torch.Generator) -> None:
        """Nobody has seen any triangle yet. Raises ValueError for another model than a soup."""
        super().start(model_for(self, model, TriangleSoup), adam, views, generator)
        self.statistics = SoupStatistics.zeros(model.count, model.vertices.device)

    def next_edit(self, iteration: int) -> int:
        """The next multiple of `every`."""
        return -(-iteration // self.every) * self.every

    def edit(self, iteration: int) -> bool:
        """Lets triangles multiply and die, or only die."""
        if iteration % self.every or iteration <= self.begin or iteration >= self.last:
            return False
        if iteration < self.end:
            self.densify(iteration)
        else:
            self._apply(RowPlan.keeping(~self._dead(iteration)))
        return True

    def densify(self, iteration: int) -> None:
        """Removes dead triangles and lets others multiply, whatever the time."""
        soup, dead, by = self.model, self._dead(iteration), self.sample_by
        if by == "alternate":
            by = "opacity" if iteration // self.every % 2 == 0 else "sharpness"
        count = soup.count if self.replace_dead else soup.count - int(dead.sum())
        plan = densify_plan(
            soup.vertices.detach(),
            soup.opacity_logits.detach(),
            soup.sigma.detach(),
            self.statistics.screen_size,
            dead,
            target=grown_count(count, self.growth, self.max_triangles),
            by=by,
            barren=None if self.barren is None else self.barren(soup),
            split_size=self.split_size,
            noise=self.clone_noise,
            generator=self.generator,
        )
        self._apply(plan)

    def observe(self, seen: Rasterization, *, epoch_starts: bool) -> None:
        """Takes in the statistics of a view."""
        assert seen.statistics is not None
        self.statistics.update(seen.statistics, self.views, epoch_starts=epoch_starts)

    def observe_on_device(self, seen: Rasterization, epoch_starts: Tensor, halted: Tensor) -> None:
        """Takes in the statistics of a view."""
        assert seen.statistics is not None
        self.statistics.update_on_device(seen.statistics, self.views, epoch_starts, halted)

    def state(self) -> dict[str, Tensor]:
        """The statistics."""
        return self.statistics.tensors()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Takes the statistics."""
        device = self.model.vertices.device
        self.statistics = SoupStatistics(**{name: tensor.to(device) for name, tensor in state.items()})

    def _dead(self, iteration: int) -> Tensor:
        first = iteration <= self.begin + self.every
        rules = self.prune.limited(views=0 if first else self.views, by_size=iteration < self.end and not first)
        with torch.no_grad():
            dead = dead_triangles(self.model.drawn_opacities, self.statistics, rules, self.views)
        if self.spared is not None:
            dead &= ~(self.spared(self.model.vertices) & (self.statistics.screen_size == 0))
        if bool(dead.all()):
            raise DivergedError(
                f"no triangle is left at iteration {iteration}; lower loss.lambda_opacity and pruning.importance"
            )
        return dead

    def _apply(self, plan: RowPlan) -> None:
        parameters, statistics = apply_rows(plan, self.adam, self.statistics.tensors(), others=self.model.BESIDE)
        self.model.load_state(parameters)
        self.statistics = SoupStatistics(**statistics)
        self.statistics.restart(self.statistics.judged(self.views))
