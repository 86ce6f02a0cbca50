"""How drawing, losses and rates of novel-view synthesis change over a run."""

import math
from dataclasses import dataclass, replace

from etsplat.model.soup_rendering import SoupAppearance
from etsplat.optim.schedules import exponential_decay, ramp
from etsplat.optim.soup_objective import SoupWeights
from etsplat.tasks.train_config import TrainConfig

SETTLED = 0.1
"""What is left, at the end of a run, of the learning rates that settle (`lr_settle`)."""

FINAL_FLOOR, OPAQUE_AT = 0.995, 0.2
FIRST_CEILING, FINAL_CEILING, SHARP_FROM, SHARP_AT = 1.0, 0.05, 0.3, 0.95
HIDDEN = 0.005
"""The opaque finish, as fractions of a run: opacities are squeezed above a floor that soon has its final height, so
that most of the run is spent on an opaque soup, while its edges still give wide gradients. Then sigma is cut at a
ceiling that falls. What is hidden meanwhile is removed (its blend weight stays below the last number), and others
multiply in its place. The thresholds of soft soups take too much away (research/ablations.md)."""


@dataclass(frozen=True)
class SoupSchedule:
    """What applies at an iteration of a run.

    Attributes:
        config: settings of the run.
        squared: the pixel loss is L2.
    """

    config: TrainConfig
    squared: bool

    def appearance(self, iteration: int) -> SoupAppearance:
        """How the soup is drawn."""
        appearance, total = self._plain(iteration), self.config.iterations
        if self.config.finish == "none":
            return appearance
        opaque = ramp(iteration, 0, round(OPAQUE_AT * total))
        sharp = ramp(iteration, round(SHARP_FROM * total), round(SHARP_AT * total))
        ceiling = FIRST_CEILING * (FINAL_CEILING / FIRST_CEILING) ** sharp
        return replace(appearance, opacity_floor=FINAL_FLOOR * opaque, sigma_ceiling=ceiling)

    def phase(self, iteration: int) -> tuple[SoupAppearance, SoupWeights]:
        """What changes only a few times in a run: the appearance, without floor and ceiling, and the weights."""
        return self._plain(iteration), self.weights(iteration)

    def weights(self, iteration: int) -> SoupWeights:
        """Of the losses."""
        config = self.config
        regular = iteration > config.at(config.loss.regularize_from)
        return SoupWeights(
            dssim=config.loss.lambda_dssim,
            opacity=0.0 if config.finish == "opaque" else config.loss.lambda_opacity,
            size=config.loss.lambda_size if iteration < config.at(config.densification.end) else 0.0,
            normal=config.loss.lambda_depth_normal if regular else 0.0,
            distortion=config.loss.lambda_distortion if regular else 0.0,
            pixel="l2" if self.squared else "l1",
        )

    def rates(self, iteration: int) -> dict[str, float]:
        """Adam's learning rates, by parameter."""
        config = self.config
        vertices = config.optimizer.lr_vertices * exponential_decay(
            iteration, config.iterations, config.optimizer.lr_vertices_final
        )
        if config.optimizer.lr_vertices_length is not None:
            vertices *= math.sqrt(config.optimizer.lr_vertices_length / config.iterations)
        others = 1.0
        if config.optimizer.lr_settle is not None:
            others = SETTLED ** ramp(iteration, config.at(config.optimizer.lr_settle), config.iterations)
        return {
            "vertices": vertices,
            "opacity_logits": config.optimizer.lr_opacities * others,
            "sigma_raw": config.optimizer.lr_sigma * others,
            "sh_dc": config.optimizer.lr_sh_dc * others,
            "sh_rest": config.optimizer.lr_sh_rest * others,
        }

    @property
    def least_importance(self) -> float:
        """Triangles whose blend weight stays below this are removed."""
        least = self.config.pruning.importance
        return least if self.config.finish == "none" else min(least, HIDDEN)

    @property
    def replaces_dead(self) -> bool:
        """Whether triangles that die count in the number that densification multiplies."""
        return self.config.densification.replace_dead or self.config.finish == "opaque"

    def next_edit(self, iteration: int) -> int:
        """The first iteration, from this one on, after which triangles may come or go."""
        every = self.config.at(self.config.densification.every)
        return -(-iteration // every) * every

    def _plain(self, iteration: int) -> SoupAppearance:
        config = self.config
        return SoupAppearance(
            kernel=config.kernel,
            distance=config.distance,
            sh_degree=min(config.drawing.sh_degree, iteration // config.at(config.schedule.sh_every)),
            cull_small=config.drawing.cull_small,
            cull_large=float("inf") if config.drawing.cull_large is None else config.drawing.cull_large,
            freeze_incentre=config.drawing.freeze_inradius and config.distance == "sdf",
            near_plane=config.drawing.near_plane,
        )
