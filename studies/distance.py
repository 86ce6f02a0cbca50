"""`python -m studies.distance`: barycentric distance against signed distance."""

from dataclasses import dataclass

from etsplat.tasks.reconstruct_config import METHODS, Method, ReconstructConfig
from studies.grid.variants import Variant, distance_variants
from studies.objects.study import ObjectStudy

SOFT: tuple[Method, ...] = tuple(method for method in METHODS if not method.startswith("raster"))


@dataclass(frozen=True, kw_only=True)
class Distance(ObjectStudy):
    """Barycentric distance against signed distance, for each kernel: the paper says the choice does not matter.

    Examples:
        python -m studies.distance --meshes data/famous --out runs/distance --objects bunny_hr boot
    """

    methods: tuple[Method, ...] = SOFT
    """Which methods; soft ones."""

    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """Both distances for each method."""
        return distance_variants(self.methods)


if __name__ == "__main__":
    Distance.main()
