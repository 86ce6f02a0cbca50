"""The safety net catches what it is there for: one bit of a tensor, a pixel, a number; and its table is true."""

import json
import re
import shutil
import struct
import sys

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import load_file, save_file

from equal_bits import names
from equal_bits.cases import CASES, CONTROLS
from equal_bits.compare import array_difference, compare_runs, matched
from equal_bits.names import Names, translated
from equal_bits.session import flip_bit
from equal_bits.trees import names_of
from etsplat.cli.parse import parse

TENSORS = {"vertices": np.linspace(-1, 1, 27, dtype=np.float32).reshape(3, 3, 3), "progress": np.array([1.5, 3.0])}
METRICS = {"psnr": 20.25, "seconds": 1.0, "test_views": [{"name": "a", "psnr": 1 / 3}], "lpips": None}


@pytest.fixture
def runs(tmp_path):
    """Two run directories alike but for the clock."""
    folders = [tmp_path / "base", tmp_path / "here"]
    for seconds, run in enumerate(folders):
        (run / "test").mkdir(parents=True)
        (run / "checkpoints").mkdir()
        save_file({**TENSORS, "progress": np.array([seconds, 3.0])}, run / "checkpoints" / "step_000010.safetensors")
        save_file(TENSORS, run / "soup.safetensors")
        (run / "mesh.obj").write_text("v 0 0 1\n")
        Image.fromarray(np.full((4, 5, 3), 7, np.uint8)).save(run / "test" / "000_render.png")
        (run / "metrics.json").write_text(json.dumps({**METRICS, "seconds": float(seconds)}))
        (run / "history.jsonl").write_text(json.dumps({"iteration": 1, "loss": 0.1, "seconds": seconds}) + "\n")
    return folders


def differing(runs):
    """The columns that differ, with their texts."""
    return {column: texts for column, texts in compare_runs(*runs).items() if texts}


def test_runs_that_differ_in_their_clocks_alone_are_equal(runs):
    assert differing(runs) == {}


@pytest.mark.parametrize("file", ["soup.safetensors", "checkpoints/step_000010.safetensors"])
def test_one_flipped_bit_of_a_tensor_is_found_and_named(runs, file):
    flip_bit(runs[1] / file, "vertices")
    (text,) = differing(runs)["parameters"]
    assert "vertices: 1 of 27 differ" in text
    assert "first [0, 1, 0]" in text


def test_flip_bit_changes_the_last_bit_of_one_number(tmp_path):
    save_file(TENSORS, tmp_path / "a.safetensors")
    flip_bit(tmp_path / "a.safetensors", "vertices")
    changed = load_file(tmp_path / "a.safetensors")["vertices"].view(np.uint32)
    difference = (changed ^ TENSORS["vertices"].view(np.uint32)).reshape(-1)
    assert sorted(difference.tolist()) == [0] * 26 + [1]


def test_one_step_of_one_pixel_is_found(runs):
    pixels = np.full((4, 5, 3), 7, np.uint8)
    pixels[2, 3, 1] += 1
    Image.fromarray(pixels).save(runs[1] / "test" / "000_render.png")
    (text,) = differing(runs)["images"]
    assert text.startswith("test/000_render.png: pixels: 1 of 60 differ, by 1 at most; first [2, 3, 1]: 7 in BASE, 8")


def test_one_bit_of_a_loss_or_of_a_nested_score_is_found(runs):
    loss = float(np.nextafter(0.1, 1))
    (runs[1] / "history.jsonl").write_text(json.dumps({"iteration": 1, "loss": loss, "seconds": 1}) + "\n")
    views = [{"name": "a", "psnr": float(np.nextafter(1 / 3, 0))}]
    (runs[1] / "metrics.json").write_text(json.dumps({**METRICS, "test_views": views}))
    first, second = differing(runs)["history"]
    assert first == f"history.jsonl[0]: loss: 0.1 in BASE, {loss!r} here"
    assert second.startswith("metrics.json: test_views[0]: psnr: 0.333")


@pytest.mark.parametrize(("change", "found"), [(1e-15, False), (1e-9, True)])
def test_numbers_that_are_rounded_differ_only_by_more_than_that(runs, change, found):
    for score, run in zip((0.75, 0.75 + change), runs, strict=True):
        (run / "metrics.json").write_text(json.dumps({**METRICS, "ssim": score}))
    assert ("history" in differing(runs)) is found


def test_one_byte_of_a_mesh_file_is_found(runs):
    (runs[1] / "mesh.obj").write_text("v 0 0 2\n")
    assert differing(runs)["parameters"] == [
        "mesh.obj: bytes: 1 of 8 differ, by 1 at most; first [6]: 49 in BASE, 50 here"
    ]


def test_what_only_one_run_has_is_found(runs):
    (runs[0] / "mesh.obj").unlink()
    (runs[1] / "test" / "000_render.png").rename(runs[1] / "test" / "001_render.png")
    (runs[1] / "history.jsonl").write_text("")
    found = differing(runs)
    assert found["parameters"] == ["mesh.obj: only here"]
    assert found["images"] == [
        "images: test/000_render.png: not here as test/000_render.png",
        "images: test/001_render.png: not in BASE",
    ]
    assert found["history"] == ["history.jsonl: 1 entries in BASE, 0 here"]


def test_a_run_without_images_is_not_equal_to_another(runs):
    for run in runs:
        (run / "test" / "000_render.png").unlink()
    assert differing(runs) == {"images": ["test/: no images in BASE"]}


@pytest.mark.parametrize(
    ("base", "here"),
    [
        (np.float32([0.0]), np.float32([-0.0])),
        (np.float32([1.0]), np.float64([1.0])),
        (np.float32([[1.0]]), np.float32([1.0])),
        (np.int64([1]), np.int64([2])),
        (np.array([True]), np.array([False])),
        (np.float32(1.0), np.float32(2.0)),
    ],
)
def test_array_difference_sees_signs_of_zero_kinds_and_shapes(base, here):
    assert array_difference(np.asarray(base), np.asarray(here))
    assert array_difference(np.asarray(here), np.asarray(here)) is None


def test_equal_nan_are_equal_and_others_are_not():
    nan = np.frombuffer(struct.pack("<II", 0x7FC00000, 0x7FC00001), "<f4")
    assert array_difference(nan[:1], nan[:1]) is None
    assert array_difference(nan[:1], nan[1:]) is not None


def test_names_pair_what_was_renamed_and_report_the_rest():
    table = Names({r"soup\.(.*)": r"model.\1"}, gone=frozenset({"old"}), added=frozenset({"new"}))
    pairs, unmatched = matched({"soup.a": 1, "old": 2, "x": 3}, {"model.a": 4, "new": 5, "y": 6}, table, "file")
    assert pairs == [("model.a", 1, 4)]
    assert unmatched == ["file: x: not here as x", "file: y: not in BASE"]


def test_options_are_translated_alone_and_with_their_value(monkeypatch):
    monkeypatch.setitem(names.OPTIONS, "train", {"--a": "--b.a", "--flag": "--kind round", "--c 1": "", "--c": "--d"})
    words = ["--a", "1", "--flag", "--c", "1", "--c", "2", "--e", "3"]
    assert " ".join(translated("train", words)) == "--b.a 1 --kind round --d 2 --e 3"


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_case_is_a_command_line_of_this_tree(case):
    parse([*case.command.split(), *translated(case.task, case.options.split()), "--out", "nowhere", "--resume"])


@pytest.mark.parametrize("task", ["reconstruct", "train"])
def test_every_line_of_the_table_names_an_option_that_exists(task, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        parse([task, "--help-all"])
    known = set(re.findall(r"--[a-z][a-z.-]*", capsys.readouterr().out))
    here = {word for new in names.OPTIONS[task].values() for word in new.split() if word.startswith("--")}
    assert here - known == set()


def test_a_later_base_has_names_of_its_own(tmp_path, monkeypatch):
    """By which the cases are translated for it; an earlier one has none."""
    assert names_of(tmp_path) is None
    folder = tmp_path / "tree" / "tests" / "equal_bits"
    folder.mkdir(parents=True)
    shutil.copy(names.__file__, folder)
    with (folder / "names.py").open("a") as file:
        file.write('OPTIONS["train"]["--growth"] = "--densification.faster"\n')
    monkeypatch.setitem(sys.modules, "names_of_base", None)
    found = names_of(tmp_path)
    assert found is not None
    assert found.translated("train", ["--growth", "2"]) == ["--densification.faster", "2"]
    assert translated("train", ["--growth", "2"]) == ["--densification.growth", "2"]


def test_names_of_cases_are_unique_and_those_in_other_tables_exist():
    assert len({case.name for case in CASES}) == len(CASES)
    assert {*names.CHANGED, *CONTROLS} <= {case.name for case in CASES}
