"""The grid of soups: runs that resume, numbers that come from the runs, tables that say what they are."""

import json

import pytest
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.tasks.sweeps.cells import run_cells
from etsplat.tasks.sweeps.places import Where
from etsplat.tasks.train_config import TrainConfig
from helpers.captures import write_colmap
from studies.scenes.cells import Scene, evaluate_cells, make_nvs_cells, read_scene_argument
from studies.scenes.paper import NVS, PER_SCENE, SCENES
from studies.scenes.pictures import draw_nvs
from studies.scenes.tables import nvs_tables, write_nvs_tables


def row(scene, variant, psnr, **numbers):
    known = {"ssim": 0.8, "lpips_3dgs": None, "psnr_opaque": 20.0, "minutes": 2.0, "triangles": 100, "fps": 5.0}
    return {"scene": scene, "variant": variant, "seed": 0, "psnr": psnr, "ms_per_million": 9.0, **known, **numbers}


def cells_of(folder, **options):
    settings = {"preset": "tiny", "culling": (False, True), "setting": "iterations=6,schedule.max_epochs=2"}
    scene = read_scene_argument(f"{folder / 'toy'}:indoor,background=white")
    return make_nvs_cells([scene], ["elastic"], folder / "out", **{**settings, **options})


def test_a_grid_runs_is_measured_and_goes_on_where_it_was(tmp_path):
    write_colmap(tmp_path / "toy", [(48, 36)] * 3)
    cells = cells_of(tmp_path)
    run_cells(cells, Where(jobs=2), lambda: None)
    assert [(cell.state, cell.error) for cell in cells] == [("done", ""), ("done", "")]
    assert [cell.metrics()["iterations"] for cell in cells] == [4, 4]  # two epochs of two training views
    told = []
    rows = evaluate_cells(cells, None, lambda *state: told.append(state))
    assert told[-1] == (2, 2)
    assert [row["variant"] for row in rows] == ["elastic", "elastic culling"]
    for measured, cell in zip(rows, cells, strict=True):
        assert measured["psnr"] == pytest.approx(cell.metrics()["psnr"], abs=1e-3)
    write_nvs_tables(rows, tmp_path / "out", "python -m studies.nvs")
    assert json.loads((tmp_path / "out" / "nvs.json").read_text())["rows"] == rows
    assert "**filter.**" in (tmp_path / "out" / "nvs.md").read_text()
    draw_nvs(cells, ["elastic", "elastic culling"], tmp_path / "nvs.png")
    assert Image.open(tmp_path / "nvs.png").width == 3 * 404
    again = cells_of(tmp_path)
    assert [cell.state for cell in again] == ["done", "done"]
    assert cells_of(tmp_path, setting="iterations=7")[0].state == "waiting"


def test_settings_and_seeds_multiply_the_runs_of_our_methods(tmp_path):
    scene = read_scene_argument("demo:scene:indoor,start.limit=0.3")
    cells = make_nvs_cells(
        [scene],
        ["elastic"],
        tmp_path,
        preset="quick",
        culling=(False,),
        setting="width=40",
        settings=("", "start.limit=none,drawing.cull_small=true"),
        seeds=(0, 1),
    )
    names = ["elastic", "start.limit=none,drawing.cull_small=true elastic"]
    assert [(cell.object, cell.variant, cell.config.seed) for cell in cells] == [
        ("demo", variant, seed) for seed in (0, 1) for variant in names
    ]
    assert len({cell.folder for cell in cells}) == 4
    limits = [cell.config.start.limit for cell in cells if isinstance(cell.config, TrainConfig)]
    assert limits == [0.3, None, 0.3, None]
    assert [cell.config.drawing.cull_small for cell in cells if isinstance(cell.config, TrainConfig)] == [
        False,
        True,
        False,
        True,
    ]
    with pytest.raises(InputError, match=r"settings: 'seed=1' is named twice"):
        make_nvs_cells(
            [scene], ["elastic"], tmp_path, preset="quick", culling=(False,), setting="", settings=["seed=1"] * 2
        )


def test_means_are_over_seeds_too():
    rows = [row("a", "elastic", 20.0), row("a", "elastic", 22.0, seed=1)]
    overall = nvs_tables(rows)[0]
    assert overall.rows[0][1][0] == 21.0
    assert overall.note.startswith("Means over a and 2 seeds.")
    assert nvs_tables(rows[:1])[0].note.startswith("Means over a. ")


def test_what_another_seed_changes_stands_beside_the_means():
    rows = [row("a", "elastic", psnr, seed=seed) for seed, psnr in enumerate((24.0, 25.0, 26.0))]
    tables = {table.name: table for table in nvs_tables([*rows, row("b", "elastic", 30.0)])}
    assert tables["per-scene PSNR"].rows == [("elastic", [25.0, 30.0])]
    assert tables["per-scene PSNR, spread"].rows == [("elastic", [1.0, None])]
    assert not any("spread" in table.name for table in nvs_tables(rows[:1]))


def test_the_built_in_scene_is_one_of_a_grid_in_photos_no_wider_than_asked_for(tmp_path):
    scene = read_scene_argument("demo:scene")
    cells = make_nvs_cells(
        [scene], ["elastic"], tmp_path, preset="tiny", culling=(False,), setting="iterations=4,width=40"
    )
    run_cells(cells, Where(jobs=1), lambda: None)
    measured = evaluate_cells(cells, None, lambda done, total: None)[0]
    assert (measured["scene"], measured["width"], measured["height"]) == ("demo", 40, 30)
    assert measured["psnr"] == pytest.approx(cells[0].metrics()["psnr"], abs=1e-3)


def test_means_are_over_the_scenes_that_every_variant_has_and_the_best_is_bold():
    rows = [row("a", "elastic", 20.0), row("b", "elastic", 30.0), row("a", "bilateral", 21.0)]
    overall = nvs_tables(rows)[0]
    assert [(title, values[0]) for title, values in overall.rows] == [("elastic", 20.0), ("bilateral", 21.0)]
    assert overall.cells("**")[1][1] == "**21.00**"
    assert overall.cells("**")[0][3] == "-"
    per_scene = nvs_tables(rows)[1]
    assert per_scene.rows == [("elastic", [20.0, 30.0]), ("bilateral", [21.0, None])]


def test_the_papers_row_stands_beside_a_complete_data_set_only():
    rows = [row(scene, "elastic culling", 23.0) for scene in ("truck", "train")]
    assert ("elastic culling (paper)", [23.08, 0.858, 0.134, None]) in nvs_tables(rows)[0].rows
    assert len(nvs_tables(rows[:1])[0].rows) == 1


def test_per_scene_tables_have_the_papers_numbers_for_scenes_that_it_has():
    """They average to the paper's own table of data sets, within what it rounds."""
    rows = [row("truck", "elastic culling", 24.0), row("fox", "elastic culling", 25.0)]
    table = next(table for table in nvs_tables(rows) if table.name == "per-scene PSNR")
    assert table.rows == [("elastic culling", [24.0, 25.0]), ("elastic culling (paper)", [24.68, None])]
    for (method, dataset), printed in NVS.items():
        scenes = [values for name, values in PER_SCENE[method].items() if SCENES[name].dataset == dataset]
        for index, value in enumerate(printed):
            mean = sum(scene[index] for scene in scenes) / len(scenes)
            assert mean == pytest.approx(value, abs=0.016 if index == 0 else 0.006)


def test_table_filter_shows_the_difference():
    rows = [row("a", "elastic", 21.5), row("a", "elastic culling", 21.0)]
    table = next(table for table in nvs_tables(rows) if table.name == "filter")
    assert [(title, values[0]) for title, values in table.rows] == [
        ("elastic, culled", 21.0),
        ("elastic, kept", 21.5),
        ("elastic, kept - culled", 0.5),
    ]


def test_the_papers_scenes_get_their_settings_with_preset_paper(tmp_path):
    (tmp_path / "garden" / "images_4").mkdir(parents=True)
    garden = read_scene_argument(str(tmp_path / "garden"))
    cell = make_nvs_cells([garden], ["single-sided"], tmp_path / "out", preset="paper", culling=(True,), setting="")[0]
    assert isinstance(cell.config, TrainConfig)
    assert (cell.config.max_triangles, cell.config.scene_type, cell.images) == (5_200_000, "outdoor", "images_4")
    assert cell.config.drawing.cull_small
    assert {scene.dataset for scene in SCENES.values()} == {"Mip-NeRF 360", "Tanks and Temples", "Deep Blending"}


def test_missing_scenes_and_equal_names_are_input_errors(tmp_path):
    with pytest.raises(InputError, match="etsplat data download"):
        cells_of(tmp_path)
    for folder in ("x", "y"):
        (tmp_path / folder / "toy").mkdir(parents=True)
    scenes = [read_scene_argument(str(tmp_path / folder / "toy")) for folder in ("x", "y")]
    with pytest.raises(InputError, match="two are named toy"):
        make_nvs_cells(scenes, ["elastic"], tmp_path / "out", preset="tiny", culling=(False,), setting="")


def test_a_scene_says_its_kind_and_its_changes_after_a_colon(tmp_path):
    (tmp_path / "a:b").mkdir()
    assert read_scene_argument(f"{tmp_path}/a:b") == Scene(tmp_path / "a:b", None, "")
    assert read_scene_argument(f"{tmp_path}/a:b:object") == Scene(tmp_path / "a:b", "object", "")
    scene = read_scene_argument(f"{tmp_path}/a:b:indoor,width=90,background=white")
    assert scene == Scene(tmp_path / "a:b", "indoor", "width=90,background=white")
    cell = make_nvs_cells(
        [scene], ["elastic"], tmp_path / "out", preset="quick", culling=(False,), setting="width=50,iterations=8"
    )[0]
    settings = cell.config
    assert isinstance(settings, TrainConfig)
    assert (settings.scene_type, settings.width, settings.iterations) == ("indoor", 90, 8)
    assert settings.background == "white"
    with pytest.raises(InputError, match=r"indoors: no such folder; .*one of outdoor, indoor, object"):
        read_scene_argument(f"{tmp_path}/a:b:indoors")
