"""One trainer for every model, data set, objective and strategy: any combination fits, and resumes to the bit."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import etsplat
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.demo_scene import demo_scene
from etsplat.data.photograph import photograph
from etsplat.geometry.icosphere import icosphere
from etsplat.io.locks import writing_run
from etsplat.io.run_directory import RunDirectory
from etsplat.model.soup_init import StartPoints, start_soup
from etsplat.model.triangle_mesh import MeshAppearance, TriangleMesh
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.loop import Callback, DoneEvent, RefineEvent, StepEvent
from etsplat.optim.objective import Custom, Drawing, Objective, Term
from etsplat.optim.schedules import Schedule, face_budgets
from etsplat.optim.strategies import DensifyAndPrune, Fixed, Strategy, SubdivideAndUntangle
from etsplat.optim.terms.mesh import EdgeLength, Laplacian, SmoothNormals, Softness
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.terms.soup import DepthNormals, Harmonics, Opacity
from etsplat.optim.trainer import Trainer
from helpers.engines import device_of


@pytest.fixture(scope="module")
def object_views() -> Dataset:
    return photograph(demo_object(), 24, 24, elevations=(-35.0, 35.0), azimuths=5, supersampling=1)


@pytest.fixture(scope="module")
def scene() -> Dataset:
    scene = demo_scene(32, 24)
    assert scene.exact_points is not None
    assert scene.point_colors is not None
    return replace(scene, exact_points=scene.exact_points[::20], point_colors=scene.point_colors[::20]).normalized()


def a_mesh(radius: float = 1.05) -> TriangleMesh:
    vertices, faces = icosphere(2)
    return TriangleMesh.from_mesh(radius * vertices, faces, colors=0.5, opacity=0.9, sigma=0.5)


def a_soup(dataset: Dataset | None = None) -> TriangleSoup:
    rng = torch.Generator().manual_seed(1)
    positions = dataset.points if dataset is not None and dataset.points is not None else None
    if positions is None:
        positions = torch.nn.functional.normalize(torch.randn((300, 3), generator=rng), dim=1)
    points = StartPoints(positions, torch.full_like(positions, 0.5))
    return start_soup(points, rng, scale=2.0, opacity=0.4, sigma=0.8, sh_degree=1)


def mesh_objective() -> Objective:
    return Objective(Photometric(), [EdgeLength(0.5), SmoothNormals(0.01), Laplacian(0.2), Softness(1e-4)], scale=0.5)


def soup_objective() -> Objective:
    return Objective(Photometric(0.2), [Opacity(0.005), DepthNormals(1e-3)], depth_of="centroid")


def losses_of(trainer: Trainer[Any], iterations: int, **options: Any) -> list[float]:
    """Of every iteration."""
    events: list[object] = []
    trainer.fit(iterations, callbacks=[events.append], log_every=1, **options)
    return [event.loss for event in events if isinstance(event, StepEvent)]


def combination(model: str, data: Dataset, **options: Any) -> Trainer[Any]:
    if model == "mesh":
        budgets = face_budgets(60, steps=2, first=0.3, last=0.6, start_faces=320, max_faces=500)
        strategy: Strategy = SubdivideAndUntangle(budgets)
        rates = Schedule({"vertices": 1e-2, "colors": 2e-2, "opacity_logits": 1e-2, "log_sigma": 1e-2})
        return Trainer(a_mesh(), data, mesh_objective(), strategy, schedule=rates, **options)
    strategy = DensifyAndPrune(begin=10, every=15, max_triangles=600)
    return Trainer(a_soup(data), data, soup_objective(), strategy, **options)


@pytest.mark.parametrize("batch", [1, 2, 9])
def test_rates_grow_with_the_square_root_of_the_batch(object_views: Dataset, batch: int) -> None:
    """Those of a schedule at every iteration; a first step of Adam is that long."""
    rates = {"vertices": lambda k: 1e-3 / k, "colors": 2e-3, "opacity_logits": 1e-2, "log_sigma": 1e-2}
    mesh = a_mesh()
    before = mesh.colors.detach().clone()
    trainer = Trainer(mesh, object_views, mesh_objective(), schedule=Schedule(rates), batch=batch)
    trainer.fit(1)
    assert float((trainer.model.colors.detach() - before).abs().max()) == pytest.approx(2e-3 * batch**0.5, rel=1e-3)
    trainer.fit(4)
    assert trainer.adam.learning_rates["vertices"] == pytest.approx(1e-3 / 4 * batch**0.5, rel=1e-12)
    if batch == 1:
        assert trainer.adam.learning_rates["colors"] == 2e-3


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("data", ["object", "scene"])
@pytest.mark.parametrize("model", ["mesh", "soup"])
def test_any_model_fits_any_data(
    object_views: Dataset, scene: Dataset, tmp_path: Path, model: str, data: str, batch: int
) -> None:
    """The loss falls, triangles come, and a run that was killed ends with the same bits."""
    dataset = object_views if data == "object" else scene
    trainer = combination(model, dataset, batch=batch)
    before = trainer.count
    losses = losses_of(trainer, 60)
    assert sum(losses[-5:]) < 0.95 * sum(losses[:5])
    assert trainer.count > before

    run = RunDirectory.create(tmp_path / "run", {"task": "train"})
    killed = combination(model, dataset, batch=batch)

    def kill(event: object) -> None:
        if isinstance(event, StepEvent) and event.iteration == 33:
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        killed.fit(60, callbacks=[kill], log_every=1, checkpoint_every=25, run=run)
    resumed = combination(model, dataset, batch=batch)
    assert losses_of(resumed, 60, run=run) == losses[25:]
    state, expected = resumed.state(), trainer.state()
    assert [name for name in expected if not torch.equal(state[name], expected[name])] == []
    assert [line["loss"] for line in run.read_history()] == losses


def test_a_run_of_other_parts_is_not_gone_on_with(object_views: Dataset, tmp_path: Path) -> None:
    """Another kernel, background or photometric term is another run; parameters of a file learn as others do."""
    vertices, faces = icosphere(1)

    class Mine(Photometric):
        pass

    def fit(iterations: int, kernel: str = "elastic", term: Term | None = None, **options: Any) -> None:
        look = MeshAppearance(kernel=kernel)
        mesh = TriangleMesh.from_mesh(vertices, faces, colors=0.7, opacity=0.9, sigma=0.3, appearance=look)
        for parameter in mesh.parameters().values():
            parameter.requires_grad_(False)
        Trainer(mesh, object_views, Objective(term or Photometric()), **options).fit(iterations, run=tmp_path / "run")

    fit(2)
    fit(3)
    for changes in ({"kernel": "bilateral"}, {"term": Mine()}, {"background": (1.0, 1.0, 1.0)}):
        with pytest.raises(InputError, match=r"other settings|another"):
            fit(4, **changes)


def test_a_fit_can_be_gone_on_with(object_views: Dataset) -> None:
    """Twenty iterations and then up to forty are the same as forty, without any run directory."""
    whole, parts = (combination("mesh", object_views) for _ in range(2))
    assert losses_of(whole, 40) == losses_of(parts, 20) + losses_of(parts, 40)


def test_a_folder_becomes_a_run_to_go_on_with(object_views: Dataset, tmp_path: Path) -> None:
    """Nothing but its name is needed; another seed, or other parts, are another run, and refused."""
    whole = losses_of(combination("mesh", object_views), 20)
    combination("mesh", object_views).fit(10, run=tmp_path / "run", log_every=1)
    assert losses_of(combination("mesh", object_views), 20, run=tmp_path / "run") == whole[10:]
    assert "Trainer.fit" in (tmp_path / "run" / "README.txt").read_text()
    for other in (combination("mesh", object_views, seed=1), combination("soup", object_views)):
        with pytest.raises(InputError, match="with other settings"):
            other.fit(30, run=tmp_path / "run")
    with writing_run(tmp_path / "run", pytest.fail), pytest.raises(InputError, match="is writing this run"):
        combination("mesh", object_views).fit(30, run=tmp_path / "run")


@pytest.mark.parametrize("weight", [0.1, 1.7])
def test_adam_adds_the_gradient_of_harmonics_with_the_bits_of_autograd(
    object_views: Dataset, engine: str, weight: float
) -> None:
    """A run ends with the parameters of one whose term is differentiated, and has its losses; torch on a GPU rounds
    otherwise."""

    class Differentiated(Harmonics):
        squares = None

    found = []
    for kind in (Harmonics, Differentiated):
        objective = Objective(Photometric(0.2), [Opacity(0.005), kind(weight)], scale=lambda iteration: 0.9**iteration)
        with etsplat.engine(engine):
            trainer = Trainer(a_soup().to(device_of(engine)), object_views, objective, seed=3)
            found.append((losses_of(trainer, 5), trainer.model.state()))
    (losses, ours), (expected, theirs) = found
    assert ours["sh_rest"].abs().max() > 0
    assert losses == expected
    tolerance = {"rtol": 1e-4, "atol": 1e-6} if device_of(engine) == "cuda" else {"rtol": 0, "atol": 0}
    for name in theirs:
        torch.testing.assert_close(ours[name], theirs[name], **tolerance, msg=lambda text, name=name: f"{name}: {text}")


def test_a_step_of_two_views_is_the_mean_of_their_gradients(object_views: Dataset) -> None:
    """Of what looks at pictures; what looks at parameters alone counts once. The views come in the sampler's order."""
    pair = combination("mesh", object_views, batch=2, background=(0.2, 0.4, 0.6))
    steps = pair._stepper
    steps._strategy = Fixed()
    mesh, chosen = a_mesh(), []
    honest = steps._choose
    steps._choose = lambda at: chosen.extend(found := honest(at)) or found  # type: ignore[method-assign]
    pair.advance(1, 1)
    background = torch.tensor([[0.2, 0.4, 0.6]])
    objective, total = mesh_objective(), 0.0
    for each in chosen:
        view = steps._loader.view(each.view)
        rendering = mesh.render(view.camera, backgrounds=background)
        drawing = Drawing(mesh, view.camera, view.photo, view.mask, background, rendering)
        total = total + objective(drawing, objective.weights(1), 0.5) / 2
    assert isinstance(total, Tensor)
    total.backward()
    for name, parameter in mesh.parameters().items():
        # The first of Adam's moments after one step is a tenth of the gradient.
        torch.testing.assert_close(10 * pair.adam.first_moments[name], parameter.grad, rtol=1e-4, atol=1e-7)


class Drop(Strategy):
    """A strategy of one's own: lets the last triangles go at iteration 5, and counts what it saw."""

    outputs = ("statistics",)

    def start(self, model: Any, adam: Any, views: int, generator: torch.Generator) -> None:
        super().start(model, adam, views, generator)
        self.seen = 0

    def observe(self, seen: Any, *, epoch_starts: bool) -> None:
        assert seen.statistics is not None
        self.seen += 1

    def edit(self, iteration: int) -> bool:
        from etsplat.optim.edit import RowPlan, apply_rows

        if iteration != 5:
            return False
        kept = torch.arange(self.model.count) < self.model.count - 10
        self.model.load_state(apply_rows(RowPlan.keeping(kept), self.adam, {})[0])
        return True


def test_ones_own_term_strategy_and_callback(object_views: Dataset) -> None:
    """A term as a function or a class, a strategy that edits, callbacks that see it: no other file knows of them."""

    class Bright(Term):
        outputs = ("color",)

        def __call__(self, drawing: Drawing) -> Tensor:
            return drawing.rendering.color.mean()

    depths = Custom(lambda drawing: drawing.rendering.depth.mean(), 0.01, outputs=("depth",))
    strategy, events = Drop(), list[object]()
    trainer = Trainer(a_soup(), object_views, Objective(Photometric(), [Bright(2.0), depths]), strategy)
    trainer.fit(8, callbacks=[events.append], log_every=4)
    assert [type(event) for event in events] == [StepEvent, RefineEvent, StepEvent, DoneEvent]
    assert next(event for event in events if isinstance(event, RefineEvent)).added == -10
    assert (trainer.count, strategy.seen) == (290, 8)
    dark = Trainer(a_soup(), object_views, Objective(Photometric(), []))
    dark.fit(8)
    assert float(trainer.model.sh_dc.detach().mean()) < float(dark.model.sh_dc.detach().mean())


def test_a_schedule_sets_values_and_appearance(object_views: Dataset) -> None:
    """A parameter that is set is what the schedule says after each step; the appearance changes with the iteration."""
    mesh = a_mesh()
    rates = dict(TriangleMesh.RATES, log_sigma=0.0)
    Trainer(mesh, object_views, mesh_objective(), schedule=Schedule(rates, {"log_sigma": lambda i: -float(i)})).fit(3)
    assert mesh.log_sigma is not None
    assert float(mesh.log_sigma.detach()) == -3.0
    soup = a_soup()

    def look(iteration: int) -> Any:
        return replace(soup.appearance, opacity_floor=0.1 * iteration)

    Trainer(soup, object_views, soup_objective(), schedule=Schedule(TriangleSoup.RATES, appearance=look)).fit(4)
    assert soup.appearance.opacity_floor == 0.4
    assert float(soup.drawn_opacities.detach().min()) > 0.4


def test_steps_leave_out_triangles_and_nothing_else_does(object_views: Dataset) -> None:
    """Other ones in each step, the same in a second run; between steps, and where a run is watched, all are drawn."""

    def fitted(dropout: float) -> tuple[TriangleSoup, list[int], list[float]]:
        soup, seen, between = a_soup(), list[int](), list[float]()

        def look(iteration: int) -> Any:
            return replace(soup.appearance, dropout=dropout, draw=iteration)

        class Counting(Strategy):
            outputs = ("statistics",)

            def observe(self, seen_now: Any, *, epoch_starts: bool) -> None:
                seen.append(int((seen_now.statistics.screen_size > 0).sum()))
                between.append(soup.appearance.dropout)

        schedule = Schedule(TriangleSoup.RATES, appearance=look)
        Trainer(soup, object_views, soup_objective(), Counting(), schedule=schedule, batch=1).fit(4)
        return soup, seen, between

    all_drawn, whole, _ = fitted(0.0)
    (first, fewer, between), (second, _, _) = fitted(0.5), fitted(0.5)
    assert between == [0.0] * 4
    assert all(0 < some < every for some, every in zip(fewer, whole, strict=True))
    assert torch.equal(first.vertices, second.vertices)
    assert not torch.equal(first.vertices, all_drawn.vertices)
    assert first.appearance.dropout == first.finished().appearance.draw == 0


def test_photos_are_halved_when_the_schedule_says(object_views: Dataset) -> None:
    """Pictures of the first two steps have half the size."""
    widths: list[int] = []

    def look(drawing: Drawing) -> Tensor:
        widths.append(drawing.rendering.color.shape[2])
        return drawing.rendering.color.sum() * 0

    schedule = Schedule(TriangleMesh.RATES, halvings=lambda iteration: int(iteration <= 2))
    Trainer(
        a_mesh(), object_views, Objective(Photometric(), [Custom(look, outputs=("color",))]), schedule=schedule
    ).fit(4)
    assert widths == [12, 12, 24, 24]


def test_steps_show_the_views_that_the_schedule_says(object_views: Dataset) -> None:
    """Where they change an epoch of the others ends; a run that goes on from its state ends with the same bits."""
    some, views = object_views.train[:2], list[int]()

    def look(drawing: Drawing) -> Tensor:
        views.append(int(drawing.index))
        return drawing.rendering.color.sum() * 0

    def trainer() -> Trainer[TriangleMesh]:
        schedule = Schedule(TriangleMesh.RATES, views=lambda step: object_views.train if step <= 3 else some)
        return Trainer(a_mesh(), object_views, Objective(Photometric(), [Custom(look)]), schedule=schedule)

    first = trainer()
    first.fit(9)
    assert len(set(views[:3])) == 3
    assert [set(views[at : at + 2]) for at in (3, 5, 7)] == [set(some)] * 3
    for killed_at in (2, 3, 4, 6):
        begun, gone_on = trainer(), trainer()
        begun.fit(killed_at)
        gone_on.load_state(begun.state(), killed_at)
        for step in range(killed_at + 1, 10):
            gone_on.advance(step, step)
        assert torch.equal(gone_on.model.vertices, first.model.vertices)


@pytest.mark.parametrize("views", [[], [10**6]])
def test_views_that_are_none_to_train_on_are_refused(object_views: Dataset, views: list[int]) -> None:
    schedule = Schedule(TriangleMesh.RATES, views=lambda _: views)
    with pytest.raises(ValueError, match="schedule: its views of iteration 1 are no training views"):
        Trainer(a_mesh(), object_views, Objective(Photometric(), []), schedule=schedule).fit(1)


def test_every_random_choice_follows_from_the_seed(object_views: Dataset) -> None:
    """The same seed gives the same losses, another one does not."""
    make: Callable[[int], list[float]] = lambda seed: losses_of(combination("mesh", object_views, seed=seed), 3)  # noqa: E731
    assert make(0) == make(0) != make(1)


def fit_in(
    run: Path, photos: Dataset, rate: float, budget: int, callbacks: Sequence[Callback] = (), power: int = 1
) -> TriangleMesh:
    """A short run in a folder."""
    mesh = a_mesh()
    schedule = Schedule({**mesh.rates, "vertices": rate})
    strategy = SubdivideAndUntangle({2: budget})
    trainer = Trainer(mesh, photos, Objective(Photometric(), [EdgeLength(0.5, power)]), strategy, schedule=schedule)
    trainer.fit(3, run=run, callbacks=callbacks)
    return mesh


def test_a_run_of_other_rates_or_settings_is_refused_and_one_that_goes_on_says_so(
    object_views: Dataset, tmp_path: Path
) -> None:
    first, told = fit_in(tmp_path, object_views, 1e-3, 100), list[object]()
    for rate, budget, power in ((2e-3, 100, 1), (1e-3, 120, 1), (1e-3, 100, 2)):
        with pytest.raises(InputError, match="checkpoint"):
            fit_in(tmp_path, object_views, rate, budget, power=power)
    again = fit_in(tmp_path, object_views, 1e-3, 100, [told.append])
    assert torch.equal(again.vertices, first.vertices)
    assert f"run {tmp_path}: has 3 of 3 iterations, and none is made" in str(told[0])
    with pytest.warns(UserWarning, match="another folder begins anew") as warned:
        fit_in(tmp_path, object_views, 1e-3, 100)
    assert warned[0].filename == __file__


def test_parts_may_hold_whatever_they_like(object_views: Dataset, tmp_path: Path) -> None:
    """Themselves, too; what they do by itself is no setting."""
    strategy = Fixed()
    vars(strategy).update(
        own=strategy, photos=object_views, chance=torch.Generator(), table={1: torch.ones(2), "b": 0.5}
    )
    Trainer(a_mesh(), object_views, mesh_objective(), strategy).fit(1, run=tmp_path)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_gradients_are_on_within_a_run_whatever_they_are_around_it(object_views: Dataset, mode: Any) -> None:
    """What was looked at in inference mode before can be fitted to afterwards."""
    photos, mesh = object_views.of_views(range(len(object_views))), a_mesh()
    with mode():
        mesh.render(photos.cameras[0])
        Trainer(mesh, photos, mesh_objective()).fit(2)
    mesh.render(photos.cameras[0]).color.mean().backward()
    with torch.inference_mode(), pytest.raises(ValueError, match=r"made within torch\.inference_mode"):
        Trainer(a_mesh(), photos, mesh_objective())
