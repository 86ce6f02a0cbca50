"""`python -m studies.famous`: the paper's tables famous and famous_cd."""

from dataclasses import dataclass

from etsplat.tasks.reconstruct_config import METHODS, Method, ReconstructConfig
from studies.grid.variants import LAMBDA_SIGMAS, Variant, method_variants
from studies.objects.study import ObjectStudy


@dataclass(frozen=True, kw_only=True)
class Famous(ObjectStudy):
    """The paper's tables famous and famous_cd: every method on every mesh, with the paper's numbers beside ours.

    Examples:
        python -m studies.famous --meshes data/famous --out runs/famous
        python -m studies.famous --meshes data/famous --out runs/famous --methods elastic bilateral --preset paper
        python -m studies.famous --meshes data/famous --out runs/seeds --objects bunny_hr --seeds 0 1 2
    """

    methods: tuple[Method, ...] = METHODS
    """Which methods."""
    lambda_sigmas: tuple[float, ...] = LAMBDA_SIGMAS
    """Weights of sigma^-2 at which the soft methods are run."""

    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """Soft methods at every weight, opaque ones once."""
        return method_variants(self.methods, self.lambda_sigmas)


if __name__ == "__main__":
    Famous.main()
