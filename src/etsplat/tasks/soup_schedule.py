"""How drawing, losses and rates of novel-view synthesis change over a run."""

from dataclasses import dataclass, replace

from etsplat.optim.schedules import exponential_decay, ramp
from etsplat.optim.soup_objective import SoupWeights
from etsplat.scene.soup_rendering import SoupAppearance
from etsplat.tasks.train_config import TrainConfig

FINAL_FLOOR, FIRST_CEILING, FINAL_CEILING = 0.995, 1.0, 0.02
FINISH_UNTIL = 0.8
"""The opaque finish: opacities are squeezed above a floor that rises to the first number, and sigma is cut at a ceiling
that falls from the second to the third. Triangles whose own opacity falls below `prune_opacity` meanwhile are removed,
and others multiply in their place. From this fraction of the run on the soup adapts to the result."""


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
        appearance = self._plain(iteration)
        if not self.finishing(iteration):
            return appearance
        done = ramp(iteration, self.config.at(self.config.finish_from), self.settled)
        ceiling = FIRST_CEILING * (FINAL_CEILING / FIRST_CEILING) ** done
        return replace(appearance, opacity_floor=FINAL_FLOOR * done, sigma_ceiling=ceiling)

    def phase(self, iteration: int) -> tuple[SoupAppearance, SoupWeights]:
        """What changes only a few times in a run: the appearance, without floor and ceiling, and the weights."""
        return self._plain(iteration), self.weights(iteration)

    def weights(self, iteration: int) -> SoupWeights:
        """Of the losses."""
        config = self.config
        regular = iteration > config.at(config.regularize_from)
        return SoupWeights(
            dssim=config.lambda_dssim,
            opacity=0.0 if config.finish == "opaque" else config.lambda_opacity,
            size=config.lambda_size if iteration < config.at(config.densify_until) else 0.0,
            normal=config.lambda_normal if regular else 0.0,
            distortion=config.lambda_distortion if regular else 0.0,
            unseen=not config.closed,
            pixel="l2" if self.squared else "l1",
        )

    def vertex_rate(self, iteration: int) -> float:
        """Adam's learning rate of positions."""
        config = self.config
        return config.lr_vertices * exponential_decay(iteration, config.iterations, config.lr_vertices_final)

    def finishing(self, iteration: int) -> bool:
        """Whether triangles are being made opaque and sharp."""
        return self.config.finish == "opaque" and iteration > self.config.at(self.config.finish_from)

    @property
    def settled(self) -> int:
        """When the opaque finish has made everything opaque and sharp."""
        return round(FINISH_UNTIL * self.config.iterations)

    def next_edit(self, iteration: int) -> int:
        """The first iteration, from this one on, after which triangles may come or go."""
        every = self.config.at(self.config.densify_every)
        return -(-iteration // every) * every

    def _plain(self, iteration: int) -> SoupAppearance:
        config = self.config
        return SoupAppearance(
            kernel=config.kernel,
            distance=config.distance,
            sh_degree=min(config.sh_degree, iteration // config.at(config.sh_every)),
            cull_small=config.cull_small,
            freeze_incentre=config.freeze_incentre and config.distance == "sdf",
            near_plane=config.near_plane,
        )
