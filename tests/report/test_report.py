"""The report: a page and pictures made from the files of a run alone."""

import json
import math
import re
import shlex
from dataclasses import replace
from html.parser import HTMLParser
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.cli.parse import parse
from etsplat.cli.runs import Train
from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import save_mesh
from etsplat.io.run_directory import FORMAT, RunDirectory
from etsplat.report import write_report
from etsplat.report.command import reproduce_command
from etsplat.report.curves import (
    MAX_POINTS,
    Curve,
    ShortNumbers,
    curves_of,
    draw_svg,
    linear_ticks,
    log_ticks,
    short_number,
    tick_labels,
)
from etsplat.report.data import read_run
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train_config import TrainConfig

METRICS = {
    "chamfer": 6.4e-5,
    "chamfer_floor": 5.1e-5,
    "chamfer_exact": 9.0e-6,
    "f_score": 0.987,
    "psnr": 38.21,
    "psnr_mesh": 37.5,
    "silhouette_iou": 0.981,
    "ssim": 0.9912,
    "lpips": None,
    "lpips_reason": "no weights: give --lpips-weights FILE",
    "faces": 5120,
    "vertices": 2562,
    "degenerate_faces": 0,
    "self_intersections": 3,
    "iterations": 3000,
    "seconds": 61.7,
    "seconds_per_iteration": 0.0206,
    "engine": "cpu",
    "method": "elastic",
    "preset": "quick",
    "seed": 0,
    "versions": {"etsplat": "0.1.0", "torch": "2.13.0"},
}

CONFIG = {
    "task": "reconstruct",
    "config": replace(ReconstructConfig.quick(), iterations=3000, method="bilateral").to_dict(),
    "source": {"fingerprint": "0123456789abcdef", "init_mesh": None},
    "paths": {"source": "meshes/bunny <&> co.ply", "init_mesh": None},
    "versions": {"etsplat": version("etsplat"), "torch": "2.13.0"},
}


def write_run(folder: Path, views: int = 3, steps: int = 300) -> Path:
    """A finished run of `steps` log lines: a bumpy sphere, and disks for its pictures."""
    run = RunDirectory.create(folder, CONFIG)
    run.write_metrics(METRICS)
    for step in range(1, steps + 1):
        decay = math.exp(-4 * step / steps)
        line = {"iteration": 10 * step, "seconds": 0.2 * step, "loss": 0.01 + 0.2 * decay * (1 + 0.1 * math.sin(step))}
        line |= {"faces": 1280 * 4 ** (3 * step // (steps + 1)), "sigma": 0.05 + decay}
        if step % 20 == 0:
            line |= {"psnr": 38 - 20 * decay, "chamfer": 6e-5 + 0.1 * decay**2}
        run.append_history(line)
    vertices, faces = icosphere(4)
    vertices = vertices * (1 + 0.15 * torch.sin(6 * vertices[:, :1]) * torch.cos(5 * vertices[:, 1:2]))
    colors = 0.5 + 0.5 * vertices[faces].mean(dim=1).clamp(-1, 1)
    save_mesh(run.mesh_path(".ply"), vertices, faces, colors)
    for view in range(views):
        for kind, radius in (("truth", 0.8), ("render", 0.79), ("mesh", 0.78)):
            _disk(radius, view).save(run.test / f"{5 * view + 2:03d}_{kind}.png")
    return folder


def _disk(radius: float, view: int, size: int = 256) -> Image.Image:
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / (size / 2) - 1
    z = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0)) / radius
    light = z * (0.6 + 0.4 * np.cos(3 * x + view))
    return Image.fromarray(np.uint8(255 * np.clip(light[..., None] * [1, 0.95, 0.9], 0, 1)))


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run")


class References(HTMLParser):
    """Collects what a page would load or link to, and checks that tags are closed."""

    VOID = ("meta", "img", "input")

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name in ("src", "href", "data-render", "data-mesh")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """`<line ... />` of an SVG closes itself."""

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_page_needs_no_network(run_dir: Path) -> None:
    """Everything the page shows is inside it: no address but data URLs, no import, no fetch."""
    page = write_report(run_dir).read_text(encoding="utf-8")
    parser = References()
    parser.feed(page)
    assert parser.open == []
    assert len(parser.found) == 3 * 4
    assert all(reference.startswith("data:image/png;base64,") for reference in parser.found)
    assert not re.search(r"https?://|@import|url\(|fetch\(|XMLHttpRequest", page)


def test_page_says_what_the_run_says(run_dir: Path) -> None:
    """Metrics with their floor, the reason for a missing one, and the input's name are on the page, escaped."""
    page = write_report(run_dir).read_text(encoding="utf-8")
    for text in (
        "38.21",
        "0.0640",
        "about 0.0510",
        "98.7",
        "3 self-intersecting faces",
        "Not measured: no weights: give --lpips-weights",
    ):
        assert text in page
    assert "bunny &lt;&amp;&gt; co" in page
    assert "bunny <&> co" not in page


def test_pictures_are_written(run_dir: Path) -> None:
    """convergence.png and overview.png are there beside the page and can be read."""
    write_report(run_dir)
    for name in ("convergence.png", "overview.png"):
        with Image.open(run_dir / name) as image:
            assert min(image.size) > 200


def test_report_of_sparse_run(tmp_path: Path) -> None:
    """A run without test views, ground truth or history still gets its page, which says what is missing."""
    run_dir = write_run(tmp_path / "run", views=0, steps=0)
    absent = dict.fromkeys(("chamfer", "chamfer_floor", "chamfer_exact", "f_score", "psnr", "psnr_mesh", "ssim"))
    (run_dir / "metrics.json").write_text(json.dumps(METRICS | absent))
    page = write_report(run_dir).read_text(encoding="utf-8")
    assert "no ground-truth mesh" in page
    assert 'id="views"' not in page


def test_report_again_replaces(run_dir: Path) -> None:
    """Writing the report twice gives the same page and leaves no temporary file."""
    first = write_report(run_dir).read_bytes()
    names = sorted(path.name for path in run_dir.iterdir())
    assert write_report(run_dir).read_bytes() == first
    assert sorted(path.name for path in run_dir.iterdir()) == names


def test_unfinished_or_foreign_folder_is_an_input_error(tmp_path: Path, run_dir: Path) -> None:
    """A folder that is no run, and a run without metrics, are refused in one line that says what to do."""
    with pytest.raises(InputError, match="is not a run of etsplat"):
        write_report(tmp_path)
    (run_dir / "metrics.json").unlink()
    with pytest.raises(InputError, match="has not finished; continue it with --resume"):
        write_report(run_dir)


@pytest.mark.parametrize(
    ("file", "entry", "value"),
    [
        ("config.json", "task", "fit"),
        ("config.json", "task", {}),
        ("config.json", "config", 5),
        ("config.json", "config", {}),
        ("config.json", "config", {"preset": ["quick"]}),
        ("config.json", "config", {"preset": "splendid"}),
        ("config.json", "paths", {"source": 1}),
        ("config.json", "paths", {}),
        ("config.json", "source", None),
        ("config.json", "versions", {"etsplat": 1}),
        ("metrics.json", "versions", ["0.1.0"]),
        ("metrics.json", "faces", None),
        ("metrics.json", "faces", "5120"),
        ("metrics.json", "psnr", "high"),
        ("metrics.json", "psnr", [1.0]),
        ("metrics.json", "chamfer_floor", {}),
        ("metrics.json", "seconds", math.nan),
        ("metrics.json", "seconds", 10**400),
        ("metrics.json", "lpips_reason", 3),
        ("evaluation.json", "engine", None),
        ("evaluation.json", "threads", "4"),
        ("history.jsonl", "iteration", None),
    ],
)
def test_a_damaged_run_is_named(tmp_path: Path, file: str, entry: str, value: object) -> None:
    """In one line with the file, or the folder of another kind of run, and what to do; no page is written."""
    run_dir = write_run(tmp_path / "run", views=0, steps=2)
    said = {"config.json": {"format": FORMAT, **CONFIG}, "metrics.json": METRICS}.get(file, {})
    (run_dir / file).write_text(json.dumps({**said, entry: value}) + "\n")
    with pytest.raises(InputError) as error:
        write_report(run_dir)
    assert str(error.value).startswith(str(run_dir if value == "fit" else run_dir / file))
    assert "; " in str(error.value)
    assert "\n" not in str(error.value)
    assert not (run_dir / "report.html").exists()


@pytest.mark.parametrize("needed", ["faces", "iterations", "seconds", "engine", "seed", "versions"])
def test_metrics_without_what_every_run_has_are_refused(tmp_path: Path, needed: str) -> None:
    run_dir = write_run(tmp_path / "run", views=0, steps=2)
    (run_dir / "metrics.json").write_text(json.dumps({key: METRICS[key] for key in METRICS if key != needed}))
    with pytest.raises(InputError, match=f"metrics.json: lacks `{needed}`; delete it and run again"):
        write_report(run_dir)


def test_odd_values_in_the_history_are_left_out_of_the_curves(tmp_path: Path) -> None:
    """Only numbers are points; where a band or a floor goes below zero, no logarithm is taken of it."""
    folder = write_soup_run(tmp_path / "run")
    run = RunDirectory(folder)
    odd = ["1", True, None, [1], math.nan, math.inf, 10**400, 1e300]
    for place, value in enumerate(odd):
        run.append_history({"iteration": 1000 + place, "loss": value})
    run.append_history({"iteration": 2000, "loss": 1e-320, "sigma": 0.1, "sigma_10": 0.1, "sigma_90": -1})
    write_report(folder)
    curves = {curve.quantity.key: curve for curve in curves_of(read_run(folder))}
    assert len(curves["loss"].x) == 30
    assert not curves["sigma"].logarithmic


def test_a_path_that_is_no_text_has_a_page(tmp_path: Path) -> None:
    """As of a file system whose names are bytes."""
    run_dir = write_run(tmp_path / "run", views=0, steps=2)
    record = {"format": FORMAT, **CONFIG, "paths": {"source": "b\udcffnny.ply", "init_mesh": None}}
    (run_dir / "config.json").write_text(json.dumps(record))
    assert "b?nny.ply" in write_report(run_dir).read_text(encoding="utf-8")


def test_long_history_is_thinned(tmp_path: Path) -> None:
    """A curve keeps at most MAX_POINTS points, ends at the last iteration, and its band holds every value."""
    run = read_run(write_run(tmp_path / "run", views=0, steps=2000))
    loss = next(curve for curve in curves_of(run) if curve.quantity.key == "loss")
    assert len(loss.x) <= MAX_POINTS
    assert loss.x[-1] == 20000
    _, values = run.series("loss")
    assert (min(loss.low), max(loss.high)) == (min(values), max(values))


@pytest.mark.parametrize("key", ["loss", "psnr", "chamfer", "sigma", "faces"])
def test_curve_stays_inside_its_chart(run_dir: Path, key: str) -> None:
    """All points of the drawn line lie inside the SVG's view box."""
    curve: Curve = next(curve for curve in curves_of(read_run(run_dir)) if curve.quantity.key == key)
    line = re.search(r'class="line" d="M([^"]+)"', draw_svg(curve))
    assert line
    points = [tuple(map(float, point.split())) for point in line[1].split("L")]
    assert all(0 <= x <= 400 and 0 <= y <= 200 for x, y in points)


def test_ticks_are_round_and_cover() -> None:
    """Linear ticks are round and enclose the range; logarithmic ones lie inside it."""
    assert linear_ticks(0, 97, 5) == [0, 25, 50, 75, 100]
    assert linear_ticks(3, 3)[0] <= 3 <= linear_ticks(3, 3)[-1]
    assert log_ticks(0.011, 0.9) == [0.02, 0.05, 0.1, 0.2, 0.5]
    assert log_ticks(2.1, 2.9) == [2.1, 2.9]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (20480, "20.5k"),
        (3000, "3k"),
        (1280, "1280"),
        (0.05, "0.05"),
        (6e-5, "6e-5"),
        (2e6, "2M"),
        (-31.6, "-31.6"),
    ],
)
def test_short_number(value: float, text: str) -> None:
    """Numbers on axes are short."""
    assert short_number(value) == text


def test_labels_of_ticks_tell_them_from_each_other() -> None:
    """However close they are: as many digits as that takes, and no more."""
    assert tick_labels([15_200, 15_250, 15_300, 15_350]) == ["15.2k", "15.25k", "15.3k", "15.35k"]
    assert tick_labels([250.0, 250.5, 251.0]) == ["250.0", "250.5", "251.0"]
    assert tick_labels([0.0, 0.25, 20_480]) == ["0", "0.25", "20.5k"]
    assert ShortNumbers().format_ticks([15_200, 15_250]) == ["15.2k", "15.25k"]  # of convergence.png


def test_command_repeats_the_run() -> None:
    """The command names the source and what differs from the preset; all settings if the run is another version's."""
    here = version("etsplat")
    command = reproduce_command(CONFIG, here)
    assert command is not None
    words = shlex.split(command.replace("\\\n", ""))
    assert words[:4] == ["etsplat", "reconstruct", "meshes/bunny <&> co.ply", "--out"]
    assert words[5:] == ["--preset", "quick", "--method", "bilateral", "--iterations", "3000"]
    older = reproduce_command(CONFIG | {"versions": {"etsplat": "0.0.1"}}, here)
    assert older is not None
    assert "--max-faces" in older


def test_the_command_is_read_back_as_the_same_settings() -> None:
    """Whatever was changed: numbers, switches, words, none, at the top and in groups."""
    changes = {"normalize": False, "width": None, "drawing.cull_small": True, "optimizer.lr_sigma": 1e-7, "sky": "dome"}
    settings = TrainConfig.demo("indoor").changed({**changes, "densification.replace_dead": False})
    paths = {"source": "scenes/a b", "images": None, "masks": None}
    record = {
        "task": "train",
        "config": settings.to_dict(),
        "paths": paths,
        "versions": {"etsplat": version("etsplat")},
    }
    for made_with in (version("etsplat"), "0.0.1"):
        command = reproduce_command(record, made_with)
        assert command is not None
        parsed = parse(shlex.split(command.replace("\\\n", ""))[1:])
        assert isinstance(parsed, Train)
        assert parsed.settings == settings


def test_no_command_for_objects_from_python() -> None:
    """A run that was handed a mesh or views from Python has no command line."""
    here = version("etsplat")
    assert reproduce_command(CONFIG | {"paths": {"source": None, "init_mesh": None}}, here) is None
    start = {"source": {"fingerprint": "1", "init_mesh": "2"}}
    assert reproduce_command(CONFIG | start, here) is None


def write_soup_run(folder: Path) -> Path:
    """A finished run of `etsplat train`, with grey pictures."""
    config = {
        "task": "train",
        "config": replace(TrainConfig.quick("indoor"), iterations=500).to_dict(),
        "source": {"fingerprint": "0123456789abcdef"},
        "paths": {"source": "scenes/my kitchen", "images": "images_2", "masks": None},
        "versions": {"etsplat": version("etsplat"), "torch": "2.13.0"},
    }
    run = RunDirectory.create(folder, config)
    shared = ("iterations", "seconds", "seconds_per_iteration", "engine", "preset", "seed", "versions")
    run.write_metrics(
        {
            **{key: METRICS[key] for key in shared},
            "psnr": 27.1,
            "ssim": 0.81,
            "psnr_opaque": 25.9,
            "triangles": 98765,
            "threads": 4,
            "method": "elastic",
            "sigma": 0.4,
            "sigma_10": 0.1,
            "sigma_90": 0.9,
            "opacity": 0.6,
            "opacity_10": 0.2,
            "opacity_90": 0.99,
        }
    )
    for step in range(1, 30):
        spread = {"sigma": 1 / step, "sigma_10": 0.5 / step, "sigma_90": 2 / step, "triangles": 100 * step}
        run.append_history({"iteration": 10 * step, "seconds": step, "loss": 1 / step, **spread})
    run.soup_path.write_bytes(b"soup")
    for kind in ("truth", "render", "opaque"):
        Image.new("RGB", (32, 24), "#808080").save(run.test / f"000_{kind}.png")
    return folder


def test_the_page_of_a_soup_has_no_mesh_but_opaque_pictures_and_bands(tmp_path: Path) -> None:
    page = write_report(write_soup_run(tmp_path / "run")).read_text(encoding="utf-8")
    assert 'id="mesh-data"' not in page
    assert 'data-opaque="data:image' in page
    assert "98,765" in page
    assert "10 to 90 %: 0.1 to 0.9" in page
    run = read_run(tmp_path / "run")
    sigma = next(curve for curve in curves_of(run) if curve.quantity.key == "sigma")
    assert (sigma.low[3], sigma.mean[3], sigma.high[3]) == (0.125, 0.25, 0.5)
    assert (tmp_path / "run" / "overview.png").is_file()


def test_what_eval_measured_is_on_the_page(tmp_path: Path) -> None:
    folder = write_soup_run(tmp_path / "run")
    assert "not measured" in write_report(folder).read_text(encoding="utf-8")
    RunDirectory(folder).write_evaluation({"fps": 12.34, "ms_per_million": 820.4, "lpips_3dgs": 0.2345})
    page = write_report(folder).read_text(encoding="utf-8")
    assert "not measured" not in page
    assert "12.3" in page
    assert "0.2345" in page


def test_the_command_of_a_soup_names_scene_photos_and_changes(tmp_path: Path) -> None:
    config = read_run(write_soup_run(tmp_path / "run")).config
    command = reproduce_command(config, version("etsplat"))
    assert command is not None
    words = shlex.split(command.replace("\\\n", ""))
    assert words[:4] == ["etsplat", "train", "scenes/my kitchen", "--out"]
    assert words[5:] == [
        *["--images", "images_2", "--preset", "quick", "--scene-type", "indoor"],
        *["--iterations", "500"],
    ]
