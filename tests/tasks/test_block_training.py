"""A run in blocks: each block is a run that goes on where it was, and together they are one soup without seams."""

import shutil
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import etsplat
from etsplat.core.errors import InputError
from etsplat.data.blocks import cut
from etsplat.data.dataset import Dataset
from etsplat.data.where_up import up_of
from etsplat.io.run_directory import RunDirectory
from etsplat.io.tensors import read_tensors, save_tensors
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.loop import DivergedError, NoteEvent, StageEvent
from etsplat.optim.trainer import Trainer
from etsplat.tasks import block_training, train_memory
from etsplat.tasks import train as tasks_train
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.scene_part import ScenePart
from etsplat.tasks.train import TrainResult, train
from etsplat.tasks.train_config import TrainConfig
from helpers.captures import small_demo_scene

CONFIG = TrainConfig.tiny().changed(
    {"iterations": 24, "output.log_every": 4, "output.checkpoint_every": 8, "sky": "sphere", "max_triangles": 700}
)


@pytest.fixture(scope="module")
def capture() -> Dataset:
    return small_demo_scene()


@pytest.fixture(scope="module")
def run(capture: Dataset, tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainResult, list[object]]:
    events: list[object] = []
    out = tmp_path_factory.mktemp("blocks") / "run"
    return train(capture, out, CONFIG, blocks="2x1", callbacks=[events.append]), events


def triangles(soup: TriangleSoup) -> torch.Tensor:
    return soup.vertices.detach()


def test_each_triangle_is_of_the_block_in_which_its_middle_lies(
    run: tuple[TrainResult, list[object]], capture: Dataset
) -> None:
    """Of every block's run exactly what lies in its cell, without margins, and the sky's run; nothing is coarse."""
    result = run[0]
    grid = cut(capture, (2, 1), up_of(capture))
    sky = Surroundings.of_note(result.soup.notes["sky"])
    assert sky is not None
    kept, dropped = [], 0
    for block in range(2):
        own = TriangleSoup.load(result.path / "blocks" / grid.name(block) / "soup.safetensors")
        inside = grid.block_of(triangles(own).double().mean(dim=1)) == block
        dropped += int((~inside).sum())
        kept.append(triangles(own)[inside & ~sky.outermost(triangles(own))])
    kept.append(triangles(TriangleSoup.load(result.path / "blocks" / "sky" / "soup.safetensors")))
    assert torch.equal(triangles(result.soup), torch.cat(kept))
    assert dropped > 0
    assert result.soup.count == result.metrics["triangles"]


def test_the_run_is_one_for_all_that_comes_after(run: tuple[TrainResult, list[object]], capture: Dataset) -> None:
    """Its folder opens, exports and is reported; it is better than its coarse soup, and has a sky all around."""
    result, path = run[0], run[0].path
    opened = open_run(path)
    assert torch.equal(triangles(opened.soup), triangles(result.soup))
    export_soup(opened, path / "out.glb", ExportConfig(sky="none", min_opacity=0.05))
    assert (path / "out.glb").is_file()
    etsplat.write_report(path)
    assert (path / "report.html").is_file()
    blocks = {each["name"]: each for each in result.metrics["blocks"]}
    assert list(blocks) == ["coarse", "0_0", "1_0", "sky"]
    kept = sum(blocks[name]["triangles"] for name in ("0_0", "1_0", "sky"))
    assert kept == result.soup.count
    assert result.metrics["psnr"] > blocks["coarse"]["psnr"] - 0.5
    assert result.metrics["iterations"] == 12 + 24 + 24 + 24
    assert RunDirectory(path).read_iterations() == 12 + 24 + 24 + 24
    assert "sky" in result.soup.notes
    whole = TriangleSoup.load(path / "blocks" / "coarse" / "soup.safetensors")
    assert result.soup.notes["sky"] == whole.notes["sky"]
    assert len(result.metrics["test_views"]) == len(capture.test)


def test_faint_soups_of_blocks_are_not_to_be_trained_with_an_opaque_mesh(run: tuple[TrainResult, list[object]]) -> None:
    with pytest.raises(InputError, match='lower min_opacity, or train with finish="opaque"; no opaque mesh is made'):
        export_soup(open_run(run[0].path), run[0].path / "faint.glb", ExportConfig(min_opacity=1.0))


def test_what_is_there_and_needed_is_said_beforehand(run: tuple[TrainResult, list[object]]) -> None:
    notes = [event.text for event in run[1] if isinstance(event, NoteEvent)]
    assert notes[0].startswith("2 blocks of ")
    assert "bytes for each of" in notes[0]
    stages = [event.name for event in run[1] if isinstance(event, StageEvent)]
    assert list(dict.fromkeys(stages)) == [f"Optimizing {name}" for name in ("coarse", "0_0", "1_0", "sky")]


def stop_in(name: str, iteration: int) -> Callable[[object], None]:
    def callback(event: object) -> None:
        if isinstance(event, StageEvent) and event.name.endswith(name) and event.done >= iteration:
            raise RuntimeError("killed")

    return callback


@pytest.mark.parametrize("name", ["coarse", "1_0", "sky"])
def test_a_run_that_is_killed_in_a_block_goes_on_there(
    run: tuple[TrainResult, list[object]], capture: Dataset, tmp_path: Path, name: str
) -> None:
    """To the same bits; blocks that are done are not made again."""
    out = tmp_path / "run"
    with pytest.raises(RuntimeError, match="killed"):
        train(capture, out, CONFIG, blocks="2x1", callbacks=[stop_in(name, 12)])
    if name != "coarse":
        assert open_run(out).soup.count > 0  # what is there can be looked at and exported meanwhile
    done = out / "blocks" / "0_0" / "metrics.json"
    before = done.stat().st_mtime_ns if done.is_file() else None
    result = train(capture, out, CONFIG, blocks="2x1", resume=True)
    if before is not None:
        assert done.stat().st_mtime_ns == before
    assert (before is None) == (name == "coarse")
    for parameter, wanted in run[0].soup.state().items():
        assert torch.equal(result.soup.state()[parameter], wanted)


def test_resuming_takes_the_same_blocks_and_settings(
    run: tuple[TrainResult, list[object]], capture: Dataset, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    shutil.copytree(run[0].path, out)
    with pytest.raises(InputError, match="was started with"):
        train(capture, out, CONFIG, blocks="1x2", resume=True)
    with pytest.raises(InputError, match="was started with"):
        train(capture, out, replace(CONFIG, seed=5), blocks="2x1", resume=True)
    with pytest.raises(InputError, match="was started with"):
        train(capture, out, CONFIG, resume=True)


def test_exposures_are_shared(capture: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the coarse run learned of each photo holds in all blocks, which learn none of their own."""
    known = []
    inner = block_training._part

    def spy(*arguments):
        part = inner(*arguments)
        known.append(part.exposure)
        return part

    monkeypatch.setattr(block_training, "_part", spy)
    config = CONFIG.changed({"exposure": "on", "iterations": 16})
    result = train(capture, tmp_path / "run", config, blocks="2x1")
    shared = RunDirectory(result.path).read_exposure()["matrices"]
    assert set(shared) == {capture.names[view] for view in capture.watching(None).train}
    assert max(abs(shared[name][0][0] - 1) for name in shared) > 1e-4
    for name in ("0_0", "1_0", "sky"):
        own = RunDirectory(result.path / "blocks" / name).read_exposure()["matrices"]
        assert all(torch.allclose(torch.tensor(own[each]), torch.tensor(shared[each])) for each in own)
    assert len(known) == 2


def test_what_needs_more_than_there_is_is_refused_before_the_first_step(
    capture: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one block, and of all together at the end."""
    large = replace(CONFIG, max_triangles=50_000_000, pixels_per_triangle=None)
    monkeypatch.setattr(train_memory, "available_memory", lambda: 1 << 30)
    with pytest.raises(InputError, match=r"max_triangles: 50,000,000 .*set it to \d+ or less"):
        train(capture, tmp_path / "run", large, blocks="2x1")
    monkeypatch.setattr(train_memory, "available_memory", lambda: 1 << 40)
    monkeypatch.setattr(block_training, "available_memory", lambda: 1 << 30)
    with pytest.raises(InputError, match="all blocks may have 100,000,000 triangles"):
        train(capture, tmp_path / "run", large, blocks="2x1")
    assert not (tmp_path / "run").exists()


def test_what_cannot_be_done_in_blocks_is_refused(capture: Dataset, tmp_path: Path) -> None:
    refined = CONFIG.changed({"refine_cameras": "poses"})
    with pytest.raises(InputError, match="refine_cameras: cannot be done in blocks"):
        train(capture, tmp_path / "run", refined, blocks="2x1")
    with pytest.raises(InputError, match="view: cannot be done in blocks"):
        train(capture, tmp_path / "run", CONFIG, blocks="2x1", onlooker=lambda *_: None)
    with pytest.raises(InputError, match="blocks: is many"):
        train(capture, tmp_path / "run", CONFIG, blocks="many")


def test_one_block_is_an_ordinary_run(capture: Dataset, tmp_path: Path) -> None:
    """Where auto finds that one is enough."""
    few = replace(CONFIG, iterations=4, max_triangles=5000)
    result = train(capture, tmp_path / "run", few, blocks="auto")
    assert "blocks" not in result.metrics
    assert not (tmp_path / "run" / "blocks").exists()


def test_a_run_that_is_done_leaves_nothing_in_memory(
    capture: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the next begins its trainer is gone, so that memory is that of one block."""
    alive: list[weakref.ref[Trainer[TriangleSoup]]] = []
    inner = tasks_train.start_trainer

    def spy(*arguments):
        assert all(trainer() is None for trainer in alive)
        trainer = inner(*arguments)
        alive.append(weakref.ref(trainer))
        return trainer

    monkeypatch.setattr(tasks_train, "start_trainer", spy)
    train(capture, tmp_path / "run", CONFIG.changed({"iterations": 4}), blocks="2x1")
    assert len(alive) == 4


def test_blocks_leave_the_sky_alone_and_it_learns_among_them(
    run: tuple[TrainResult, list[object]], capture: Dataset, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Blocks draw all of the coarse sky and start without it; its own run starts from it, among all that they made."""
    parts: list[ScenePart] = []
    inner = tasks_train.start_trainer

    def spy(*arguments):
        if arguments[-1] is not None:
            parts.append(arguments[-1])
        return inner(*arguments)

    monkeypatch.setattr(tasks_train, "start_trainer", spy)
    train(capture, tmp_path / "run", CONFIG, blocks="2x1")
    *blocks, last = parts
    whole = TriangleSoup.load(run[0].path / "blocks" / "coarse" / "soup.safetensors")
    sky = last.closed
    assert sky is not None
    coarse = triangles(whole)[sky.outermost(triangles(whole))]
    assert len(blocks) == 2
    for part in blocks:
        assert part.start is None
        assert torch.equal(triangles(part.rest)[sky.outermost(triangles(part.rest))], coarse)
    assert last.start is not None
    assert torch.equal(triangles(last.start), coarse)
    assert not bool(sky.outermost(triangles(last.rest)).any())
    learned = TriangleSoup.load(tmp_path / "run" / "blocks" / "sky" / "soup.safetensors")
    assert torch.equal(triangles(run[0].soup), torch.cat([triangles(last.rest), triangles(learned)]))
    assert float((learned.sh_dc.mean(dim=0) - last.start.sh_dc.mean(dim=0)).norm()) > 0


def test_what_the_blocks_made_is_recolored_with_the_sky_and_nothing_else(
    run: tuple[TrainResult, list[object]], capture: Dataset
) -> None:
    """Plain colours of the result are those that the last run learned; all other numbers are of the blocks."""
    grid, path = cut(capture, (2, 1), up_of(capture)), run[0].path / "blocks"
    sky = Surroundings.of_note(run[0].soup.notes["sky"])
    assert sky is not None
    kept = []
    for block in range(2):
        own = TriangleSoup.load(path / grid.name(block) / "soup.safetensors")
        inside = grid.block_of(triangles(own).double().mean(dim=1)) == block
        kept.append(own.kept(inside & ~sky.outermost(triangles(own))))
    count = sum(map(len, kept))
    learned = read_tensors(path / "sky" / "around.safetensors")[0]["sh_dc"]
    for name, values in run[0].soup.state().items():
        before = torch.cat([soup.state()[name] for soup in kept])
        assert torch.equal(values[:count], learned if name == "sh_dc" else before)
        assert name != "sh_dc" or not torch.equal(learned, before)


def test_colors_that_are_lost_are_named(
    run: tuple[TrainResult, list[object]], capture: Dataset, tmp_path: Path
) -> None:
    """The run of the sky is done, but of what it gave the rest nothing is there, or other than it should be."""
    out = tmp_path / "run"
    shutil.copytree(run[0].path, out)
    (out / "metrics.json").unlink()
    around = out / "blocks" / "sky" / "around.safetensors"
    save_tensors(around, {"sh_dc": torch.zeros(3, 1, 3)})
    with pytest.raises(InputError, match=r"around\.safetensors: cannot be read \(of 3 triangles, not"):
        train(capture, out, CONFIG, blocks="2x1", resume=True)
    around.unlink()
    with pytest.raises(InputError, match=r"around\.safetensors: cannot be read"):
        train(capture, out, CONFIG, blocks="2x1", resume=True)


def test_a_scene_without_a_sky_has_no_run_for_it(capture: Dataset, tmp_path: Path) -> None:
    result = train(capture, tmp_path / "run", CONFIG.changed({"iterations": 8, "sky": "none"}), blocks="2x1")
    assert [each["name"] for each in result.metrics["blocks"]] == ["coarse", "0_0", "1_0"]
    assert result.metrics["iterations"] == 4 + 8 + 8
    assert RunDirectory(result.path).read_iterations() == 4 + 8 + 8


def test_a_sky_that_cannot_be_learned_stays_as_the_coarse_run_left_it(
    run: tuple[TrainResult, list[object]], capture: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the blocks hide all of it: the result is what they made, and a note says why."""
    inner = tasks_train.start_trainer

    def spy(*arguments):
        if arguments[-1] is not None and arguments[-1].start is not None:
            raise DivergedError("no triangle is left")
        return inner(*arguments)

    monkeypatch.setattr(tasks_train, "start_trainer", spy)
    events: list[object] = []
    result = train(capture, tmp_path / "run", CONFIG, blocks="2x1", callbacks=[events.append])
    notes = [event.text for event in events if isinstance(event, NoteEvent)]
    assert "the sky stays as the coarse run left it: no triangle is left" in notes
    sky = Surroundings.of_note(result.soup.notes["sky"])
    assert sky is not None
    whole = triangles(TriangleSoup.load(result.path / "blocks" / "coarse" / "soup.safetensors"))
    assert torch.equal(triangles(result.soup)[sky.outermost(triangles(result.soup))], whole[sky.outermost(whole)])
    ground = triangles(run[0].soup)[: -run[0].metrics["blocks"][-1]["triangles"]]
    assert torch.equal(triangles(result.soup)[~sky.outermost(triangles(result.soup))], ground)
