"""`python -m studies.figures NAME`: the paper's explanatory figures, computed."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from etsplat.core.errors import InputError
from studies.study import Study

Name = Literal["kernels", "edges", "soft-triangle", "axes", "dead-zone", "growth", "scene-growth", "teaser"]

_MOVING = ("growth", "scene-growth")


@dataclass(frozen=True, kw_only=True)
class Figures(Study):
    """Draw a figure of the paper from the code itself.

    kernels: G(x) and its slope for several sigma. edges: the seam between two faces. soft-triangle: one triangle and
    the level sets of x. axes: the table of kernel properties. dead-zone: from how far each kernel pulls a triangle
    back. growth: the built-in owl from a sphere, moving, while it is reconstructed. scene-growth: the
    built-in scene from points, likewise, beside what a camera sees there. teaser: from the sphere to a reconstruction,
    and from points to a scene, of finished runs.

    Examples:
        python -m studies.figures kernels
        python -m studies.figures dead-zone --out dead_zone.pdf
        python -m studies.figures growth --out docs/images/growth.webp
        python -m studies.figures scene-growth --out docs/images/scene_growth.webp
        python -m studies.figures teaser --runs runs/bunny runs/kitchen
    """

    name: tyro.conf.Positional[Name]
    """Which figure."""
    out: Path | None = None
    """File to write, .png, .pdf or .svg, of what moves .webp; NAME.png or NAME.webp if not given."""
    runs: tuple[Path, ...] = ()
    """Finished runs of `etsplat reconstruct` and `train` that the teaser shows."""

    def run(self, arguments: Sequence[str]) -> int:
        """Draws it."""
        from etsplat.io.atomic import atomic_write
        from etsplat.io.paths import kind_of

        kinds = (".webp",) if self.name in _MOVING else (".png", ".pdf", ".svg")
        path = self.out or Path(f"{self.name}{kinds[0]}")
        if kind_of(path) not in kinds:
            raise InputError(f"{path}: unknown kind of picture; end the name in {' or '.join(kinds)}")
        if self.name == "teaser" and not self.runs:
            raise InputError("teaser: needs finished runs to show; name their folders with --runs")
        with atomic_write(path) as temporary:
            self._draw(temporary, kind_of(path))
        print(path)
        return 0

    def _draw(self, path: Path, kind: str) -> None:
        from studies.drawings.growth import save_growth, watch_growth, watch_scene
        from studies.drawings.kernels import FIGURES
        from studies.drawings.teaser import draw_teaser

        if self.name in _MOVING:
            save_growth(path, watch_growth() if self.name == "growth" else watch_scene())
            return
        figure = draw_teaser(self.runs) if self.name == "teaser" else FIGURES[self.name]()
        figure.savefig(path, dpi=150, format=kind[1:])


if __name__ == "__main__":
    Figures.main()
