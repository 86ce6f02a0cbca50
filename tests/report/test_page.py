"""The report: a page and pictures made from the files of a run alone."""

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.io.run_directory import FORMAT, RunDirectory
from etsplat.report import write_report
from etsplat.report.curves import (
    curves_of,
)
from etsplat.report.data import read_run
from tests.helpers.finished_runs import CONFIG, METRICS, write_run, write_soup_run


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
        '<p class="verdict poor">The result is poor: the result has 1 part and 0 holes, the input mesh &lt;1&gt; part',
    ):
        assert text in page
    assert "bunny &lt;&amp;&gt; co" in page
    assert "bunny <&> co" not in page


def test_a_run_that_nobody_judged_has_a_page(tmp_path: Path) -> None:
    """As those of earlier versions."""
    run = RunDirectory(write_run(tmp_path))
    run.write_metrics({key: value for key, value in METRICS.items() if key != "judgement"})
    assert 'class="verdict' not in write_report(tmp_path).read_text(encoding="utf-8")


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
    with pytest.raises(InputError, match=r"has not finished; continue it with resume=True$"):
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


@pytest.mark.parametrize("cut", [41, 60, -20])
def test_a_damaged_picture_of_a_view_is_named(tmp_path: Path, cut: int) -> None:
    """Pillow reports a chunk of PNG that is none by a SyntaxError."""
    run_dir = write_run(tmp_path / "run", views=2, steps=2)
    picture = next((run_dir / "test").glob("*_render.png"))
    data = bytearray(picture.read_bytes())
    data[cut : cut + 12] = b"\xffU\x05 3\n\x00\x00\x00\x00\x01\x02"
    picture.write_bytes(bytes(data))
    with pytest.raises(InputError, match=f"^image {picture}: .*; copy it again"):
        write_report(run_dir)


@pytest.mark.parametrize("needed", ["faces", "iterations", "seconds", "engine", "seed", "versions"])
def test_metrics_without_what_every_run_has_are_refused(tmp_path: Path, needed: str) -> None:
    run_dir = write_run(tmp_path / "run", views=0, steps=2)
    (run_dir / "metrics.json").write_text(json.dumps({key: METRICS[key] for key in METRICS if key != needed}))
    with pytest.raises(InputError, match=f"metrics.json: lacks `{needed}`; delete it and run again"):
        write_report(run_dir)


def test_a_path_that_is_no_text_has_a_page(tmp_path: Path) -> None:
    """As of a file system whose names are bytes."""
    run_dir = write_run(tmp_path / "run", views=0, steps=2)
    record = {"format": FORMAT, **CONFIG, "paths": {"source": "b\udcffnny.ply", "init_mesh": None}}
    (run_dir / "config.json").write_text(json.dumps(record))
    assert "b?nny.ply" in write_report(run_dir).read_text(encoding="utf-8")


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
    before = write_report(folder).read_text(encoding="utf-8")
    assert "not measured" in before
    assert "`etsplat eval` with `--lpips-weights download`, or a file of weights, measures it" in before
    RunDirectory(folder).write_evaluation({"fps": 12.34, "ms_per_million": 820.4, "lpips_3dgs": 0.2345})
    page = write_report(folder).read_text(encoding="utf-8")
    assert "not measured" not in page
    assert "12.3" in page
    assert "0.2345" in page
