"""Curves of a run and their charts."""

import math
import re
from pathlib import Path

import pytest

from etsplat.io.run_directory import RunDirectory
from etsplat.report import write_report
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
from tests.helpers.finished_runs import write_run, write_soup_run


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
