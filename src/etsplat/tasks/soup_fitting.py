"""The problem that the loop drives in novel-view synthesis: a soup, its optimizer, and the photos it is fitted to."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.rasterization import Rasterization
from etsplat.core.validation import first_not_finite
from etsplat.ops.adam import Adam
from etsplat.optim.densification import PruneRules, SoupStatistics, dead_triangles, densify_plan, grown_count
from etsplat.optim.edit import RowPlan, apply_rows
from etsplat.optim.loop import DivergedError, Progress
from etsplat.optim.schedules import exponential_decay, ramp
from etsplat.optim.soup_objective import SoupWeights, soup_objective
from etsplat.optim.view_sampler import ViewSampler
from etsplat.scene.capture_views import CaptureViews
from etsplat.scene.captures import Capture
from etsplat.scene.soup_rendering import SoupAppearance, render_soup
from etsplat.scene.triangle_soup import TriangleSoup
from etsplat.tasks.running import progress_tensor, read_progress
from etsplat.tasks.train_config import TrainConfig

READ_AHEAD = 8
"""Views whose photos are decoded ahead of their turn, where the capture does not fit into memory."""

FINAL_FLOOR, FIRST_CEILING, FINAL_CEILING = 0.995, 1.0, 0.02
FINISH_UNTIL = 0.8
"""The opaque finish: opacities are squeezed above a floor that rises to the first number, and sigma is cut at a ceiling
that falls from the second to the third. Triangles whose own opacity falls below `prune_opacity` meanwhile are removed,
and others multiply in their place. From this fraction of the run on the soup adapts to the result."""

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
        capture: Capture,
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
        self._views = CaptureViews(capture, self._device)
        self._config = config
        self._squared = squared
        self._evaluate = evaluate
        self._sampler = ViewSampler(capture.train, generator)
        self._iteration = 0
        rates = {
            "vertices": config.lr_vertices,
            "opacity_logits": config.lr_opacities,
            "sigma_raw": config.lr_sigma,
            "sh_dc": config.lr_sh_dc,
            "sh_rest": config.lr_sh_rest,
        }
        self.adam = Adam(soup.parameters(), rates, engine=config.engine)

    @property
    def count(self) -> int:
        """Number of triangles."""
        return len(self.soup)

    @property
    def appearance(self) -> SoupAppearance:
        """How the soup is drawn at this iteration."""
        return self._appearance(self._iteration)

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
        """One step, with one view; returns the loss before it."""
        return [self._step(first)]

    def _step(self, iteration: int) -> float:
        config, soup = self._config, self.soup
        self._iteration = iteration
        view = self._sampler.next_view()
        self._views.expect([view, *self._sampler.upcoming(READ_AHEAD)])
        background, camera = self._background().to(self._device), self._views.cameras[view]
        weights, appearance = self._weights(iteration), self._appearance(iteration)
        rendering = render_soup(
            soup,
            camera,
            appearance,
            backgrounds=background,
            median_depth=weights.normal > 0,
            depth="centroid" if weights.normal > 0 or weights.distortion > 0 else None,
            normals=weights.normal > 0,
            distortion=weights.distortion > 0,
            statistics=True,
            engine=config.engine,
        )
        mask = self._views.mask(view)
        loss = soup_objective(
            rendering,
            self._views.photo(view)[None],
            None if mask is None else mask[None].float() / 255,
            background,
            soup.vertices,
            soup.opacities,
            camera,
            weights,
            engine=config.engine,
        )
        self.adam.zero_grad()
        loss.backward()
        decay = exponential_decay(iteration, config.iterations, config.lr_vertices_final)
        self.adam.learning_rates["vertices"] = config.lr_vertices * decay
        self.adam.step()
        self._remember(rendering)
        return float(loss.detach())

    def refine(self, iteration: int) -> int:
        """Densifies or prunes if it is time to; returns by how many triangles the soup grew."""
        config, before = self._config, self.count
        every = config.at(config.densify_every)
        if iteration % every or iteration <= config.at(config.densify_from) or iteration == config.iterations:
            return 0
        if iteration < config.at(config.densify_until):
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
        return read_progress(state["progress"], iteration)

    def _appearance(self, iteration: int) -> SoupAppearance:
        config = self._config
        appearance = SoupAppearance(
            kernel=config.kernel,
            distance=config.distance,
            sh_degree=min(config.sh_degree, iteration // config.at(config.sh_every)),
            cull_small=config.cull_small,
            freeze_incentre=config.freeze_incentre and config.distance == "sdf",
            near_plane=config.near_plane,
        )
        if not self._finishing(iteration):
            return appearance
        done = ramp(iteration, config.at(config.finish_from), self._settled)
        ceiling = FIRST_CEILING * (FINAL_CEILING / FIRST_CEILING) ** done
        return replace(appearance, opacity_floor=FINAL_FLOOR * done, sigma_ceiling=ceiling)

    def _finishing(self, iteration: int) -> bool:
        return self._config.finish == "opaque" and iteration > self._config.at(self._config.finish_from)

    @property
    def _settled(self) -> int:
        """When the opaque finish has made everything opaque and sharp."""
        return round(FINISH_UNTIL * self._config.iterations)

    def _weights(self, iteration: int) -> SoupWeights:
        config = self._config
        regular = iteration > config.at(config.regularize_from)
        return SoupWeights(
            dssim=config.lambda_dssim,
            opacity=0.0 if config.finish == "opaque" else config.lambda_opacity,
            size=config.lambda_size if iteration < config.at(config.densify_until) else 0.0,
            normal=config.lambda_normal if regular else 0.0,
            distortion=config.lambda_distortion if regular else 0.0,
            pixel="l2" if self._squared else "l1",
        )

    def _background(self) -> Float[Tensor, "1 3"]:
        if self._config.background == "random":
            return self._sampler.background()
        return torch.full((1, 3), 1.0 if self._config.background == "white" else 0.0)

    def _remember(self, rendering: Rasterization) -> None:
        assert rendering.statistics is not None
        views = len(self._capture.train)
        self.statistics.update(rendering.statistics, views, epoch_starts=self._sampler.epoch_starts)

    def _dead(self, iteration: int) -> Tensor:
        config = self._config
        first = iteration <= config.at(config.densify_from) + config.at(config.densify_every)
        finishing = self._finishing(iteration)
        densifying = iteration < config.at(config.densify_until)
        limit = config.prune_screen_size if densifying and not first else None
        rules = PruneRules(
            opacity=0.0 if finishing and iteration >= self._settled else config.prune_opacity,
            importance=config.prune_importance,
            views=0 if first else min(config.prune_views, len(self._capture.train)),
            screen_size=float("inf") if limit is None else limit,
        )
        with torch.no_grad():
            dead = dead_triangles(
                self.appearance.opacities(self.soup), self.statistics, rules, len(self._capture.train)
            )
        if bool(dead.all()):
            raise DivergedError(
                f"no triangle is left at iteration {iteration}; lower lambda_opacity or prune_importance"
            )
        return dead

    def _densification(self, iteration: int, dead: Tensor) -> RowPlan:
        config, soup = self._config, self.soup
        even = iteration // config.at(config.densify_every) % 2 == 0
        by = {"opacity": True, "sharpness": False, "alternate": even}[config.sample_by]
        return densify_plan(
            soup.vertices.detach(),
            soup.opacity_logits.detach(),
            soup.sigma.detach(),
            self.statistics.screen_size,
            dead,
            target=grown_count(self.count, config.growth, config.max_triangles),
            by="opacity" if by else "sharpness",
            split_size=config.split_size,
            noise=config.clone_noise,
            generator=self._sampler.generator,
        )

    def _edit(self, plan: RowPlan) -> None:
        parameters, statistics = apply_rows(plan, self.adam, self.statistics.tensors())
        for name, parameter in parameters.items():
            setattr(self.soup, name, parameter)
        self.statistics = SoupStatistics(**statistics)
        self.statistics.restart(self.statistics.judged(len(self._capture.train)))
