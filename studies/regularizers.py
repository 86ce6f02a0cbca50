"""`python -m studies.regularizers`: the paper's table reg_ablation."""

from dataclasses import dataclass

from etsplat.tasks.reconstruct_config import ReconstructConfig
from studies.grid.variants import SUBSET, Variant, regularizer_variants
from studies.objects.study import ObjectStudy


@dataclass(frozen=True, kw_only=True)
class Regularizers(ObjectStudy):
    """The paper's table reg_ablation: one weight of the mesh energies at a time at 0.1, 1 and 10 times its value.

    Examples:
        python -m studies.regularizers --meshes data/famous --out runs/regularizers
    """

    objects: tuple[str, ...] = SUBSET
    """Names of the meshes, without suffix. The paper does not say which it used."""

    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """Seven: the preset, and three weights at 0.1 and 10 times."""
        return regularizer_variants(base)


if __name__ == "__main__":
    Regularizers.main()
