"""Grids of runs: what is compared, that nothing is done twice, and that the tables say what the runs came to."""

import json
import statistics
from dataclasses import replace
from pathlib import Path

import pytest

from etsplat.bench import paper
from etsplat.bench.figures import draw_qualitative, plot_convergence
from etsplat.bench.grid import Cell, make_cells, run_grid
from etsplat.bench.results import rows_of, summarize
from etsplat.bench.tables import write_tables
from etsplat.bench.variants import (
    Variant,
    distance_variants,
    find_meshes,
    method_variants,
    regularizer_variants,
    setting_variants,
)
from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import save_mesh
from etsplat.tasks.reconstruct_config import METHODS, PRESETS

SHORT = replace(PRESETS["tiny"], iterations=30, evaluate_every=10, chamfer_samples=2000)
VARIANTS = [Variant("elastic", {}), Variant("raster-face", {"method": "raster-face"})]


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Cell]]:
    """Two objects, one of them unreadable, and two methods, run by two processes."""
    folder = tmp_path_factory.mktemp("grid")
    vertices, faces = icosphere(2)
    save_mesh(folder / "ball.ply", 3 * vertices, faces)
    (folder / "broken.obj").write_text("v 0 0 0\n")
    cells = make_cells(find_meshes(folder, ()), VARIANTS, SHORT, [0], folder / "out")[:3]  # a process costs seconds
    run_grid(cells, 2, lambda: None)
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


def test_a_grid_of_nothing_is_refused() -> None:
    """As `--seeds` without a number asks for."""
    with pytest.raises(InputError, match="nothing to run"):
        run_grid([], 1, lambda: None)


def test_finished_runs_are_not_repeated(grid: tuple[Path, list[Cell]]) -> None:
    """A second grid over the same folder finds its runs done; with another setting they are not taken for its own."""
    folder, _ = grid
    meshes = find_meshes(folder, ["ball"])
    assert [cell.state for cell in make_cells(meshes, VARIANTS, SHORT, [0], folder / "out")] == ["done", "done"]
    other = make_cells(meshes, VARIANTS, replace(SHORT, lr_colors=0.5), [0], folder / "out")
    assert [cell.state for cell in other] == ["waiting", "waiting"]


def test_tables_hold_the_runs(grid: tuple[Path, list[Cell]], tmp_path: Path) -> None:
    """Every file is written; JSON has the runs' own metrics, the command and the commit; failed runs are left out."""
    rows = rows_of(grid[1])
    assert [row["object"] for row in rows] == ["ball", "ball"]
    write_tables(rows, ["elastic", "raster-face"], tmp_path, "etsplat bench ...")
    document = json.loads((tmp_path / "results.json").read_text())
    assert document["command"] == "etsplat bench ..."
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
    base = PRESETS["study"]
    weights = ("lambda_edge", "lambda_normal", "lambda_laplacian")
    for variant in regularizer_variants(base):
        config = variant.config(base, seed=3)
        assert sum(getattr(config, name) != getattr(base, name) for name in weights) == (variant.name != "1x")
        assert config.seed == 3
    assert {variant.config(base, 0).distance for variant in distance_variants(["elastic"])} == {"barycentric", "sdf"}
    changed = setting_variants(base, ["", "lr_vertices=5e-3,max_faces=2e4,colors=vertex"])[1].config(base, 0)
    assert (changed.lr_vertices, changed.max_faces, changed.colors) == (5e-3, 20_000, "vertex")


def test_wrong_requests_are_input_errors(tmp_path: Path) -> None:
    """Unknown methods, settings, values, meshes and folders are named."""
    base = PRESETS["study"]
    for setting, message in (("colour=red", "colour=red"), ("lr_vertices=fast", "fast"), ("seed", "NAME=VALUE")):
        with pytest.raises(InputError, match=message):
            setting_variants(base, [setting])
    with pytest.raises(InputError, match="gaussian"):
        method_variants(["gaussian"], [1e-3])
    with pytest.raises(InputError, match="data download famous"):
        find_meshes(tmp_path / "nothing", ())
    with pytest.raises(InputError, match="no mesh files"):
        find_meshes(tmp_path, ())
    with pytest.raises(InputError, match="named twice"):
        make_cells({}, [VARIANTS[0], VARIANTS[0]], base, [0], tmp_path)
