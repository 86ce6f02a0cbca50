"""`python -m studies.settings`: any settings of `etsplat reconstruct` against each other."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import tyro

from etsplat.tasks.reconstruct_config import ReconstructConfig
from studies.grid.variants import Variant, setting_variants
from studies.objects.study import ObjectStudy


@dataclass(frozen=True, kw_only=True)
class Settings(ObjectStudy):
    """Any settings against each other: for ablations, and to look for better ones."""

    EXAMPLES: ClassVar[str] = """
    python -m studies.settings --meshes data/famous --out runs/rates --settings "" optimizer.lr_vertices=5e-3
    python -m studies.settings --meshes data/famous --out runs/colors --preset quick --settings "" drawing.colors=vertex
    """

    settings: tuple[str, ...]
    """Each a list of changes such as iterations=900,optimizer.lr_vertices=5e-3; "" is the preset itself."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Settings":
        """Nothing depends on the arguments."""
        return cls(meshes=tyro.MISSING, out=tyro.MISSING, settings=tyro.MISSING)

    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """One for each setting."""
        return setting_variants(base, self.settings)


if __name__ == "__main__":
    Settings.main()
