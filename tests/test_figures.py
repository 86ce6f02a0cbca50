"""The paper's explanatory figures: they are drawn, and what they show is what the kernels are."""

from pathlib import Path

import pytest

from etsplat.bench.dead_zone import pull, remaining_distance
from etsplat.bench.drawings import FIGURES
from etsplat.cli.figures import Figures
from etsplat.core.errors import InputError


@pytest.mark.parametrize("name", [name for name in FIGURES if name != "dead-zone"])
def test_figures_are_written(name: str, tmp_path: Path) -> None:
    """Each of the quick ones ends up in a file of the kind that its name asks for."""
    path = tmp_path / f"{name}.svg"
    assert Figures(name=name, out=path).run([]) == 0  # pyright: ignore[reportArgumentType]
    assert path.read_text().startswith("<?xml")


def test_every_kernel_pulls_an_overlapping_triangle_back() -> None:
    """Displaced by one inradius, each soft kernel pulls towards the target, and Adam brings the triangle home."""
    for kernel in ("single_sided", "bilateral", "elastic"):
        assert pull(kernel, 1.0, 0.3) > 0
    assert remaining_distance("elastic", 1.0, 0.3) < 0.5


def test_wrong_requests_are_input_errors(tmp_path: Path) -> None:
    """An unknown kind of file, and a teaser without runs."""
    with pytest.raises(InputError, match="unknown kind of picture"):
        Figures(name="kernels", out=tmp_path / "kernels.bmp").run([])
    with pytest.raises(InputError, match="--runs"):
        Figures(name="teaser", out=tmp_path / "teaser.png").run([])
