"""`etsplat bench ...`: the paper's studies of shape reconstruction, as grids of runs."""

import shlex
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from etsplat.bench.variants import (
    LAMBDA_SIGMAS,
    SUBSET,
    Variant,
    distance_variants,
    find_meshes,
    method_variants,
    regularizer_variants,
    setting_variants,
)
from etsplat.cli.command import FAILED, INTERRUPTED, Command, fail
from etsplat.tasks.reconstruct_config import METHODS, PRESETS, Method, Preset, ReconstructConfig

SOFT: tuple[Method, ...] = tuple(method for method in METHODS if not method.startswith("raster"))


@dataclass(frozen=True, kw_only=True)
class _Grid(Command):
    """What all grids have in common."""

    meshes: Path
    """Folder of mesh files, such as the paper's (`etsplat data download famous`)."""
    out: Path
    """Folder for the runs, tables and figures; a grid that was interrupted goes on where it was."""
    objects: tuple[str, ...] = ()
    """Names of the meshes, without suffix; all in the folder if none is named."""
    preset: Preset = "study"
    """Settings of all runs; what is compared is changed on top of it."""
    set: str = ""
    """More changes for all runs, such as resolution=256,iterations=1500."""
    seeds: tuple[int, ...] = (0,)
    """Each run is repeated with each of them."""
    jobs: Annotated[int, tyro.conf.arg(help_behavior_hint="(default: one for each core)")] = 0
    """Runs beside each other; 0 for one on each core. They share the cores evenly."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "_Grid":
        """Nothing depends on the arguments."""
        return cls(meshes=tyro.MISSING, out=tyro.MISSING)

    @abstractmethod
    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """What is compared."""

    def run(self, arguments: Sequence[str]) -> int:
        """Runs what is not finished yet, then writes tables and figures."""
        from rich.console import Console

        from etsplat.bench.grid import count_jobs, make_cells, run_grid
        from etsplat.bench.live import LiveTable

        jobs = count_jobs(self.jobs)
        base = setting_variants(PRESETS[self.preset], [self.set])[0].config(PRESETS[self.preset], 0)
        variants = self.variants(base)
        cells = make_cells(find_meshes(self.meshes, self.objects), variants, base, self.seeds, self.out)
        try:
            with LiveTable(Console(), cells) as table:
                run_grid(cells, jobs, table.update)
        except KeyboardInterrupt:
            fail("interrupted; give the same command to go on", INTERRUPTED)
        self._report(cells, [variant.name for variant in variants], arguments)
        failed = [cell for cell in cells if cell.state == "failed"]
        for cell in failed:
            print(f"{cell.object}, {cell.variant}: failed: {cell.error}")
        return FAILED if failed else 0

    def _report(self, cells: list, variants: list[str], arguments: Sequence[str]) -> None:
        from etsplat.bench.figures import draw_qualitative, plot_convergence
        from etsplat.bench.results import rows_of
        from etsplat.bench.tables import write_tables

        rows = rows_of(cells)
        if not rows:
            return
        write_tables(rows, variants, self.out, shlex.join(["etsplat", *arguments]))
        plot_convergence(cells, variants, self.out / "convergence.png")
        draw_qualitative(cells, variants, self.out / "qualitative.png")
        print((self.out / "results.md").read_text(encoding="utf-8"))
        print(f"{self.out}: results.md, .csv, .json, .tex, convergence.png, qualitative.png; each run under runs/")


@dataclass(frozen=True, kw_only=True)
class Famous(_Grid):
    """The paper's tables famous and famous_cd: every method on every mesh, with the paper's numbers beside ours."""

    EXAMPLES: ClassVar[str] = """
    etsplat bench famous --meshes data/famous --out runs/famous
    etsplat bench famous --meshes data/famous --out runs/famous --methods elastic bilateral --preset paper
    etsplat bench famous --meshes data/famous --out runs/seeds --objects bunny_hr --seeds 0 1 2
    """

    methods: tuple[Method, ...] = METHODS
    """Which methods."""
    lambda_sigmas: tuple[float, ...] = LAMBDA_SIGMAS
    """Weights of sigma^-2 at which the soft methods are run."""

    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """Soft methods at every weight, opaque ones once."""
        return method_variants(self.methods, self.lambda_sigmas)


@dataclass(frozen=True, kw_only=True)
class Regularizers(_Grid):
    """The paper's table reg_ablation: one weight of the mesh energies at a time at 0.1, 1 and 10 times its value."""

    EXAMPLES: ClassVar[str] = """
    etsplat bench regularizers --meshes data/famous --out runs/regularizers
    """

    objects: tuple[str, ...] = SUBSET
    """Names of the meshes, without suffix. The paper does not say which it used."""

    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """Seven: the preset, and three weights at 0.1 and 10 times."""
        return regularizer_variants(base)


@dataclass(frozen=True, kw_only=True)
class Distance(_Grid):
    """Barycentric distance against signed distance, for each kernel: the paper says the choice does not matter."""

    EXAMPLES: ClassVar[str] = """
    etsplat bench distance --meshes data/famous --out runs/distance --objects bunny_hr boot
    """

    methods: tuple[Method, ...] = SOFT
    """Which methods; soft ones."""

    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """Both distances for each method."""
        return distance_variants(self.methods)


@dataclass(frozen=True, kw_only=True)
class Settings(_Grid):
    """Any settings against each other: for ablations, and to look for better ones."""

    EXAMPLES: ClassVar[str] = """
    etsplat bench settings --meshes data/famous --out runs/rates --settings "" lr_vertices=5e-3 lr_vertices=2e-2
    etsplat bench settings --meshes data/famous --out runs/colors --preset quick --settings "" colors=vertex
    """

    settings: tuple[str, ...]
    """Each a list of changes such as lr_vertices=5e-3,edge_power=2; "" is the preset itself."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Settings":
        """Nothing depends on the arguments."""
        return cls(meshes=tyro.MISSING, out=tyro.MISSING, settings=tyro.MISSING)

    def variants(self, base: ReconstructConfig) -> list[Variant]:
        """One for each setting."""
        return setting_variants(base, self.settings)
