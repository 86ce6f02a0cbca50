"""`python -m studies.settings`: any settings of `etsplat reconstruct` against each other."""

from dataclasses import dataclass

from etsplat.tasks.reconstruct_config import ReconstructConfig
from studies.grid.variants import Variant, setting_variants
from studies.objects.study import ObjectStudy


@dataclass(frozen=True, kw_only=True)
class Settings(ObjectStudy):
    """Any settings against each other: for ablations, and to look for better ones.

    Examples:
        python -m studies.settings --meshes data/famous --out runs/rates --settings "" optimizer.lr_vertices=5e-3
        python -m studies.settings --meshes data/famous --out colors --preset quick --settings "" drawing.colors=vertex
    """

    settings: tuple[str, ...]
    """Each a list of changes such as iterations=900,optimizer.lr_vertices=5e-3; "" is the preset itself."""

    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """One for each setting."""
        return setting_variants(base, self.settings)


if __name__ == "__main__":
    Settings.main()
