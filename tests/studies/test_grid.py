"""Grids of runs: what is compared, that nothing is done twice, and that the tables say what the runs came to."""

import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import save_mesh
from etsplat.io.run_directory import RunDirectory
from etsplat.tasks.reconstruct_config import METHODS, ReconstructConfig
from etsplat.tasks.sweeps.cells import run_cells
from etsplat.tasks.sweeps.places import Where
from etsplat.tasks.sweeps.work import wait_for_writer
from studies.famous import Famous
from studies.grid.cells import Cell, make_cells
from studies.grid.variants import (
    Variant,
    distance_variants,
    find_meshes,
    method_variants,
    regularizer_variants,
    setting_variants,
)
from studies.nvs import Nvs
from studies.objects import paper
from studies.objects.pictures import draw_qualitative, plot_convergence
from studies.objects.results import rows_of, summarize
from studies.objects.tables import write_tables
from studies.study import Study

REPOSITORY = Path(__file__).resolve().parents[2]
SHORT = ReconstructConfig.tiny().changed(
    {"iterations": 30, "output.evaluate_every": 10, "output.chamfer_samples": 2000}
)
VARIANTS = [Variant("elastic", {}), Variant("raster-face", {"method": "raster-face"})]


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mesh file."""
    vertices, faces = icosphere(2)
    path = tmp_path_factory.mktemp("meshes") / "ball.ply"
    save_mesh(path, 3 * vertices, faces)
    return path


@pytest.fixture(scope="module")
def grid(sphere: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Cell]]:
    """Two objects, one of them unreadable, and two methods, run by two processes."""
    folder = tmp_path_factory.mktemp("grid")
    shutil.copy(sphere, folder)
    (folder / "broken.obj").write_text("v 0 0 0\n")
    cells = make_cells(find_meshes(folder, ()), VARIANTS, SHORT, [0], folder / "out")[:3]  # a process costs seconds
    run_cells(cells, Where(jobs=2), lambda: None)
    return folder, cells


def test_runs_end_and_failures_are_told(grid: tuple[Path, list[Cell]]) -> None:
    """The good mesh is done for both methods; the bad one failed in one line that names it, and harmed nothing."""
    states = {(cell.object, cell.variant): cell.state for cell in grid[1]}
    assert states == {
        ("ball", "elastic"): "done",
        ("ball", "raster-face"): "done",
        ("broken", "elastic"): "failed",
    }
    assert all("broken.obj" in cell.error and "\n" not in cell.error for cell in grid[1] if cell.state == "failed")


GRID = """
import signal
from pathlib import Path

from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sweeps.cells import run_cells
from etsplat.tasks.sweeps.places import Where
from studies.grid.cells import make_cells
from studies.grid.variants import Variant

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in a shell's background
config = ReconstructConfig.tiny().changed({"iterations": 1_000_000, "output.checkpoint_every": 0})
cells = make_cells({"ball": Path("demo:owl")}, [Variant("long", {})], config, [0], Path())
run_cells(cells, Where(jobs=1), lambda: print(cells[0].state, flush=True))
"""
"""A program that runs a grid, of one cell, in the folder where it is started, and says how that stands."""


def start_grid(folder: Path, *, start_new_session: bool = False) -> subprocess.Popen[str]:
    """The program, started in a folder."""
    (folder / "grid.py").write_text(GRID)
    return subprocess.Popen(
        [sys.executable, "grid.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, [REPOSITORY, *sys.path]))},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=start_new_session,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_runs_are_interrupted_when_the_grid_is(number: signal.Signals, tmp_path: Path) -> None:
    """Also when it is killed: the worker saves a checkpoint and ends, and says nothing."""
    process = start_grid(tmp_path)
    folder = tmp_path / "runs" / "ball" / "long"
    wait_until(lambda: (folder / "history.jsonl").exists())
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    wait_for_writer(folder)
    assert [path.suffix for path in (folder / "checkpoints").iterdir()] == [".safetensors"]  # whole
    assert errors.count("Traceback") == (1 if number == signal.SIGINT else 0)  # of the program above


def test_an_interrupt_while_processes_start_is_quiet(tmp_path: Path) -> None:
    """Ctrl-C in a terminal reaches a worker too, which takes seconds to start; it ends without a word."""
    process = start_grid(tmp_path, start_new_session=True)
    assert process.stdout is not None
    process.stdout.readline()
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert errors.count("Traceback") == 1  # of the program above
    assert not list(tmp_path.glob("runs/ball/long/checkpoints/*"))
    assert "Traceback" not in (tmp_path / "runs" / "ball" / "long.log").read_text()


def test_a_run_whose_folder_is_removed_fails_in_one_line(
    sphere: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """And nothing is said on the terminal but by whoever started the grid."""
    config = SHORT.changed({"output.checkpoint_every": 1, "iterations": 1_000_000})
    cells = make_cells({"ball": sphere}, VARIANTS[:1], config, [0], tmp_path / "out")

    def remove() -> None:
        if (cells[0].folder / "history.jsonl").exists():
            (tmp_path / "out").rename(tmp_path / "gone")  # at once: a worker makes files while they are deleted

    run_cells(cells, Where(jobs=1), remove)
    assert cells[0].state == "failed"
    assert "cannot write" in cells[0].error
    assert capfd.readouterr().err == ""


def wait_until(happened: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_file_where_the_grid_goes_is_named(sphere: Path) -> None:
    """Before any process is started."""
    with pytest.raises(InputError, match=r"cannot write .*ball\.ply/.*a part of the path is a file"):
        run_cells(make_cells({"ball": sphere}, VARIANTS, SHORT, [0], sphere), Where(jobs=1), lambda: None)


def test_a_grid_of_nothing_is_refused() -> None:
    """As `--seeds` without a number asks for."""
    with pytest.raises(InputError, match="nothing to run"):
        run_cells([], Where(), lambda: None)


@pytest.mark.parametrize(("study", "source"), [(Famous, "--meshes"), (Nvs, "--scenes")])
def test_a_negative_number_of_jobs_is_named(study: type[Study], source: str, tmp_path: Path) -> None:
    """Before anything is read. 0 asks for one on each core."""
    with pytest.raises(InputError, match="jobs: is -2; it must be at least 1, or 0 for one on each core"):
        study.parse([source, "none", "--out", str(tmp_path), "--jobs", "-2"]).run([])


def test_a_run_of_an_earlier_version_is_named(tmp_path: Path) -> None:
    """One in which config.json does not say how long the run is, before any process is started."""
    cells = make_cells({"ball": Path("demo:owl")}, VARIANTS, SHORT, [0], tmp_path)
    run = RunDirectory.create(cells[1].folder, {"task": "reconstruct", "config": {}})
    run.append_history({"iteration": 3})
    with pytest.raises(InputError, match=r"config\.json: an earlier version .* lacks `iterations`; remove the folder"):
        run_cells(cells, Where(jobs=1), lambda: None)
    assert [cell.state for cell in cells] == ["waiting", "waiting"]


def test_finished_runs_are_not_repeated(grid: tuple[Path, list[Cell]]) -> None:
    """A second grid over the same folder finds its runs done; with another setting they are not taken for its own."""
    folder, _ = grid
    meshes = find_meshes(folder, ["ball"])
    assert [cell.state for cell in make_cells(meshes, VARIANTS, SHORT, [0], folder / "out")] == ["done", "done"]
    other = make_cells(meshes, VARIANTS, SHORT.changed({"optimizer.lr_colors": 0.5}), [0], folder / "out")
    assert [cell.state for cell in other] == ["waiting", "waiting"]


def test_tables_hold_the_runs(grid: tuple[Path, list[Cell]], tmp_path: Path) -> None:
    """Every file is written; JSON has the runs' own metrics, the command and the commit; failed runs are left out."""
    rows = rows_of(grid[1])
    assert [row["object"] for row in rows] == ["ball", "ball"]
    write_tables(rows, ["elastic", "raster-face"], tmp_path, "python -m studies.famous ...")
    document = json.loads((tmp_path / "results.json").read_text())
    assert document["command"] == "python -m studies.famous ..."
    assert document["rows"][0]["chamfer"] == grid[1][0].metrics()["chamfer"]
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 3
    assert "| ball | " in (tmp_path / "results.md").read_text()
    assert r"\toprule" in (tmp_path / "results.tex").read_text()


def test_figures_are_drawn(grid: tuple[Path, list[Cell]], tmp_path: Path) -> None:
    """Convergence and reconstructions of the finished runs."""
    names = [variant.name for variant in VARIANTS]
    plot_convergence(grid[1], names, tmp_path / "convergence.png")
    draw_qualitative(grid[1], names, tmp_path / "qualitative.png")
    assert (tmp_path / "convergence.png").stat().st_size > 10_000
    assert (tmp_path / "qualitative.png").stat().st_size > 10_000


def test_a_summary_counts_means_medians_and_wins() -> None:
    """Three objects, two variants, two seeds of one object."""

    def row(name: str, variant: str, chamfer: float, seed: int = 0) -> dict[str, object]:
        rest = dict.fromkeys(("chamfer_exact", "f_score", "psnr", "psnr_mesh", "ssim", "lpips"))
        counts = {"degenerate_faces": 1, "self_intersections": 5, "faces": 100, "seconds": 2.0}
        return {"object": name, "variant": variant, "seed": seed, "chamfer": 1e-3 * chamfer, **rest, **counts}

    rows = [row("a", "x", 1), row("b", "x", 2), row("c", "x", 9), row("a", "y", 3), row("b", "y", 1)]
    rows += [row("c", "y", 4, seed=0), row("c", "y", 6, seed=1)]
    x, y = summarize(rows, ["x", "y"])
    assert (x.chamfer, x.chamfer_median, x.wins, x.spread) == (pytest.approx(4), pytest.approx(2), 1, None)
    assert (y.chamfer, y.chamfer_median, y.wins) == (pytest.approx(3), pytest.approx(3), 2)
    assert y.spread == pytest.approx(statistics.stdev([4, 6]))
    assert (y.degenerate_faces, y.self_intersecting) == (4, pytest.approx(5.0))
    assert x.psnr is None


def test_the_papers_numbers_are_typed_right() -> None:
    """The means over its 21 objects are those of its table famous; the ten shared ones have the known mean 0.19."""
    assert len(paper.OBJECTS) == 21
    for variant, (_, _, _, mean) in paper.SUMMARY.items():
        values = [paper.paper_chamfer(name, variant) for name in paper.OBJECTS]
        assert statistics.fmean(value for value in values if value is not None) == pytest.approx(mean, abs=6e-4)
    assert paper.paper_chamfer("house", "elastic 0.0001") == 5.488
    assert paper.paper_chamfer("owl", "elastic 0.0001") is None


def test_the_variants_are_the_papers_rows() -> None:
    """Six methods at two weights make the eight columns of famous_cd; regularizers change one weight at a time."""
    names = [variant.name for variant in method_variants(METHODS, (1e-3, 1e-4))]
    assert set(names) == set(paper.COLUMNS)
    base = ReconstructConfig.study()
    weights = ("lambda_edge", "lambda_smooth_normal", "lambda_laplacian")
    for variant in regularizer_variants(base):
        config = variant.config(base, seed=3)
        ours, before = config.regularization, base.regularization
        assert sum(getattr(ours, name) != getattr(before, name) for name in weights) == (variant.name != "1x")
        assert config.seed == 3
    assert {variant.config(base, 0).drawing.distance for variant in distance_variants(["elastic"])} == {
        "barycentric",
        "sdf",
    }
    changed = setting_variants(base, ["", "optimizer.lr_vertices=5e-3,max_faces=2e4,drawing.colors=vertex"])[1].config(
        base, 0
    )
    assert (changed.optimizer.lr_vertices, changed.max_faces, changed.drawing.colors) == (5e-3, 20_000, "vertex")


def test_wrong_requests_are_input_errors(tmp_path: Path) -> None:
    """Unknown methods, settings, values, meshes and folders are named."""
    base = ReconstructConfig.study()
    for setting, message in (("hue=red", "hue"), ("optimizer.lr_vertices=fast", "fast"), ("seed", "NAME=VALUE")):
        with pytest.raises(InputError, match=message):
            setting_variants(base, [setting])[0].config(base, 0)
    with pytest.raises(InputError, match="gaussian"):
        method_variants(["gaussian"], [1e-3])
    with pytest.raises(InputError, match="data download famous"):
        find_meshes(tmp_path / "nothing", ())
    with pytest.raises(InputError, match="no mesh files"):
        find_meshes(tmp_path, ())
    with pytest.raises(InputError, match="named twice"):
        make_cells({}, [VARIANTS[0], VARIANTS[0]], base, [0], tmp_path)
