import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.camera_paths import PATHS, camera_centers, focus_point
from etsplat.data.load import load_dataset
from etsplat.geometry.regions import Sphere
from etsplat.io import videos
from etsplat.io.camera_path_files import KeyPoses
from etsplat.io.images import load_image, over_background
from etsplat.io.videos import open_video
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.triangle_soup import FOCAL_NOTE, TriangleSoup
from etsplat.tasks.opened_runs import SoupRun
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.render_soup import color_depth, draw, drawn_soup, render_run, samples_of
from helpers.captures import circle_poses, write_colmap
from helpers.engines import noted_engine

ALIASED = RenderConfig(antialias=False)
UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


@pytest.fixture
def run(tmp_path, rng):
    write_colmap(tmp_path / "scene", [(33, 24)] * 9)
    soup = TriangleSoup.from_triangles(
        torch.randn(40, 1, 3, generator=rng) * 0.3 + torch.randn(40, 3, 3, generator=rng) * 0.3,
        torch.rand(40, 3, generator=rng),
        opacity=0.9,
        sigma=0.3,
        sh_degree=1,
    )
    return SoupRun(
        tmp_path, replace(soup, appearance=SoupAppearance(background=(0.0, 0.0, 1.0))), load_dataset(tmp_path / "scene")
    )


def test_small_pictures_have_as_many_samples_as_the_photos_had(run):
    """By the focal length that the soup notes; a quarter of the size is the mean over 4 x 4 pixels."""
    camera = run.capture.cameras[0].scaled(4)
    small, focal = camera.scaled(1 / 4), float(camera.Ks[0, 0, 0])
    noted = replace(run.soup, notes={FOCAL_NOTE: str(focal)})
    whole = draw(noted, camera, RenderConfig())["color"]
    assert torch.equal(whole, draw(run.soup, camera, RenderConfig())["color"])
    shrunk = torch.nn.functional.avg_pool2d(whole.movedim(-1, 0)[None], 4)[0].movedim(0, -1)
    drawn = draw(noted, small, RenderConfig(depth=True))
    torch.testing.assert_close(drawn["color"], shrunk)
    assert drawn["depth"].shape == (small.height, small.width)
    single = draw(run.soup, small, RenderConfig())["color"]
    assert torch.equal(draw(noted, small, ALIASED)["color"], single)
    assert float((single - shrunk).abs().max()) > 0.01
    assert [samples_of(replace(noted, notes={FOCAL_NOTE: odd}), small) for odd in ("nan", "x", "-3", "1e30")] == [
        1,
        1,
        1,
        8,
    ]


@pytest.mark.parametrize("name", ["orbit.mp4", "orbit.gif", "orbit.MOV", "view.jpg", "there.txt"])
def test_a_file_instead_of_a_folder_is_refused(run, name):
    """Pictures and videos have names of their own: a folder named like a video would only confuse."""
    (run.folder / "there.txt").write_text("")
    with pytest.raises(InputError, match=rf"{name}: .*name a folder"):
        render_run(run, run.folder / name, RenderConfig(path="orbit", frames=2))


@pytest.mark.parametrize("name", list(PATHS))
@pytest.mark.parametrize("center", [0.0, 40.0])
def test_paths_stay_near_the_cameras_and_are_rigid(name, center):
    poses = circle_poses(9, center=(center, -center, 0.0))
    path = PATHS[name](poses, UP, 30)
    rotation = path[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(30, 3, 3))
    assert bool((torch.linalg.det(rotation) > 0).all())
    cameras = camera_centers(poses)
    reach = (cameras - cameras.mean(dim=0)).norm(dim=1).max()
    assert float((camera_centers(path) - cameras.mean(dim=0)).norm(dim=1).max()) < 1.3 * reach
    steps = (camera_centers(path)[1:] - camera_centers(path)[:-1]).norm(dim=1)
    assert float(steps.max()) < 4 * float(steps.median()) + 1e-9


def test_the_focus_is_what_the_cameras_look_at_and_ahead_where_they_look_alike():
    focus = focus_point(circle_poses(7, center=(3.0, -2.0, 9.0)))
    torch.testing.assert_close(focus, torch.tensor([3.0, -2.0, 9.0], dtype=torch.float64))
    side_by_side = circle_poses(1)[0].expand(3, 4, 4).clone()
    side_by_side[:, 0, 3] += torch.arange(3)
    ahead = side_by_side[:, :3, :3] @ focus_point(side_by_side) + side_by_side[:, :3, 3]
    assert bool((ahead[:, 2] > 0.5).all())


def test_the_interpolated_path_starts_and_ends_at_cameras():
    poses = circle_poses(5)
    path = PATHS["interpolated"](poses, UP, 41)
    torch.testing.assert_close(path[0], poses[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(path[-1], poses[-1], atol=1e-6, rtol=0)


def test_test_views_come_as_png_with_depth_and_normals(run, tmp_path):
    files = render_run(run, tmp_path / "out", RenderConfig(depth=True, normals=True))
    assert sorted(path.name for path in files) == sorted(
        f"{view}_{kind}" for view in ("0000", "0008") for kind in ("color.png", "depth.png", "depth.npy", "normal.png")
    )
    picture = load_image(tmp_path / "out" / "0000_color.png")
    assert picture.shape == (24, 33, 3)
    torch.testing.assert_close(picture[0, 0], torch.tensor([0.0, 0.0, 1.0]), atol=0.1, rtol=0)
    depth = np.load(tmp_path / "out" / "0000_depth.npy")
    assert 1 < depth[12, 16] < 5


def test_opaque_pictures_are_those_of_a_mesh_viewer(run, tmp_path):
    render_run(run, tmp_path / "out", RenderConfig(opaque=True))
    camera = run.capture.cameras[0]
    expected = over_background(run.soup.render_opaque(camera)[0], torch.tensor([0.0, 0, 1]))
    torch.testing.assert_close(load_image(tmp_path / "out" / "0000_color.png"), expected, atol=0.51 / 255, rtol=0)


def test_depth_colours_are_red_near_blue_far_black_where_nothing_is():
    near, far, nothing = color_depth(torch.tensor([[1.0, 4.0, 0.0]]), (1.0, 4.0))[0]
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert float(nothing.sum()) == 0


def test_a_path_becomes_a_video_of_even_size_and_length(run, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    files = render_run(run, tmp_path / "out", RenderConfig(path="orbit", frames=6, depth=True, width=65))
    assert [path.name for path in files] == ["orbit_color.mp4", "orbit_depth.mp4"]
    told = subprocess.run([ffmpeg.get_ffmpeg_exe(), "-i", files[0]], capture_output=True, text=True, check=False).stderr
    assert "64x46" in told
    assert ffmpeg.count_frames_and_secs(str(files[0]))[0] == 6


def test_without_the_extra_frames_are_offered_and_nothing_is_left(run, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with (
        pytest.raises(InputError, match=r"etsplat\[video\].*with etsplat\.save_image$"),
        open_video(tmp_path / "a.mp4", 30),
    ):
        pass
    files = render_run(run, tmp_path / "out", RenderConfig(path="orbit", frames=2, format="frames"))
    assert [path.name for path in files] == ["orbit_0000_color.png", "orbit_0001_color.png"]
    assert videos.__doc__


def test_what_a_path_does_not_do_is_told(run, tmp_path):
    """An orbit of photos from one side goes there and back, and says so; others say nothing."""
    some = replace(run, capture=replace(run.capture, train=run.capture.train[:3]))
    told = []
    config = RenderConfig(path="orbit", frames=3, format="frames", width=16)
    render_run(some, tmp_path / "out", config, tell=told.append)
    assert len(told) == 1
    assert "there and back" in told[0]
    render_run(
        replace(run, capture=replace(run.capture, train=list(range(9)), test=[])), tmp_path, config, tell=told.append
    )
    assert len(told) == 1


@pytest.mark.parametrize("known", [True, False])
def test_a_recorded_path_is_played_also_without_the_capture(run, tmp_path, known):
    """In the shape of the photos, or the one that the file names."""
    aspect = None if known else 1.25
    keys = KeyPoses(circle_poses(2), torch.tensor([40.0, 50.0], dtype=torch.float64), aspect)
    (tmp_path / "my_way.json").write_text(keys.to_json())
    source = run if known else SoupRun(tmp_path / "soup.ply", run.soup, None)
    config = RenderConfig(path=str(tmp_path / "my_way.json"), frames=3, format="frames", width=50)
    files = render_run(source, tmp_path / "out", config)
    assert [path.name for path in files] == [f"my_way_{index:04d}_color.png" for index in range(3)]
    assert load_image(files[0]).shape == ((36 if known else 40), 50, 3)
    assert float(load_image(files[0])[..., :2].max()) > 0.2  # it looks at the soup


def test_a_path_that_there_is_not_is_refused_and_those_that_there_are_named():
    with pytest.raises(InputError, match=r"path: is 'orbti'; choose one of test, train, photos, .*, FILE\.json"):
        RenderConfig(path="orbti")
    assert RenderConfig(path="my_way.JSON").recorded
    assert RenderConfig(path="my_way.json").video


def test_a_file_without_its_scene_says_what_to_name(run, tmp_path):
    with pytest.raises(InputError, match=r"name the scene's folder with scene=$"):
        render_run(SoupRun(tmp_path / "soup.ply", run.soup, None), tmp_path / "out", RenderConfig())


def test_a_disk_that_fills_while_a_video_is_written_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\necho 'av_interleaved_write_frame(): No space left on device' >&2\nexit 228\n")
    broken.chmod(0o755)
    monkeypatch.setattr(ffmpeg, "get_ffmpeg_exe", lambda: str(broken))

    def write():
        with open_video(tmp_path / "a.mp4", 30) as append:
            for _ in range(50):
                append(torch.zeros(64, 64, 3))

    with pytest.raises(InputError, match=r"a\.mp4: No space left on device; free some space"):
        write()
    assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]


def test_what_is_drawn_is_what_would_be_exported(run, tmp_path):
    """Without the sky, cropped and cleaned; soft, opaque, and with depths, for which soft triangles are drawn too."""
    crop = Sphere((0.0, 0.0, 0.0), 0.5)
    inside = crop.holds(run.soup.vertices.detach().mean(dim=1))
    assert 0 < int(inside.sum()) < 40
    assert torch.equal(drawn_soup(run, RenderConfig(), crop).vertices, run.soup.vertices.detach()[inside])
    assert drawn_soup(run, RenderConfig()) is run.soup
    noted = replace(run, soup=replace(run.soup, notes={"sky": "0 0 0 1"}))
    assert len(drawn_soup(noted, RenderConfig(sky=False))) < 40
    assert len(drawn_soup(run, RenderConfig(clean=True, opaque=True))) <= 40
    faint = replace(run.soup, opacity_logits=torch.where(inside, -3.0, run.soup.opacity_logits.detach()))
    dim = replace(run, soup=faint)
    assert len(drawn_soup(dim, RenderConfig(opaque=True, depth=True), crop)) == int(inside.sum())
    with pytest.raises(InputError, match=r"nothing is left of it \(\d+ too faint, \d+ outside of the crop\)"):
        drawn_soup(dim, RenderConfig(opaque=True), crop)
    (written,) = render_run(
        replace(run, capture=replace(run.capture, test=[0])), tmp_path / "a", RenderConfig(), crop=crop
    )
    assert float((load_image(written) - torch.tensor([0.0, 0, 1])).abs().max()) > 0.1


def test_the_engine_of_the_run_draws(run: SoupRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its pictures are what it draws; where none is named, that of the device does."""
    noted = noted_engine(monkeypatch)
    plain = render_run(run, tmp_path / "plain", ALIASED)
    assert noted.pictures == 0
    drawn = render_run(replace(run, engine="noted"), tmp_path / "noted", ALIASED)
    assert noted.pictures == len(drawn) == len(plain)
    assert [path.read_bytes() for path in drawn] == [path.read_bytes() for path in plain]
