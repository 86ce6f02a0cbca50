"""`python -m studies.gallery`: one page with the numbers and pictures of reconstructed objects."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from etsplat.cli.command import INTERRUPTED, fail
from etsplat.tasks.reconstruct_config import Preset, ReconstructConfig
from studies.grid.variants import Variant
from studies.objects.study import GridStudy

if TYPE_CHECKING:
    from studies.grid.cells import Cell
    from studies.objects.page import Shown
    from studies.objects.subjects import Subject


@dataclass(frozen=True, kw_only=True)
class Gallery(GridStudy):
    """One page with numbers and pictures of reconstructed objects, the worst first, beside the visual hull alone.

    Examples:
        python -m studies.gallery --inputs data/famous --out runs/gallery
        python -m studies.gallery --inputs data/objects scenes/lego --out runs/gallery --seeds 0 1 2
        python -m studies.gallery --inputs data/objects --out runs/starts --objects mug stool --starts default sphere
    """

    inputs: tuple[Path, ...]
    """Each a folder of mesh files, a capture (transforms*.json or sparse/), or a folder of captures.
    A mesh.obj in a capture is its true surface, in the world of its cameras."""
    preset: Preset = "quick"
    """Settings of all runs."""
    starts: tuple[Literal["default", "sphere", "hull"], ...] = ("default",)
    """What is compared: the preset as it is, or with another start."""

    def run(self, arguments: Sequence[str]) -> int:
        """Runs what is not finished yet, then writes tables and the page."""
        from etsplat.cli.live_table import CHAMFER, conclude
        from studies.grid.cells import make_cells
        from studies.objects.subjects import find_subjects

        where, base = self.where(), self.base()
        subjects = find_subjects(self.inputs, self.objects)
        variants = [Variant(name, {} if name == "default" else {"start.shape": name}) for name in self.starts]
        sources = {subject.name: subject.source for subject in subjects}
        cells = make_cells(sources, variants, base, self.seeds, self.out)
        self.run_cells(cells, where, CHAMFER)
        try:
            self._report(subjects, cells, base, arguments)
        except KeyboardInterrupt:
            fail("interrupted; give the same command to go on", INTERRUPTED)
        return conclude(cells)

    def _report(
        self, subjects: list["Subject"], cells: list["Cell"], base: ReconstructConfig, arguments: Sequence[str]
    ) -> None:
        from studies.objects.page import write_gallery

        done = {cell.object for cell in cells if cell.state == "done"}
        shown = [self._shown(subject, cells, base) for subject in subjects if subject.name in done]
        if not shown:
            return
        failed = [cell for cell in cells if cell.state == "failed"]
        write_gallery(shown, failed, self.out, self.command_line(arguments))
        print((self.out / "results.md").read_text(encoding="utf-8"))
        print(f"{self.out}: gallery.html, results.md, .json; each run under runs/, hulls under hulls/")

    def _shown(self, subject: "Subject", cells: list["Cell"], base: ReconstructConfig) -> "Shown":
        from studies.objects.hulls import hull_of
        from studies.objects.page import Shown
        from studies.objects.quality import rows_of_subject

        hull = hull_of(subject, base, self.out / "hulls" / subject.name)
        return Shown(subject, hull, rows_of_subject(subject, cells, hull, base.output.chamfer_samples))


if __name__ == "__main__":
    Gallery.main()
