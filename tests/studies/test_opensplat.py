"""OpenSplat as a peer, a script standing in for its program: what it is given, and what is made of its PLY."""

import json
import math
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.io.ply_tables import encode_ply
from etsplat.metrics.image import psnr
from helpers import fake_gsplat
from helpers.captures import write_colmap
from studies import gsplat_on_cpu
from studies.opensplat import OpenSplat as Study
from studies.peers.opensplat import (
    BACKGROUND,
    OpenSplatRun,
    Program,
    check_capture,
    read_gaussians,
    write_project,
)
from studies.scenes.opensplat import fit_steps

PROPERTIES = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(9))]
PROPERTIES += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]

STAND_IN = """#!{python}
import json, pathlib, struct, sys
from PIL import Image
flags = [word for word in sys.argv if word in ("--cpu", "--keep-crs")]
words = [word for word in sys.argv[2:] if word not in flags]
options = dict(zip(words[::2], words[1::2]))
assert len(flags) == 2
project = pathlib.Path(sys.argv[1])
frames = json.loads((project / "transforms.json").read_text())["frames"]
output = pathlib.Path(options["--output"])
calls = output.parent.parent / "calls.json"
told = json.loads(calls.read_text()) if calls.exists() else []
calls.write_text(json.dumps([*told, [options, [frame["file_path"] for frame in frames]]]))
if "--val-render" in options:
    assert any(frame["file_path"] == "images/" + options["--val-image"] for frame in frames)
    size = Image.open(project / "images" / options["--val-image"]).size
    picture = pathlib.Path(options["--val-render"]) / (options["--num-iters"] + ".png")
    Image.new("RGB", size, {color}).save(picture)
values = [0.0] * {count}
values[{opacity}] = -20.0  # nothing of it is seen
values[-4] = 1.0
header = "".join("property float " + name + chr(10) for name in {properties})
text = "ply" + chr(10) + "format binary_little_endian 1.0" + chr(10) + "element vertex 5" + chr(10)
output.write_bytes((text + header + "end_header" + chr(10)).encode() + 5 * struct.pack("<{count}f", *values))
"""


def stand_in(folder: Path, color: tuple[float, ...] = BACKGROUND) -> Path:
    """A program that makes five Gaussians that nobody sees, and a picture of one colour."""
    path = folder / "opensplat"
    text = STAND_IN.format(
        python=sys.executable,
        color=tuple(math.floor(255 * value) for value in color),
        count=len(PROPERTIES),
        opacity=PROPERTIES.index("opacity"),
        properties=PROPERTIES,
    )
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@pytest.fixture
def capture_folder(tmp_path: Path) -> Path:
    write_colmap(tmp_path / "toy", [(48, 36)] * 9, model="SIMPLE_PINHOLE")
    return tmp_path / "toy"


def study(folder: Path, capture: Path, *more: str) -> list[str]:
    options = ["--scenes", f"{capture}:indoor", "--out", str(folder / "out"), "--preset", "tiny"]
    return [*options, "--set", "iterations=6,schedule.max_epochs=none,width=24", *more]


def test_the_study_runs_both_and_compares_them_on_the_same_photos(tmp_path, capture_folder, monkeypatch):
    monkeypatch.setattr(gsplat_on_cpu, "load_gsplat_on_cpu", lambda: (fake_gsplat, torch.device("cpu")))
    options = study(tmp_path, capture_folder, "--opensplat", str(stand_in(tmp_path)))
    assert Study.parse(options).run(options) == 0
    (found,) = json.loads((tmp_path / "out" / "opensplat.json").read_text())["scenes"]
    assert found["agreement"] > 60
    assert found["ours"]["iterations"] == found["equal_steps"]["steps"] == 6
    assert (found["equal_steps"]["gaussians"], found["equal_steps"]["processor_seconds"] > 0) == (5, True)
    capture = load_dataset(capture_folder, width=24)
    photos = [capture.images[view].float() / 255 for view in capture.test]
    plain = torch.tensor(BACKGROUND).expand_as(photos[0])
    expected = sum(psnr(plain, photo) for photo in photos) / len(photos)
    assert found["equal_seconds"]["psnr"] == pytest.approx(expected, abs=1e-3)
    calls = json.loads((tmp_path / "out" / "runs" / "toy" / "opensplat" / "calls.json").read_text())
    (check, checked), (run, trained) = calls[0], calls[-1]
    assert (check["--val-image"], len(checked), len(trained)) == (f"{capture.test[0]:05d}.png", 8, 7)
    assert trained == [f"images/{view:05d}.png" for view in capture.train]
    assert run["--num-iters"] == "6"
    assert {name: run[f"--{name}"] for name in ("resolution-schedule", "warmup-length")} == {
        "resolution-schedule": "1",
        "warmup-length": "100",
    }
    text = (tmp_path / "out" / "opensplat.md").read_text()
    assert "| toy | OpenSplat, equal steps | 6 |" in text


def test_a_project_holds_the_same_photos_cameras_and_points(tmp_path, capture_folder):
    capture = load_dataset(capture_folder, width=24).normalized()
    again = load_dataset(write_project(tmp_path / "project", capture, capture.train))
    assert again.images.sizes == [(24, 18)] * len(capture.train)
    for index, view in enumerate(capture.train):
        assert torch.equal(again.images[index], capture.images[view])
    torch.testing.assert_close(again.viewmats, capture.viewmats[capture.train])
    torch.testing.assert_close(again.Ks, capture.Ks[capture.train])
    torch.testing.assert_close(again.points, capture.points)
    torch.testing.assert_close(again.point_colors, capture.point_colors, atol=1 / 255, rtol=0)


def test_gaussians_are_read_by_their_names(tmp_path):
    table = np.zeros(2, [(name, "f4") for name in PROPERTIES])
    for index, name in enumerate(PROPERTIES):
        table[name] = [index, index + 100]
    (tmp_path / "splat.ply").write_bytes(encode_ply({"vertex": table}, ["Generated by a test"]))
    gaussians = read_gaussians(tmp_path / "splat.ply")
    assert gaussians["means"][1].tolist() == [100, 101, 102]
    assert gaussians["sh0"][0].tolist() == [[6, 7, 8]]
    assert gaussians["shN"][0].tolist() == [[9, 12, 15], [10, 13, 16], [11, 14, 17]]  # all of red comes first
    assert gaussians["opacities"].tolist() == [18, 118]
    assert gaussians["scales"][0].tolist() == [19, 20, 21]
    assert gaussians["quats"][0].tolist() == [22, 23, 24, 25]
    (tmp_path / "splat.ply").write_bytes(encode_ply({"vertex": table[:0]}))
    with pytest.raises(InputError, match="holds no Gaussians"):
        read_gaussians(tmp_path / "splat.ply")


def test_a_program_that_draws_otherwise_is_refused(tmp_path, capture_folder, monkeypatch):
    monkeypatch.setattr(gsplat_on_cpu, "load_gsplat_on_cpu", lambda: (fake_gsplat, torch.device("cpu")))
    options = study(tmp_path, capture_folder, "--opensplat", str(stand_in(tmp_path, (0.5, 0.1, 0.4))))
    with pytest.raises(InputError, match=r"50\.png is 2.\.. dB from its Gaussians .* \.contiguous\(\)"):
        Study.parse(options).run(options)


def test_what_cannot_be_run_is_said_before_anything_runs(tmp_path, capture_folder, monkeypatch):
    monkeypatch.setattr(gsplat_on_cpu, "load_gsplat_on_cpu", lambda: (fake_gsplat, torch.device("cpu")))
    options = study(tmp_path, capture_folder)
    with pytest.raises(InputError, match=r"name its program; build OpenSplat .* -DGPU_RUNTIME=CPU"):
        Study.parse(options).run(options)
    with pytest.raises(InputError, match="no program that can be run"):
        Program(tmp_path / "none", fake_gsplat, 1, "scaled")
    write_colmap(tmp_path / "off", [(48, 36)] * 9)  # by a pixel
    options = study(tmp_path, tmp_path / "off", "--opensplat", str(stand_in(tmp_path)))
    with pytest.raises(InputError, match=r"scene off: has principal points up to 0\.5 pixels off the middle"):
        Study.parse(options).run(options)
    assert not (tmp_path / "out").exists()
    write_colmap(tmp_path / "bare", [(48, 36)] * 9, points=0, model="SIMPLE_PINHOLE")
    with pytest.raises(InputError, match="scene bare: has no points"):
        check_capture("bare", load_dataset(tmp_path / "bare"))


def test_a_program_that_fails_is_named_with_its_log(tmp_path):
    path = tmp_path / "opensplat"
    path.write_text(f"#!{sys.executable}\nraise SystemExit('no such scene')\n")
    path.chmod(0o755)
    program = Program(path, fake_gsplat, 1, "own")
    with pytest.raises(InputError, match=r"failed with status 1; .*log\.txt says why"):
        program.start(tmp_path, tmp_path / "run", 10)
    assert "no such scene" in (tmp_path / "run" / "log.txt").read_text()


def test_steps_are_fitted_to_seconds():
    """A run takes a second and the time of its steps, which grows faster than their number."""
    made = []

    def train(steps: int) -> OpenSplatRun:
        made.append(steps)
        seconds = 1 + 0.01 * steps**1.2
        return OpenSplatRun(steps, seconds, seconds, 1, 0.0, 0.0)

    found = fit_steps(train, 100, 60.0)
    assert found.processor_seconds == pytest.approx(60, rel=0.05)
    assert len(made) <= 3
    assert fit_steps(train, found.steps, found.processor_seconds) == found
    assert len(made) <= 4
