"""The problem that the loop drives in shape reconstruction: a mesh, its optimizer, and the views it is fitted to."""

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from itertools import takewhile

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.validation import first_not_finite
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import as_float
from etsplat.engines.choice import engine_for
from etsplat.geometry.measures import face_areas
from etsplat.geometry.subdivision import longest_edge_plan
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.untangle import untangle
from etsplat.model.mesh_rendering import render_mesh
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.adam import Adam
from etsplat.optim.edit import apply_subdivision
from etsplat.optim.loop import Progress
from etsplat.optim.objectives import MeshWeights, mesh_objective
from etsplat.optim.schedules import coarse_level, evenly, exponential_decay, face_budgets, regularization_weight
from etsplat.optim.step_queue import MAX_STEPS, QueuedStep, StepQueue
from etsplat.optim.vertex_updates import Solve, laplacian_solver, uniform_step
from etsplat.optim.view_sampler import ViewSampler
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.running import progress_tensor, read_progress


@dataclass(frozen=True)
class _Level:
    cameras: Cameras
    images: Float[Tensor, "B H W 4"]

    @classmethod
    def of(cls, views: Dataset, device: torch.device) -> "_Level":
        cameras = Cameras.stacked(views.cameras).to(device)
        return cls(cameras, torch.stack([as_float(image) for image in views.images]).to(device))


class MeshFitting:
    """One run's state, and what changes it: steps and subdivisions. Implements `optim.loop.Problem`.

    Attributes:
        mesh: the mesh as it is now.
        adam: its optimizer.
    """

    def __init__(
        self,
        mesh: TriangleMesh,
        views: Dataset,
        config: ReconstructConfig,
        evaluate: Callable[[TriangleMesh], dict[str, float]],
    ) -> None:
        """Starts a run.

        Args:
            mesh: the start; changed in place.
            views: what it is fitted to (those in `views.train`).
            config: settings.
            evaluate: cheap metrics of a mesh.
        """
        self.mesh = mesh
        self._config = config
        self._evaluate = evaluate
        self._sampler = ViewSampler(views.train, torch.Generator().manual_seed(config.seed))
        self._rates = {
            "vertices": config.optimizer.lr_vertices,
            "colors": config.optimizer.lr_colors,
            "opacity_logits": config.optimizer.lr_opacities,
            "log_sigma": config.optimizer.lr_sigma if config.optimizer.sigma_final == 0 else 0.0,
        }
        self._weights = MeshWeights(
            edge=config.regularization.lambda_edge,
            normal=config.regularization.lambda_smooth_normal,
            laplacian=config.regularization.lambda_laplacian,
            softness=config.regularization.lambda_sigma,
            edge_power=config.regularization.edge_power,
        )
        self._budgets = face_budgets(
            config.iterations,
            steps=config.refinement.subdivisions,
            first=config.refinement.first,
            last=config.refinement.last,
            start_faces=len(mesh.faces),
            max_faces=config.max_faces,
        )
        self._untanglings = set(evenly(config.iterations, config.refinement.untanglings, config.refinement.last))
        levels = [views]  # halved 0, 1, ... times
        for _ in range(config.pictures.coarse_levels):
            levels.append(levels[-1].halved())
        self._levels = [_Level.of(level, mesh.vertices.device) for level in levels]
        self._solve: Solve | None = None
        parameters = mesh.parameters()
        self.adam = Adam(parameters, {name: self._rates[name] for name in parameters})
        self._queue, self._queued_level = None, self._level(1)
        queueable = (
            config.optimizer.vertex_update == "adam" and config.drawing.backend == "etsplat"
        )  # others need the host in a step
        if queueable and engine_for(mesh.vertices).queues_steps:
            width = 4 * config.batch + 2 + len(parameters) + 1
            self._queue = StepQueue(self._queued_gradients, self._commit, width, mesh.vertices.device)

    @property
    def count(self) -> int:
        """Number of faces."""
        return len(self.mesh.faces)

    def describe(self) -> dict[str, float]:
        """For the log: number of faces and softness (0 for opaque triangles)."""
        return {"faces": self.count, "sigma": float(self.mesh.sigma.detach())}

    def advance(self, first: int, last: int) -> list[float]:
        """Steps with some views over random backgrounds each; on a device many together."""
        if self._queue is None:
            return [self._step(first)]
        stops = [i for i in (*self._budgets, *self._untanglings) if i >= first]
        level = self._level(first)
        if level != self._queued_level:
            self._queued_level = level
            self._queue.restart()
        steps = range(first, min([last, first + MAX_STEPS - 1, *stops]) + 1)
        unchanged = takewhile(lambda i: self._level(i) == level, steps)
        return self._queue.run([QueuedStep(self._row(i)) for i in unchanged])

    def _step(self, iteration: int) -> float:
        views, (chosen, backgrounds) = self._levels[self._level(iteration)], self._draw()
        self._set_sigma(self._log_sigma(iteration))
        target = views.images[chosen[0] : chosen[0] + 1] if len(chosen) == 1 else views.images[chosen]
        backgrounds = backgrounds.to(target.device)
        loss = self._gradients(views.cameras[chosen], target, backgrounds, self._gamma(iteration))
        self._update(iteration)
        return float(loss)

    def _row(self, iteration: int) -> list[float]:
        """What a queued step reads: views, backgrounds, gamma, log sigma, and last the optimizer's rates."""
        chosen, backgrounds = self._draw()
        self.adam.learning_rates["vertices"] = self._vertex_rate(iteration)
        self.adam.step_count += 1
        rates = self.adam.rates(list(self.adam.parameters))
        scheduled = self._gamma(iteration), self._log_sigma(iteration)
        return [*chosen, *backgrounds.reshape(-1).tolist(), *scheduled, *rates]

    def _commit(self, row: Tensor, halted: Tensor) -> None:
        self.adam.step_on_device(row[-len(self.adam.parameters) - 1 :], halted)

    def _queued_gradients(self, row: Tensor, kind: Hashable) -> Tensor:
        views, count = self._levels[self._queued_level], self._config.batch
        chosen, backgrounds = row[:count].long(), row[count : 4 * count].reshape(count, 3)
        viewmats, Ks = (tensor.index_select(0, chosen) for tensor in (views.cameras.viewmats, views.cameras.Ks))
        cameras = replace(views.cameras, viewmats=viewmats, Ks=Ks)
        self._set_sigma(row[4 * count + 1])
        return self._gradients(cameras, views.images.index_select(0, chosen), backgrounds, row[4 * count])

    def _gradients(self, cameras: Cameras, target: Tensor, backgrounds: Tensor, gamma: float | Tensor) -> Tensor:
        """Those of the objective, whose value is returned."""
        config, mesh = self._config, self.mesh
        color = render_mesh(mesh, cameras, config.appearance, backgrounds=backgrounds)
        loss = mesh_objective(color, target, backgrounds, mesh, self._weights, gamma)
        self.adam.zero_grad()
        loss.backward()
        return loss.detach()

    def _draw(self) -> tuple[list[int], Float[Tensor, "B 3"]]:
        """Views and backgrounds of the next step."""
        chosen = [self._sampler.next_view() for _ in range(self._config.batch)]
        return chosen, torch.cat([self._sampler.background() for _ in chosen])

    def _level(self, iteration: int) -> int:
        config = self._config
        return coarse_level(iteration, config.iterations, config.pictures.coarse_levels, config.pictures.coarse_until)

    def _gamma(self, iteration: int) -> float:
        config = self._config
        return regularization_weight(
            iteration, config.iterations, config.regularization.hold, config.regularization.final
        )

    def _log_sigma(self, iteration: int) -> float:
        """Of the schedule; 0 where there is none."""
        config = self._config
        if config.optimizer.sigma_final == 0:
            return 0.0
        fall = exponential_decay(iteration, config.iterations, config.optimizer.sigma_final / config.start.sigma)
        return math.log(config.start.sigma * fall)

    @torch.no_grad()
    def _set_sigma(self, log_sigma: float | Tensor) -> None:
        if self._config.optimizer.sigma_final > 0 and self.mesh.log_sigma is not None:
            self.mesh.log_sigma.fill_(log_sigma)

    def _vertex_rate(self, iteration: int) -> float:
        config = self._config
        return self._rates["vertices"] * exponential_decay(
            iteration, config.iterations, config.optimizer.lr_vertices_final
        )

    def _update(self, iteration: int) -> None:
        config = self._config
        rate = self._vertex_rate(iteration)
        if config.optimizer.vertex_update == "adam":
            self.adam.learning_rates["vertices"] = rate
            self.adam.step()
            return
        if config.optimizer.vertex_update == "large-steps" and self._solve is None:
            self._solve = laplacian_solver(self.mesh.topology, config.optimizer.large_steps_weight)
        uniform_step(self.adam, "vertices", rate, self._solve)

    def refine(self, iteration: int) -> int:
        """Subdivides the largest faces if it is time to (paper, appendix Adaptive Refinement), or untangles."""
        if iteration not in self._untanglings and iteration not in self._budgets:
            return 0
        mesh = self.mesh
        topology = mesh.topology.to(torch.device("cpu"))
        if iteration in self._untanglings:
            # What smoothing takes away later steps bring back, but nothing does after the last.
            reach = 0.5 if iteration == self._config.iterations else math.inf
            with torch.no_grad():
                mesh.vertices.copy_(untangle(mesh.vertices.cpu(), topology, reach=reach)[0])
        if iteration not in self._budgets:
            return 0
        before = len(mesh.faces)
        vertices = mesh.vertices.detach().cpu()
        plan = longest_edge_plan(vertices, topology, face_areas(vertices, topology.faces), self._budgets[iteration])
        carried = apply_subdivision(plan, self.adam, per_vertex=mesh.vertex_parameters, per_face=mesh.face_parameters)
        for name, parameter in carried.items():
            setattr(mesh, name, parameter)
        self._retopologize(plan.faces)
        return len(mesh.faces) - before

    def evaluate(self) -> dict[str, float]:
        """Cheap metrics of the present state."""
        return self._evaluate(self.mesh)

    def first_not_finite(self) -> str | None:
        """The name of a parameter that holds NaN or infinity, or None."""
        return first_not_finite(self.mesh.parameters())

    def state(self, progress: Progress) -> dict[str, Tensor]:
        """Everything that the rest of the run depends on, by name, for a checkpoint."""
        state = {"mesh.faces": self.mesh.faces}
        for name, parameter in self.mesh.parameters().items():
            state[f"mesh.{name}"] = parameter.detach()
            state[f"adam.first.{name}"] = self.adam.first_moments[name]
            state[f"adam.second.{name}"] = self.adam.second_moments[name]
        state["adam.step_count"] = torch.tensor(self.adam.step_count)
        state |= {f"sampler.{name}": tensor for name, tensor in self._sampler.state().items()}
        state["progress"] = progress_tensor(progress)
        return state

    def load_state(self, state: dict[str, Tensor], iteration: int) -> Progress:
        """Continues where `state` was taken; returns where that was."""
        mesh, device = self.mesh, self.mesh.vertices.device
        for name in mesh.parameters():
            parameter, *moments = (state[f"{kind}.{name}"].to(device) for kind in ("mesh", "adam.first", "adam.second"))
            setattr(mesh, name, parameter.requires_grad_(True))
            self.adam.replace(name, parameter, *moments)
        self.adam.step_count = int(state["adam.step_count"])
        self._retopologize(state["mesh.faces"])
        self._sampler.load_state({name: state[f"sampler.{name}"] for name in self._sampler.state()})
        return read_progress(state["progress"], iteration)

    def _retopologize(self, faces: Tensor) -> None:
        mesh = self.mesh
        mesh.topology = MeshTopology.from_faces(faces.to(mesh.vertices.device), len(mesh.vertices))
        self._solve = None
        if self._queue is not None:
            self._queue.restart()
