"""The problem that the loop drives in shape reconstruction: a mesh, its optimizer, and the views it is fitted to."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from etsplat.core.validation import first_not_finite
from etsplat.geometry.measures import face_areas
from etsplat.geometry.subdivision import longest_edge_plan
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.untangle import untangle
from etsplat.ops.adam import Adam
from etsplat.optim.edit import apply_subdivision
from etsplat.optim.loop import Progress
from etsplat.optim.objectives import MeshWeights, mesh_objective
from etsplat.optim.schedules import coarse_level, evenly, exponential_decay, face_budgets, regularization_weight
from etsplat.optim.vertex_updates import Solve, laplacian_solver, uniform_step
from etsplat.optim.view_sampler import ViewSampler
from etsplat.scene.mesh_rendering import render_mesh
from etsplat.scene.triangle_mesh import TriangleMesh
from etsplat.scene.views import PosedViews
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.running import progress_tensor, read_progress


class MeshFitting:
    """One run's state, and what changes it: steps and subdivisions. Implements `optim.loop.Problem`.

    Attributes:
        mesh: the mesh as it is now.
        adam: its optimizer.
    """

    def __init__(
        self,
        mesh: TriangleMesh,
        views: PosedViews,
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
            "vertices": config.lr_vertices,
            "colors": config.lr_colors,
            "opacity_logits": config.lr_opacities,
            "log_sigma": config.lr_sigma,
        }
        self._weights = MeshWeights(
            edge=config.lambda_edge,
            normal=config.lambda_normal,
            laplacian=config.lambda_laplacian,
            softness=config.lambda_sigma,
            edge_power=config.edge_power,
        )
        self._budgets = face_budgets(
            config.iterations,
            steps=config.subdivide_steps,
            first=config.subdivide_from,
            last=config.subdivide_until,
            start_faces=len(mesh.faces),
            max_faces=config.max_faces,
        )
        self._untanglings = set(evenly(config.iterations, config.untangle_steps, config.subdivide_until))
        self._levels = [views]  # halved 0, 1, ... times
        for _ in range(config.coarse_levels):
            self._levels.append(self._levels[-1].halved())
        self._solve: Solve | None = None
        parameters = mesh.parameters()
        self.adam = Adam(parameters, {name: self._rates[name] for name in parameters}, engine=config.engine)

    @property
    def count(self) -> int:
        """Number of faces."""
        return len(self.mesh.faces)

    def describe(self) -> dict[str, float]:
        """For the log: number of faces and softness (0 for opaque triangles)."""
        return {"faces": self.count, "sigma": float(self.mesh.sigma.detach())}

    def step(self, iteration: int) -> float:
        """Some views over random backgrounds, one optimizer step; returns the loss before it."""
        config, mesh = self._config, self.mesh
        level = coarse_level(iteration, config.iterations, config.coarse_levels, config.coarse_until)
        views = self._levels[level]
        chosen = [self._sampler.next_view() for _ in range(config.views_per_step)]
        backgrounds = torch.cat([self._sampler.background() for _ in chosen])
        self._schedule_sigma(iteration)
        color = render_mesh(mesh, views.cameras[chosen], config.appearance, backgrounds=backgrounds)
        gamma = regularization_weight(iteration, config.iterations, config.gamma_hold, config.gamma_final)
        target = views.images[chosen[0] : chosen[0] + 1] if len(chosen) == 1 else views.images[chosen]
        loss = mesh_objective(color, target, backgrounds, mesh, self._weights, gamma, engine=config.engine)
        self.adam.zero_grad()
        loss.backward()
        self._update(iteration)
        return float(loss.detach())

    def _schedule_sigma(self, iteration: int) -> None:
        config, log_sigma = self._config, self.mesh.log_sigma
        if config.sigma_final > 0 and log_sigma is not None:
            fall = exponential_decay(iteration, config.iterations, config.sigma_final / config.start_sigma)
            with torch.no_grad():
                log_sigma.fill_(math.log(config.start_sigma * fall))
            self.adam.learning_rates["log_sigma"] = 0.0

    def _update(self, iteration: int) -> None:
        config = self._config
        rate = self._rates["vertices"] * exponential_decay(iteration, config.iterations, config.lr_vertices_final)
        if config.vertex_update == "adam":
            self.adam.learning_rates["vertices"] = rate
            self.adam.step()
            return
        if config.vertex_update == "large-steps" and self._solve is None:
            self._solve = laplacian_solver(self.mesh.topology, config.large_steps_weight)
        uniform_step(self.adam, "vertices", rate, self._solve)

    def refine(self, iteration: int) -> int:
        """Subdivides the largest faces if it is time to (paper, appendix Adaptive Refinement), or untangles."""
        if iteration in self._untanglings:
            with torch.no_grad():
                self.mesh.vertices.copy_(untangle(self.mesh.vertices, self.mesh.topology)[0])
        if iteration not in self._budgets:
            return 0
        mesh = self.mesh
        before = len(mesh.faces)
        vertices = mesh.vertices.detach()
        plan = longest_edge_plan(vertices, mesh.topology, face_areas(vertices, mesh.faces), self._budgets[iteration])
        carried = apply_subdivision(plan, self.adam, per_vertex=mesh.vertex_parameters, per_face=mesh.face_parameters)
        for name, parameter in carried.items():
            setattr(mesh, name, parameter)
        mesh.topology = MeshTopology.from_faces(plan.faces, len(mesh.vertices))
        self._solve = None
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
        mesh = self.mesh
        for name in mesh.parameters():
            parameter = state[f"mesh.{name}"].requires_grad_(True)
            setattr(mesh, name, parameter)
            self.adam.replace(name, parameter, state[f"adam.first.{name}"], state[f"adam.second.{name}"])
        self.adam.step_count = int(state["adam.step_count"])
        mesh.topology = MeshTopology.from_faces(state["mesh.faces"], len(mesh.vertices))
        self._sampler.load_state({name: state[f"sampler.{name}"] for name in self._sampler.state()})
        return read_progress(state["progress"], iteration)
