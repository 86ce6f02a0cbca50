"""The paper's explanatory figures: they are drawn, and what they show is what the kernels are."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig
from helpers.captures import write_colmap
from studies.drawings.dead_zone import pull, remaining_distance
from studies.drawings.growth import SCENE_SIZE, TILE, save_growth, watch_growth, watch_scene
from studies.drawings.kernels import FIGURES, draw_edges
from studies.drawings.teaser import draw_teaser
from studies.figures import Figures


@pytest.mark.parametrize("name", [name for name in FIGURES if name != "dead-zone"])
def test_figures_are_written(name: str, tmp_path: Path) -> None:
    """Each of the quick ones ends up in a file of the kind that its name asks for, whatever its capitals."""
    path = tmp_path / f"{name}.{'SVG' if name == 'kernels' else 'svg'}"
    assert Figures(name=name, out=path).run([]) == 0  # pyright: ignore[reportArgumentType]
    assert path.read_text().startswith("<?xml")


def test_the_seam_of_single_sided_triangles_goes_down_to_nothing() -> None:
    """At every sigma, however narrow: the profile has a value on the seam itself. Elastic triangles close it."""
    axes = draw_edges().axes
    single_sided, elastic = ([np.asarray(line.get_ydata()) for line in axes[row].get_lines()] for row in (3, 11))
    assert [profile[len(profile) // 2] for profile in single_sided] == [0, 0, 0]
    assert elastic[2][len(elastic[2]) // 2] > 0.99


def test_the_growing_object_is_watched_from_all_around(tmp_path: Path) -> None:
    """From the start, which is as grey as its sphere, to the last iteration; the file moves, and stays at its end."""
    tiny = ReconstructConfig.tiny().changed({"resolution": 32, "iterations": 9})
    frames = watch_growth(tiny, 4)
    assert [frame.iteration for frame in frames] == [0, 1, 4, 9]
    assert float(frames[0].splatted.std(dim=2).max()) < 1e-3 < float(frames[-1].splatted.std(dim=2).max())
    assert all(float(frame.beside.std()) > 0.02 for frame in frames)
    save_growth(tmp_path / "owl.webp", frames)
    with Image.open(tmp_path / "owl.webp") as film:
        assert getattr(film, "n_frames", 1) == 4
        assert film.size == (2 * TILE, TILE)
        film.seek(3)
        film.load()
        assert film.info["duration"] > 1000


def test_the_growing_scene_comes_closer_to_what_a_camera_sees_there(tmp_path: Path) -> None:
    """Of each frame, whose camera is another: the photo beside it is what a right scene would look like."""
    frames = watch_scene(TrainConfig.tiny().changed({"iterations": 40}), 3)
    assert [frame.iteration for frame in frames] == [0, 10, 40]
    first, last = (float((frame.splatted - frame.beside).square().mean()) for frame in (frames[0], frames[-1]))
    assert last < 0.7 * first
    assert float((frames[0].beside - frames[-1].beside).abs().mean()) > 0.02
    save_growth(tmp_path / "scene.webp", frames)
    with Image.open(tmp_path / "scene.webp") as film:
        assert film.size == (2 * SCENE_SIZE[0], SCENE_SIZE[1])


def test_every_kernel_pulls_an_overlapping_triangle_back() -> None:
    """Displaced by one inradius, each soft kernel pulls towards the target, and Adam brings the triangle home."""
    for kernel in ("single_sided", "bilateral", "elastic"):
        assert pull(kernel, 1.0, 0.3) > 0
    assert remaining_distance("elastic", 1.0, 0.3) < 0.5


def test_wrong_requests_are_input_errors(tmp_path: Path) -> None:
    """An unknown kind of file, and a teaser without runs."""
    with pytest.raises(InputError, match="unknown kind of picture"):
        Figures(name="kernels", out=tmp_path / "kernels.bmp").run([])
    with pytest.raises(InputError, match=r"growth.png: .* \.webp"):
        Figures(name="growth", out=tmp_path / "growth.png").run([])
    with pytest.raises(InputError, match="--runs"):
        Figures(name="teaser", out=tmp_path / "teaser.png").run([])


def test_the_teaser_shows_a_mesh_and_a_soup(tmp_path: Path) -> None:
    """A row each, of five pictures that are not blank."""
    quick = {"output.checkpoint_every": 0, "output.evaluate_every": 0}
    mesh = ReconstructConfig.tiny().changed(
        {"resolution": 32, "iterations": 3, "output.chamfer_samples": 1000, **quick}
    )
    reconstruct("demo:owl", tmp_path / "mesh", mesh)
    write_colmap(tmp_path / "scene", [(48, 36)] * 9)
    soup = TrainConfig.tiny().changed({"iterations": 3, "start.opacity": 0.8, **quick})
    train(tmp_path / "scene", tmp_path / "soup", soup)
    figure = draw_teaser([tmp_path / "mesh", tmp_path / "soup"])
    pictures = [np.asarray(axis.images[0].get_array()) for axis in figure.axes]
    assert len(pictures) == 10
    assert all(float(picture.std()) > 0.02 for picture in pictures)
    assert [axis.get_title() for axis in figure.axes[5:7]] == ["start", "opaque triangles"]
    with pytest.raises(InputError, match="not a finished run"):
        draw_teaser([tmp_path / "scene"])
