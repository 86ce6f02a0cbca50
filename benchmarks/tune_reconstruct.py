"""Search for settings of shape reconstruction: settings x meshes at a reduced budget, one CSV row per run.

python -m benchmarks.tune_reconstruct --out runs/tune --meshes ../shared/data/famous/{goathead,bunny_hr}.obj \
    --base resolution=256,iterations=1500 -- "" edge_power=2 lr_vertices={5e-3,1e-2},lr_sigma={1e-3,5e-3}

Each setting is a list of overrides of preset and base; the shell's braces make grids. Rows are written as runs finish,
and a run whose row is there is not repeated, so a search can be stopped and extended. The table at the end gives means
over the meshes, best first. Runs beside each other (--jobs) share the cores: compare their scores, not their seconds.
"""

import argparse
import csv
import multiprocessing
import os
import statistics
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from etsplat.io.run_directory import RunDirectory
from etsplat.ops.engines import set_num_threads
from etsplat.scene.demo_object import demo_object
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import PRESETS, ReconstructConfig

SCORES = ("chamfer", "chamfer_exact", "f_score", "psnr", "psnr_mesh", "self_intersections", "faces", "sigma", "seconds")
COLUMNS = ("mesh", "preset", "setting", *SCORES)


def overridden(config: ReconstructConfig, overrides: str) -> ReconstructConfig:
    """The config with overrides like "lr_vertices=5e-3,edge_power=2", each of the type of what it replaces."""
    changes: dict[str, Any] = {}
    for item in filter(None, overrides.split(",")):
        name, _, value = item.partition("=")
        if not hasattr(config, name) or not value:
            raise SystemExit(f"{item}: not a setting and its value")
        kind = type(getattr(config, name))
        changes[name] = int(float(value)) if kind is int else kind(value)
    return replace(config, **changes)


def run(mesh: str, preset: str, setting: str, folder: Path, threads: int) -> dict[str, Any]:
    """One run; returns its row."""
    set_num_threads(threads)
    source = demo_object() if mesh == "owl" else mesh
    metrics = reconstruct(source, folder, overridden(PRESETS[preset], setting), overwrite=True).metrics
    scores = metrics | {"sigma": RunDirectory(folder).read_history()[-1]["sigma"]}
    return {"mesh": Path(mesh).stem, "preset": preset, "setting": setting} | {name: scores[name] for name in SCORES}


def search(tasks: Iterable[tuple[str, str]], preset: str, out: Path, jobs: int) -> Iterator[dict[str, Any]]:
    """Runs every (mesh, setting), `jobs` at a time, and yields rows as they come."""
    threads = max(1, (os.cpu_count() or 1) // jobs)
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [
            pool.submit(run, mesh, preset, setting, out / "runs" / f"{Path(mesh).stem},{setting}"[:200], threads)
            for mesh, setting in tasks
        ]
        for future in as_completed(futures):
            yield future.result()


def read_rows(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def show(rows: list[dict[str, str]], base: str, console: Console) -> None:
    """Means over the meshes for each setting; Chamfer distances x 1e-3."""
    table = Table("setting", "meshes", "chamfer", "median", "exact", "psnr", "psnr mesh", "self-int. %", "sigma", "s")
    groups: dict[str, list[dict[str, float]]] = {}
    for row in rows:
        groups.setdefault(row["setting"], []).append({name: float(row[name]) for name in SCORES})

    def mean(name: str, group: list[dict[str, float]]) -> float:
        return statistics.fmean(row[name] for row in group)

    for setting, group in sorted(groups.items(), key=lambda item: mean("chamfer", item[1])):
        median = statistics.median(row["chamfer"] for row in group)
        cut = statistics.fmean(row["self_intersections"] / row["faces"] for row in group)
        distances = [mean("chamfer", group), median, mean("chamfer_exact", group)]
        table.add_row(
            setting.removeprefix(base).lstrip(",") or "(base)",
            str(len(group)),
            *(f"{1e3 * distance:.3f}" for distance in distances),
            *(f"{mean(name, group):.2f}" for name in ("psnr", "psnr_mesh")),
            f"{100 * cut:.2f}",
            f"{mean('sigma', group):.3f}",
            f"{mean('seconds', group):.1f}",
        )
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", nargs="+", default=["owl"], help="mesh files; owl is the demo's object")
    parser.add_argument("--preset", choices=list(PRESETS), default="quick")
    parser.add_argument("--base", default="", help="overrides for every setting")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("settings", nargs="+", help='overrides like lr_sigma=1e-3,edge_power=2; "" is the base itself')
    options = parser.parse_args()

    console = Console(width=160)
    path = options.out / "results.csv"
    options.out.mkdir(parents=True, exist_ok=True)
    rows = read_rows(path)
    done = {(row["mesh"], row["preset"], row["setting"]) for row in rows}
    settings = [",".join(filter(None, (options.base, setting))) for setting in options.settings]
    for setting in settings:
        overridden(PRESETS[options.preset], setting)
    tasks = [(mesh, setting) for setting in settings for mesh in options.meshes]
    new = [(mesh, setting) for mesh, setting in tasks if (Path(mesh).stem, options.preset, setting) not in done]
    with open(path, "a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if not rows:
            writer.writeheader()
        for row in search(new, options.preset, options.out, options.jobs):
            writer.writerow(row)
            file.flush()
            setting = row["setting"].removeprefix(options.base)
            console.print(f"{row['mesh']:20} {1e3 * row['chamfer']:8.3f} {row['psnr']:6.2f}  {setting}")
    stems = {Path(mesh).stem for mesh in options.meshes}
    wanted = [row for row in read_rows(path) if row["mesh"] in stems and row["preset"] == options.preset]
    show([row for row in wanted if row["setting"] in settings], options.base, console)


if __name__ == "__main__":
    main()
