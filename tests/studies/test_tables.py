"""One small cell of each table, run anew: the table holds what a run by itself comes to, to the bit."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.scoring import evaluate_run
from etsplat.tasks.sweeps.cells import run_cells
from etsplat.tasks.sweeps.places import Where
from etsplat.tasks.train import train
from studies.distance import Distance
from studies.famous import Famous
from studies.grid.cells import Cell, make_cells
from studies.grid.variants import find_meshes
from studies.objects.results import METRICS, rows_of
from studies.objects.tables import write_tables
from studies.regularizers import Regularizers
from studies.scenes.cells import METRICS as NVS_METRICS
from studies.scenes.cells import evaluate_cells, make_nvs_cells, read_scene_argument
from studies.scenes.tables import write_nvs_tables
from studies.settings import Settings

OBJECT = "goathead"
SMALL = ReconstructConfig.tiny().changed(
    {"iterations": 150, "output.evaluate_every": 50, "output.chamfer_samples": 5000}
)
SECONDS = {"seconds", "fps", "ms_per_million"}
"""What no two runs have in common."""

NOWHERE: dict[str, Any] = {"meshes": Path(), "out": Path()}
TABLES = {
    "famous": (
        Famous(**NOWHERE, methods=("elastic", "single-sided"), lambda_sigmas=(1e-4,)),
        ["elastic 0.0001", "single-sided 0.0001"],
    ),
    "regularizers": (Regularizers(**NOWHERE), ["0.1x lambda_edge"]),
    "distance": (Distance(**NOWHERE), ["elastic sdf"]),
    "settings": (Settings(**NOWHERE, settings=("", "drawing.colors=vertex")), ["drawing.colors=vertex"]),
}
"""A command, and which of its variants are run."""


@pytest.fixture(scope="module")
def one_thread() -> Any:
    """Runs and what they are compared with, on one thread each; of torch too, in processes of their own."""
    before = num_threads()
    set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        yield
    set_num_threads(before)


@pytest.fixture(scope="module")
def cells(shared_data: Path, one_thread: None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Cell]]:
    """The cells of all tables of shape reconstruction, run two by two."""
    meshes = find_meshes(shared_data / "famous", [OBJECT])
    made = {}
    for name, (command, variants) in TABLES.items():
        everything = make_cells(meshes, command.variants(SMALL), SMALL, [0], tmp_path_factory.mktemp(name))
        made[name] = [cell for cell in everything if cell.variant in variants]
    run_cells([cell for table in made.values() for cell in table], Where(jobs=2), lambda: None)
    return made


@pytest.mark.parametrize("table", TABLES)
def test_a_cell_holds_what_its_run_comes_to(table: str, cells: dict[str, list[Cell]], tmp_path: Path) -> None:
    """CSV and JSON have the metrics of `reconstruct` with the cell's settings, in this process, bit for bit."""
    write_tables(rows_of(cells[table]), TABLES[table][1], tmp_path, f"python -m studies.{table}")
    in_json = json.loads((tmp_path / "results.json").read_text())["rows"][0]
    in_csv = next(csv.DictReader((tmp_path / "results.csv").open()))
    cell = cells[table][0]
    metrics = reconstruct(cell.source, tmp_path / "alone", cell.config).metrics  # pyright: ignore[reportArgumentType]
    assert metrics["chamfer"] > 0
    for name in set(METRICS) - SECONDS:
        assert in_json[name] == metrics.get(name), name
        assert in_csv[name] == ("" if metrics.get(name) is None else str(metrics[name])), name


def test_elastic_is_closer_than_single_sided(cells: dict[str, list[Cell]]) -> None:
    """The first finding of the paper's table famous holds in its smallest cell."""
    elastic, single_sided = (cell.metrics() for cell in cells["famous"])
    assert elastic["chamfer"] < single_sided["chamfer"]


def test_a_cell_of_nvs_holds_what_its_run_comes_to(shared_data: Path, one_thread: None, tmp_path: Path) -> None:
    """The same for `train` and `eval`: the row of the scene is what both give by themselves."""
    scene = shared_data / "scenes" / "kitchen25"
    cells = make_nvs_cells(
        [read_scene_argument(f"{scene}:indoor")],
        ["elastic"],
        tmp_path,
        preset="tiny",
        culling=(False,),
        setting="iterations=20,max_triangles=3000",
    )
    run_cells(cells, Where(jobs=1), lambda: None)
    write_nvs_tables(evaluate_cells(cells, None, lambda done, total: None), tmp_path, "python -m studies.nvs")
    in_json = json.loads((tmp_path / "nvs.json").read_text())["rows"][0]
    in_csv = next(csv.DictReader((tmp_path / "nvs.csv").open()))
    result = train(scene, tmp_path / "alone", cells[0].config)  # pyright: ignore[reportArgumentType]
    alone = evaluate_run(open_run(tmp_path / "alone"))
    assert in_json["triangles"] == result.metrics["triangles"]
    for name in set(NVS_METRICS) - SECONDS:
        assert in_json[name] == alone[name], name
        assert in_csv[name] == ("" if alone[name] is None else str(alone[name])), name
