"""`etsplat eval`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from etsplat.cli.command import Command
from etsplat.tasks.settings import Device

if TYPE_CHECKING:
    from rich.console import Console

_COLUMNS = {
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "ssim_interior": ("SSIM interior", ".4f"),
    "lpips_3dgs": ("LPIPS as 3DGS", ".4f"),
    "lpips": ("LPIPS", ".4f"),
    "psnr_opaque": ("PSNR opaque", ".2f"),
}


@dataclass(frozen=True, kw_only=True)
class Evaluate(Command):
    """Measure a trained soup on the views that training never saw, and how fast it is drawn.

    PSNR; SSIM zero-padded as 3DGS has it, and in the interior; LPIPS in both conventions where its weights are.
    """

    EXAMPLES: ClassVar[str] = """
    etsplat eval runs/kitchen
    etsplat eval runs/kitchen --lpips-weights download
    etsplat eval soup.ply --scene scenes/kitchen --out evaluation
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A run of `etsplat train`; or a file with a soup, with --scene."""
    out: Path | None = None
    """Folder for evaluation.json and pictures side by side; by default the run's, whose report is written anew."""
    scene: Path | None = None
    """The capture's folder, if it has moved or a file is given."""
    device: Device | None = None
    """Where it is drawn: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    lpips_weights: Path | None = None
    """File with LPIPS's weights, or `download`; by default torch's cache is looked into."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Evaluate":
        """Nothing depends on the arguments."""
        return cls(run_dir=tyro.MISSING)

    def run(self, arguments: Sequence[str]) -> int:
        """Measures, writes evaluation.json, pictures and report, prints a table."""
        from rich.console import Console

        from etsplat.cli.phases import PhaseBar
        from etsplat.io.run_directory import RunDirectory, is_run
        from etsplat.report import write_report
        from etsplat.tasks.evaluate_soup import evaluate_run
        from etsplat.tasks.soup_run import open_run

        opened = open_run(self.run_dir, self.scene, self.device)
        folder = RunDirectory(self.out or opened.folder)
        console = Console()
        with PhaseBar(console) as bar:
            found = evaluate_run(
                opened,
                lpips_weights=self.lpips_weights,
                pictures=folder.path / "evaluation",
                progress=lambda done, total: bar.show("Measuring", done, total),
            )
        folder.write_evaluation(found)
        _print(console, found)
        print(f"{folder.evaluation_path}; pictures in {folder.path / 'evaluation'}")
        if is_run(folder.path) and folder.metrics_path.is_file():
            print(write_report(folder.path))
        return 0


def _print(console: "Console", found: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table("view", box=None)
    shown = {key: column for key, column in _COLUMNS.items() if found[key] is not None}
    for title, _ in shown.values():
        table.add_column(title, justify="right")
    for row in [*found["views"], {**found, "name": "mean"}]:
        table.add_row(row["name"], *(f"{row[key]:{form}}" for key, (_, form) in shown.items()))
    console.print(table)
    if found["lpips"] is None and found["lpips_reason"]:
        console.print(f"LPIPS: {found['lpips_reason']}", soft_wrap=True)
    threads = "1 thread" if found["threads"] == 1 else f"{found['threads']} threads"
    console.print(
        f"{found['fps']:.1f} frames/s at {found['width']}x{found['height']}, {found['ms_per_million']:.0f} ms per "
        f"million triangles ({found['triangles']:,} triangles, engine {found['engine']}, {threads})"
    )
