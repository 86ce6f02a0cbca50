"""A small soup from photos: it fits, it resumes to the bit, and it says what is wrong."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset, Normalization
from etsplat.data.pictures import StoredPictures
from etsplat.data.shown_width import shown_width
from etsplat.io.run_directory import RunDirectory
from etsplat.model.surroundings import SPHERE_TRIANGLES, Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.loop import CheckpointEvent, DivergedError, NoteEvent, RefineEvent, StepEvent
from etsplat.optim.schedules import at
from etsplat.optim.strategies import DensifyAndPrune
from etsplat.optim.trainer import Trainer
from etsplat.tasks.pixel_limits import random_count, triangle_limit
from etsplat.tasks.soup_trainer import FASTEST, SLOWEST, start_trainer, vertex_paces
from etsplat.tasks.train import TrainResult, train
from etsplat.tasks.train_checks import check_train
from etsplat.tasks.train_config import TrainConfig
from helpers.captures import small_demo_scene

TINY = TrainConfig.tiny().changed(
    {"iterations": 120, "output.log_every": 10, "output.checkpoint_every": 30, "output.evaluate_every": 60}
)
SHORT = TINY.changed(
    {
        "iterations": 40,
        "output.checkpoint_every": 10,
        "max_triangles": 600,
        "densification.every": 3000,
        "schedule.sh_every": 3000,
    }
)


@pytest.fixture(scope="module")
def capture() -> Dataset:
    return small_demo_scene()


@pytest.fixture(scope="module")
def run(capture: Dataset, tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainResult, list[object]]:
    events: list[object] = []
    config = TINY.changed({"iterations": 200})  # after 120 what a seed changes is as much as what the last of them gain
    return train(capture, tmp_path_factory.mktemp("soup") / "run", config, callbacks=[events.append]), events


def stop_at(iteration: int) -> Callable[[object], None]:
    def callback(event: object) -> None:
        if isinstance(event, CheckpointEvent) and event.iteration >= iteration:
            raise RuntimeError("killed")

    return callback


def test_a_soup_is_fitted(run: tuple[TrainResult, list[object]]) -> None:
    """The test views are closer to the truth than at the first evaluation, and the loss has fallen."""
    history = RunDirectory(run[0].path).read_history()
    psnrs = [line["psnr"] for line in history if "psnr" in line]
    assert run[0].metrics["psnr"] == pytest.approx(psnrs[-1])
    assert psnrs[-1] > psnrs[0]
    assert psnrs[-1] > 14.4  # seeds 0 to 3 end at 14.6 to 15.0
    assert history[-1]["loss"] < 0.85 * history[0]["loss"]


def test_a_run_directory_holds_everything(run: tuple[TrainResult, list[object]]) -> None:
    """The soup in the scene's units, metrics with the opaque PSNR, quantiles over time, and pictures."""
    result = run[0]
    directory = RunDirectory(result.path)
    saved = TriangleSoup.load(directory.soup_path)
    assert torch.equal(saved.vertices, result.soup.vertices)
    assert saved.appearance.kernel == "elastic"
    assert float(result.soup.vertices.detach().median(dim=0).values.abs().max()) < 5
    keys = "psnr ssim flip psnr_opaque flip_opaque triangles seconds test_views"
    assert set(keys.split()) <= result.metrics.keys()
    assert len(result.metrics["test_views"]) == 6
    line = directory.read_history()[-1]
    assert line["sigma_10"] <= line["sigma"] <= line["sigma_90"]
    assert line["opacity_10"] <= line["opacity"] <= line["opacity_90"]
    for kind in ("render", "truth", "opaque"):
        assert (directory.test / f"005_{kind}.png").exists()
    assert "soup.safetensors" in (result.path / "README.txt").read_text()


def test_triangles_multiply_up_to_the_cap(run: tuple[TrainResult, list[object]]) -> None:
    """Densification is announced, grows by the factor at most, and stops at the cap."""
    counts = [event.count for event in run[1] if isinstance(event, RefineEvent)]
    assert len(counts) > 5
    assert max(counts) <= TINY.max_triangles
    assert counts[-1] > 420
    for before, after in pairwise(counts):
        assert after <= 1.3 * before


@pytest.mark.parametrize("killed_at", [10, 30])
def test_a_killed_run_ends_with_the_same_bits(capture: Dataset, tmp_path: Path, killed_at: int) -> None:
    """Resumed before and after densifications, soup, metrics and history are those of a run that was never killed."""
    whole = train(capture, tmp_path / "whole", SHORT)
    with pytest.raises(RuntimeError, match="killed"):
        train(capture, tmp_path / "killed", SHORT, callbacks=[stop_at(killed_at)])
    resumed = train(capture, tmp_path / "killed", SHORT, resume=True)
    for name, parameter in whole.soup.parameters().items():
        assert torch.equal(parameter, resumed.soup.parameters()[name]), name
    histories = [RunDirectory(tmp_path / name).read_history() for name in ("whole", "killed")]
    for lines in zip(*histories, strict=True):
        assert {**lines[0], "seconds": 0} == {**lines[1], "seconds": 0}


@pytest.mark.parametrize("method", ["single-sided", "bilateral"])
@pytest.mark.parametrize("scene_type", ["indoor", "object"])
def test_other_kernels_and_scenes_fit_too(capture: Dataset, tmp_path: Path, method: str, scene_type: str) -> None:
    """All five losses of the paper's settings go down with every kernel, with small triangles left out."""
    paper = TrainConfig.of("paper", scene_type).loss
    config = SHORT.changed(
        {
            "method": method,
            "scene_type": scene_type,
            "drawing.cull_small": True,
            "normalize": False,
            "loss.regularize_from": 10,
            "loss.lambda_depth_normal": paper.lambda_depth_normal,
            "loss.lambda_distortion": paper.lambda_distortion,
            "loss.lambda_size": paper.lambda_size,
            "background": "random",
        }
    )
    events: list[object] = []
    train(capture, tmp_path / "run", config, callbacks=[events.append])
    losses = [event.loss for event in events if isinstance(event, StepEvent)]
    assert losses[-1] < losses[0]


def test_fewer_photos_hold_colours_of_directions_more(capture: Dataset) -> None:
    """The weight is shared by the photos; preset paper and colours for all directions have no such term."""

    def weights(config: TrainConfig, photos: int) -> dict[str | None, float]:
        objective = start_trainer(replace(capture, train=capture.train[:photos]), config)._objective
        return {term.name: at(term.weight, 1) for term in objective.terms}

    few, many = (weights(TINY, photos)["harmonics"] for photos in (3, 12))
    assert few == pytest.approx(4 * many) == pytest.approx(2.0 / 3)
    assert weights(TrainConfig.paper(), 3)["harmonics"] == 0.0
    assert "harmonics" not in weights(TINY.changed({"drawing.sh_degree": 0}), 3)


def test_the_opaque_finish_leaves_nothing_soft(capture: Dataset, tmp_path: Path) -> None:
    """At the end opacities are near 1 and sigma near 0, in the file too, and opaque drawing loses little."""
    result = train(capture, tmp_path / "run", replace(TINY, finish="opaque"))
    assert float(result.soup.opacities.min()) > 0.99
    assert float(result.soup.sigma.max()) < 0.051
    assert result.metrics["psnr_opaque_loss"] < 3.0


def test_nan_names_iteration_parameter_and_checkpoint(
    capture: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A parameter that is not finite stops the run with one line that says all three."""
    honest = Trainer.advance

    def poisoned(self: Trainer[TriangleSoup], iteration: int, last: int) -> list[float]:
        losses = honest(self, iteration, last)
        if iteration == 25:
            self.model.sigma_raw.data[7] = float("nan")
        return losses

    monkeypatch.setattr(Trainer, "advance", poisoned)
    with pytest.raises(DivergedError) as error:
        train(capture, tmp_path / "run", SHORT)
    message = str(error.value)
    assert "sigma_raw" in message
    assert "iteration 30" in message
    assert "step_000020" in message


def test_a_capture_without_points_starts_at_random(capture: Dataset, tmp_path: Path) -> None:
    """Random triangles where the cameras look, and a note about it."""
    bare = replace(capture, exact_points=None, point_colors=None)
    notes: list[object] = []
    result = train(bare, tmp_path / "run", SHORT.changed({"start.points": 300}), callbacks=[notes.append])
    assert result.metrics["triangles"] > 100
    assert any("no points" in getattr(note, "text", "") for note in notes)


@pytest.mark.parametrize("sky", ["sphere", "dome", "none"])
def test_random_triangles_are_no_more_than_there_may_be(capture: Dataset, sky: str) -> None:
    """The note said at most so many, and the run began with thirty times as many, which stayed in part."""
    bare = replace(capture, exact_points=None, point_colors=None)
    config = SHORT.changed({"start.points": 100_000, "max_triangles": 1000, "sky": sky, "pixels_per_triangle": None})
    trainer = start_trainer(bare, config)
    assert 950 <= len(trainer.model) <= 1000
    said = next(note for note in check_train(bare, config, 10, torch.device("cpu")) if note.startswith("no points"))
    assert f"starting from {random_count(bare, config):,} random ones" in said


def test_the_sky_of_a_capture_without_points_is_behind_what_photos_agree_on(
    capture: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was about the cameras alone once the run had begun: of cameras in a line all of the scene was taken for sky,
    so that there was no opaque mesh, and nothing was left without a sky."""
    far = 12 * torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    starts: list[Dataset] = []

    def swept(own: Dataset, *_: object) -> tuple[Dataset, float]:
        starts.append(replace(own, exact_points=far.double(), point_colors=torch.full((200, 3), 0.5)))
        return starts[0], 1.0

    monkeypatch.setattr("etsplat.tasks.train.with_swept_points", swept)
    bare = replace(capture, exact_points=None, point_colors=None)
    result = train(bare, tmp_path / "run", SHORT.changed({"start.dense": True, "sky": "sphere", "asset": True}))
    sky = Surroundings.of_note(result.soup.notes[Surroundings.NOTE])
    assert sky is not None
    assert sky.radius == pytest.approx(Surroundings.of(starts[0]).radius * starts[0].normalization.radius, rel=1e-4)
    assert result.opaque is not None


def test_absolute_units_far_off_are_pointed_out(capture: Dataset, tmp_path: Path) -> None:
    """Without normalization a scene a thousand times larger gets a note; with it, the same result as the small one."""
    assert capture.exact_points is not None
    viewmats = capture.viewmats.clone()
    viewmats[:, :3, 3] *= 1000
    large = replace(capture, viewmats=viewmats, exact_points=1000 * capture.exact_points)
    notes: list[object] = []
    train(large, tmp_path / "absolute", replace(SHORT, normalize=False, iterations=10), callbacks=[notes.append])
    assert any("start again with normalize=True" in getattr(note, "text", "") for note in notes)
    small = train(capture, tmp_path / "small", SHORT)
    result = train(large, tmp_path / "large", SHORT)
    assert result.metrics["psnr"] == pytest.approx(small.metrics["psnr"], abs=0.2)
    extent = result.soup.vertices.detach().abs().median() / small.soup.vertices.detach().abs().median()
    assert float(extent) == pytest.approx(1000, rel=0.02)


def test_a_run_that_fails_for_its_scale_says_how_to_scale_it(capture: Dataset, tmp_path: Path) -> None:
    """A thousand times smaller, everything is nearer than the near plane: no triangle lives, and `normalize` helps."""
    assert capture.exact_points is not None
    viewmats = capture.viewmats.clone()
    viewmats[:, :3, 3] /= 1000
    small = replace(capture, viewmats=viewmats, exact_points=capture.exact_points / 1000)
    with pytest.raises(DivergedError, match=r"no triangle is left at iteration.*start again with normalize=True"):
        train(small, tmp_path / "run", replace(SHORT, normalize=False))


def rates_of(config: TrainConfig, capture: Dataset, iteration: int) -> dict[str, float]:
    rates = start_trainer(capture, config)._stepper._schedule.rates
    return {name: at(rate, iteration) for name, rate in rates.items()}


def test_shorter_runs_move_vertices_faster(capture: Dataset) -> None:
    """By the root of how much shorter they are; the original's rate does not know the length of a run."""
    quick, paper = TrainConfig.quick(), TrainConfig.paper()
    points = capture.points
    assert points is not None
    shown = shown_width(capture, points)
    assert shown is not None
    for iterations, factor in ((6000, 1.0), (1500, 2.0)):
        first = rates_of(replace(quick, iterations=iterations), capture, 1)
        assert first["vertices"] == pytest.approx(factor * shown * quick.optimizer.lr_vertices)
    assert rates_of(replace(paper, iterations=300), capture, 1)["vertices"] == paper.optimizer.lr_vertices


def test_vertices_are_as_fast_on_screen_whatever_the_extent_of_the_cameras(capture: Dataset) -> None:
    """In a frame ten times as large, they move ten times as far."""
    center = torch.zeros(3, dtype=torch.float64)
    first, second = (
        rates_of(TrainConfig.quick(), views, 1)["vertices"] for views in (capture, capture.renormalized(center, 0.1))
    )
    assert second == pytest.approx(10 * first)


def test_large_triangles_move_faster_and_small_ones_slower(capture: Dataset) -> None:
    """By a power of their size, relative to the median, within limits; the original's all at one rate."""
    trainer = start_trainer(capture, TrainConfig.quick())
    vertices = trainer.adam.parameters["vertices"].detach()
    extents = (vertices.amax(dim=1) - vertices.amin(dim=1)).norm(dim=1)
    power = TrainConfig.quick().optimizer.lr_vertices_by_size
    expected = ((extents / extents.median()) ** power).clamp(SLOWEST, FASTEST)
    torch.testing.assert_close(trainer.adam.paces["vertices"], expected)
    assert expected.max() > 1.2 > 0.9 > expected.min()
    assert "vertices" not in start_trainer(capture, TrainConfig.paper()).adam.paces


def test_a_triangle_that_is_a_point_moves_at_the_median_rate_or_slower(capture: Dataset) -> None:
    """Whether one of many is a point or all are."""
    trainer = start_trainer(capture, TrainConfig.quick())
    vertices = trainer.adam.parameters["vertices"].detach().clone()
    paces = vertex_paces(TrainConfig.quick())["vertices"]
    vertices[0] = vertices[0, :1]
    assert paces(vertices)[0] == SLOWEST
    assert (paces(torch.ones(3, 3, 3)) == 1).all()


def test_few_pixels_carry_few_triangles(capture: Dataset) -> None:
    """One for so many of the training photos' pixels, and a note says so; the test photos do not count."""
    pixels = sum(capture.images.sizes[index][0] * capture.images.sizes[index][1] for index in capture.train)
    config = TrainConfig.quick()
    assert pixels / 45 < config.max_triangles
    assert triangle_limit(capture, config) == int(pixels / 45)
    notes = check_train(capture, config, config.iterations, torch.device("cpu"))
    assert any(f"few pixels: at most {int(pixels / 45):,} triangles, not 100,000" in note for note in notes)
    assert triangle_limit(capture, replace(config, finish="opaque")) == int(pixels / 75)
    assert triangle_limit(capture, replace(config, pixels_per_triangle=None)) == 100_000
    assert triangle_limit(capture, replace(config, max_triangles=5)) == 5


def test_more_points_than_there_may_be_triangles_are_told(capture: Dataset) -> None:
    """All of them become triangles all the same: the limit is that of densification."""
    assert capture.exact_points is not None
    count = len(capture.exact_points)
    for most in (count, count - 1):
        config = TrainConfig.quick().changed({"max_triangles": most, "pixels_per_triangle": None})
        notes = check_train(capture, config, config.iterations, torch.device("cpu"))
        told = f"{count:,} points, each of which becomes a triangle: more than the limit of {most:,}"
        assert any(note.startswith(told) for note in notes) is (most < count)


def test_a_sky_behind_what_is_cut_out_is_told(capture: Dataset) -> None:
    """Of photos with transparent pixels, unless they are trained without a sky."""
    pixels = [torch.nn.functional.pad(photo, (0, 1), value=255) for photo in capture.images]
    whole = replace(capture, images=StoredPictures(pixels))
    cut_out = replace(capture, images=StoredPictures([photo * (photo[..., :1] > 90) for photo in pixels]))
    told = 'take TrainConfig.of(preset, "object")'
    cases = [(cut_out, "outdoor", True), (cut_out, "indoor", True), (cut_out, "object", False)]
    cases += [(whole, "outdoor", False), (capture, "outdoor", False)]
    for photos, kind, noted in cases:
        notes = check_train(photos, TrainConfig.of("quick", kind), 10, torch.device("cpu"))
        assert any(told in note for note in notes) is noted


def test_rates_settle_towards_the_end(capture: Dataset) -> None:
    """With `lr_settle` colours, opacities and softness come to rest like the vertices; the original's never do."""
    paper = replace(TrainConfig.paper(), iterations=300)
    quick = paper.changed({"optimizer.lr_settle": 20_000})
    for config, ratio, last in ((paper, 1.0, 1.0), (quick, 0.1**0.5, 0.1)):
        first, middle, late, end = (rates_of(config, capture, iteration) for iteration in (1, 200, 250, 300))
        for name in ("opacity_logits", "sigma_raw", "sh_dc", "sh_rest"):
            assert middle[name] == first[name]
            assert late[name] == pytest.approx(ratio * first[name])
            assert end[name] == pytest.approx(last * first[name])
        assert end["vertices"] == pytest.approx(paper.optimizer.lr_vertices_final * first["vertices"])


def strategy_of(capture: Dataset, **settings: object) -> DensifyAndPrune:
    named = {name.replace("__", "."): value for name, value in settings.items()}
    strategy = start_trainer(capture, TINY.changed(named)).strategy
    assert isinstance(strategy, DensifyAndPrune)
    return strategy


def test_an_opaque_finish_removes_only_what_is_hidden(capture: Dataset) -> None:
    """The threshold of soft soups would take away too much of it; a lower one stays as it is."""
    for finish, asked, least in (("none", 0.022, 0.022), ("opaque", 0.022, 0.005), ("opaque", 0.001, 0.001)):
        assert strategy_of(capture, finish=finish, pruning__importance=asked).prune.importance == least


def test_an_opaque_finish_replaces_what_it_hides(capture: Dataset) -> None:
    for replaces in (False, True):
        assert strategy_of(capture, densification__replace_dead=replaces).replace_dead is replaces
    assert strategy_of(capture, finish="opaque").replace_dead
    with pytest.raises(InputError, match=r"densification\.replace_dead: has an effect only with finish none"):
        strategy_of(capture, finish="opaque", densification__replace_dead=False)


def test_few_photos_end_a_run_earlier(capture: Dataset, tmp_path: Path) -> None:
    """With `max_epochs` a run has so many iterations for each training photo, says so, and resumes with that length."""
    config = SHORT.changed({"schedule.max_epochs": 1})
    steps, events = len(capture.watching().train), list[object]()
    result = train(capture, tmp_path / "run", config, callbacks=[events.append])
    assert result.metrics["iterations"] == steps < config.iterations
    record = RunDirectory(result.path).read_config()
    assert (record["iterations"], record["config"]["iterations"]) == (steps, config.iterations)
    assert any(isinstance(event, NoteEvent) and f"{steps} iterations, not 40" in event.text for event in events)
    assert train(capture, tmp_path / "run", config, resume=True).metrics == result.metrics


def test_the_schedule_scales_with_the_length_of_the_run() -> None:
    """At 30,000 iterations it is the original's; at a tenth, everything comes ten times earlier."""
    assert TrainConfig.paper().at(25_000) == 25_000
    assert replace(TrainConfig.paper(), iterations=3000).at(25_000) == 2500
    assert replace(TrainConfig.paper(), iterations=30).at(100) == 1
    assert TrainConfig.paper().at(0) == 0


@pytest.mark.parametrize("sky", ["sphere", "dome", "none"])
def test_a_soup_notes_where_its_sky_is_in_the_units_of_its_capture(capture: Dataset, tmp_path: Path, sky: str) -> None:
    """So that its triangles are known without the capture; training has moved them only a little."""
    large = capture.renormalized(torch.tensor([3.0, 0, 0], dtype=torch.float64), 0.1)
    config = SHORT.changed({"sky": sky, "iterations": 20, "densification.begin": 3000})
    soup = train(replace(large, normalization=Normalization()), tmp_path / "run", config).soup
    again = TriangleSoup.load(tmp_path / "run" / "soup.safetensors")
    assert again.notes == soup.notes
    found = Surroundings.of_note(again.notes[Surroundings.NOTE])
    if sky == "none":
        assert found is None
        return
    assert found is not None
    assert large.points is not None
    added = SPHERE_TRIANGLES if sky == "sphere" else int(0.05 * len(large.points))
    outermost = found.outermost(again.vertices)
    assert 0.9 * added <= int(outermost.sum()) < len(again) - 0.5 * len(large.points)
    if sky == "sphere":
        middle = large.centers[large.train].mean(dim=0)
        # Not exactly: some of these views are watched, not trained on.
        torch.testing.assert_close(found.middle, middle, rtol=0, atol=0.02 * found.radius)
        assert found.radius == pytest.approx(Surroundings.of(large).radius, rel=0.05)


def test_how_a_run_ended_early_is_in_its_folder_until_it_goes_on(capture: Dataset, tmp_path: Path) -> None:
    """Interrupted, or failed with what message; a run that is done says nothing."""
    for number, (error, text) in enumerate(
        [(KeyboardInterrupt(), "interrupted"), (RuntimeError("no\nmemory"), "failed: no memory")]
    ):

        def stop(event: object, error: BaseException = error) -> None:
            if isinstance(event, CheckpointEvent):
                raise error

        run = RunDirectory(tmp_path / f"run{number}")
        with pytest.raises(type(error)):
            train(capture, run.path, SHORT, callbacks=[stop])
        assert run.read_end() == text
        train(capture, run.path, SHORT, callbacks=[lambda _: None], resume=True)
        assert run.read_end() == ""
        assert not (run.path / "ended.txt").exists()
