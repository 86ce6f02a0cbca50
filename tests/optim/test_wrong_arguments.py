"""What a trainer and its parts cannot work with is refused where it is handed over, by its name."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import etsplat
from etsplat.model.model import Model
from etsplat.ops.adam import Adam

PHOTOS = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0,), azimuths=3, supersampling=1)
POINTS = etsplat.StartPoints(torch.rand(50, 3, generator=torch.Generator().manual_seed(0)), torch.full((50, 3), 0.5))


def a_mesh(dtype: torch.dtype = torch.float32) -> etsplat.TriangleMesh:
    vertices, faces = etsplat.icosphere(1)
    return etsplat.TriangleMesh.from_mesh(vertices.to(dtype), faces, colors=0.7, opacity=0.98, sigma=0.25)


def frozen() -> etsplat.TriangleMesh:
    """Its vertices are, or they came by `replace`: the trainer cannot tell."""
    mesh = a_mesh()
    mesh.vertices.requires_grad_(False)
    return mesh


def a_soup(scale: float = 1.0) -> etsplat.TriangleSoup:
    return etsplat.start_soup(POINTS, torch.Generator(), scale=scale, opacity=0.3, sigma=1.0, sh_degree=1)


def a_trainer(model: Any = None, terms: tuple[etsplat.Term, ...] = (), **given: Any) -> etsplat.Trainer[Any]:
    objective = etsplat.Objective(given.pop("photometric", etsplat.Photometric()), terms)
    return etsplat.Trainer(model or a_mesh(), given.pop("dataset", PHOTOS), objective, **given)


def custom(value: Callable[[etsplat.Drawing], Any], **given: Any) -> etsplat.Term:
    return etsplat.Custom(value, 0.5, **given)


WRONG = "must return a scalar tensor of the model's dtype and device, got"


@pytest.mark.parametrize(
    ("value", "got"),
    [
        (lambda drawing: 0.5, r"0\.5"),
        (lambda drawing: drawing.rendering.color, r"a tensor of shape \(1, 16, 16, 3\)"),
        (lambda drawing: drawing.model.vertices.mean().double(), r"torch\.float64 on cpu, where photometric has"),
    ],
)
def test_a_term_that_returns_something_else_is_named(value: Callable[[etsplat.Drawing], Any], got: str) -> None:
    with pytest.raises(ValueError, match=rf"terms\[1\] of the objective, Custom, {WRONG} {got}"):
        a_trainer(terms=(etsplat.EdgeLength(0.1), custom(value))).fit(1)


@pytest.mark.parametrize("name", ["rendering", "photo", "camera", "index"])
def test_a_term_without_outputs_is_given_none_of_several_pictures(name: str) -> None:
    """On some ways of making a step it saw the first view, and on others ended in torch."""
    looks = custom(lambda drawing: getattr(drawing, name) * 0.0)
    with pytest.raises(ValueError, match=rf"terms\[1\] .*, Custom, looks at drawing\.{name}; without outputs .*\("):
        a_trainer(terms=(etsplat.EdgeLength(0.1), looks), batch=2).fit(1)
    with pytest.raises(ValueError, match=rf"terms\[0\] .*, Custom, looks at drawing\.{name}"):
        etsplat.Objective(etsplat.Photometric(), [looks]).of_parameters(a_mesh(), (0.5,), 1.0)


@pytest.mark.parametrize(
    ("value", "outputs"),
    [
        (lambda drawing: drawing.rendering.color.detach().mean(), ("color",)),
        (lambda drawing: torch.tensor(drawing.rendering.color.mean().item()), ("color",)),
        (lambda drawing: (drawing.rendering.color > -1).float().mean(), "color"),
        (lambda drawing: drawing.model.vertices.detach().square().mean(), ()),
    ],
)
@pytest.mark.parametrize("batch", [1, 2])
def test_a_term_that_changes_nothing_is_told_so(
    value: Callable[[etsplat.Drawing], Any], outputs: Any, batch: int
) -> None:
    """Its gradient was lost on the way: runs went on as without it."""
    with pytest.raises(
        ValueError, match=r"terms\[0\] of the objective, Custom, has no gradient and so changes nothing"
    ):
        a_trainer(terms=(custom(value, outputs=outputs),), batch=batch).fit(1)


def test_a_term_may_be_zero_where_there_is_nothing_to_compare_with() -> None:
    a_trainer(terms=(custom(lambda drawing: torch.zeros(()), outputs="depth"), custom(lambda d: torch.zeros(())))).fit(
        2
    )


def test_a_term_without_outputs_may_look_at_the_only_picture_of_a_step() -> None:
    a_trainer(terms=(custom(lambda drawing: drawing.rendering.color.mean()),)).fit(2)


@pytest.mark.parametrize("outputs", ["normal", ("color", "normal")])
def test_a_term_that_names_too_few_outputs_is_told_of_the_others(outputs: Any) -> None:
    flat = custom(lambda drawing: drawing.rendering.depth.mean(), outputs=outputs)
    with pytest.raises(
        ValueError, match=r"terms\[0\] .* 'mean'\. Its outputs are .*; drawing\.rendering has no depth, "
    ):
        a_trainer(terms=(flat,)).fit(1)


class Named(etsplat.Term):
    """One that knows nothing of the constructor of `Term`."""

    def __init__(self, outputs: Any) -> None:
        self.outputs = outputs

    def __call__(self, drawing: etsplat.Drawing) -> torch.Tensor:
        return drawing.model.vertices.mean()


def test_a_term_has_weight_1_unless_it_says_otherwise() -> None:
    objective = etsplat.Objective(etsplat.Photometric(), [Named(()), etsplat.EdgeLength(lambda i: torch.tensor(0.5))])
    assert objective.weights(1) == (1.0, 0.5)
    a_trainer(terms=(Named(()),)).fit(1)


def test_a_weight_that_becomes_none_is_named() -> None:
    """Such a term was left out, without a word."""
    forgot = etsplat.EdgeLength(lambda iteration: None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"the weight of terms\[0\] .* at iteration 1 must be a number, got None"):
        a_trainer(terms=(forgot,)).fit(1)


def test_mistakes_of_a_term_stay_what_they_are() -> None:
    for looks in (lambda drawing: drawing.vertexes, lambda drawing: drawing.model.vertexes):
        with pytest.raises(AttributeError, match="vertexes"):
            a_trainer(terms=(custom(looks, outputs="color"),)).fit(1)


def test_a_photometric_term_that_returns_something_else_is_named() -> None:
    with pytest.raises(ValueError, match=rf"photometric of the objective, Custom, {WRONG} 0\.5"):
        a_trainer(photometric=custom(lambda drawing: 0.5)).fit(1)


def test_a_term_of_parameters_alone_that_returns_something_else_is_named() -> None:
    objective = etsplat.Objective(etsplat.Photometric(), [custom(lambda drawing: 0.5)])
    with pytest.raises(ValueError, match=rf"terms\[0\] of the objective, Custom, {WRONG} 0\.5"):
        objective.of_parameters(a_mesh(), (0.5,), 1.0)


def test_one_output_is_named_by_a_word() -> None:
    """As `rasterize` takes it."""
    seen = [custom(lambda drawing: drawing.rendering.depth.mean(), outputs=each) for each in ("depth", ["depth"])]
    assert [term.outputs for term in seen] == [("depth",), ("depth",)]
    a_trainer(terms=tuple(seen)).fit(1)


@pytest.mark.parametrize(
    ("model", "strategy", "message"),
    [
        (a_mesh, etsplat.DensifyAndPrune(), "DensifyAndPrune needs a TriangleSoup, got a TriangleMesh"),
        (a_soup, etsplat.SubdivideAndUntangle({2: 99}), "SubdivideAndUntangle needs a TriangleMesh, got a TriangleS"),
    ],
)
def test_strategies_say_which_model_they_edit(
    model: Callable[[], Model], strategy: etsplat.Strategy, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        a_trainer(model(), strategy=strategy)


def test_steps_and_terms_say_which_model_they_are_for() -> None:
    with pytest.raises(ValueError, match="UniformSteps needs a TriangleMesh, got a TriangleSoup"):
        a_trainer(a_soup(), update=etsplat.UniformSteps()).fit(1)
    for term in (etsplat.Size(), etsplat.Harmonics()):
        with pytest.raises(ValueError, match=f"{type(term).__name__} needs a TriangleSoup, got a TriangleMesh"):
            term(etsplat.Drawing(a_mesh(), *[None] * 5))


class OneWord(etsplat.Strategy):
    outputs = "statistics"  # pyright: ignore[reportAssignmentType]


class Unknown(etsplat.Strategy):
    outputs = ("weights",)


class Attribute(etsplat.Strategy):
    def __init__(self) -> None:
        self.state = {}  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"strategy": etsplat.Fixed}, "strategy must be a Strategy, got the class Fixed: make one"),
        ({"strategy": "fixed"}, "strategy must be a Strategy, got 'fixed'"),
        ({"strategy": OneWord()}, r"strategy\.outputs must be a sequence of names, got 'statistics': make it a tuple"),
        ({"strategy": Unknown()}, r"strategy\.outputs must be one of 'color', .* got 'weights'"),
        ({"strategy": Attribute()}, r"strategy\.state must be a method that returns tensors by name, got dict"),
        ({"dataset": "scene"}, r"dataset must be a Dataset, got 'scene': etsplat\.load_dataset\(path\) reads one"),
        ({"paces": {"vertexes": torch.ones_like}}, "paces name vertexes; the model has vertices, colors"),
        ({"batch": 1.5}, r"batch must be an integer of at least 1, got 1\.5"),
        ({"model": torch.nn.Linear(2, 2)}, r"model must be a model, such as etsplat\.TriangleMesh, got Linear"),
        ({"schedule": {"vertices": 1e-2}}, r"schedule must be a Schedule, got dict: etsplat\.Schedule makes one"),
        ({"guard": True}, r"guard must be a Guard, got True: etsplat\.Guard makes one"),
        ({"cameras": "poses"}, r"cameras must be a CameraRefinement, got 'poses'"),
        ({"exposure": True}, r"exposure must be an Exposure, got True"),
        ({"seed": "3"}, r"seed must be an integer or a torch\.Generator, got '3'"),
        ({"seed": None}, r"seed must be an integer or a torch\.Generator, got None"),
        ({"background": 1.0}, r"background must be three numbers from 0 to 1, or None, got 1\.0"),
        ({"background": "white"}, "background must be three numbers from 0 to 1, or None, got 'white'"),
        ({"background": (1, 1, 1, 1)}, "background must be three numbers from 0 to 1, or None, got 4 of them"),
        ({"background": (0, 255, 0)}, r"background\[1\] must be from 0 to 1, got 255"),
        (
            {"model": frozen()},
            "model requires gradients of colors, opacity_logits, log_sigma, and none of vertices: mod",
        ),
        ({"model": a_mesh(torch.float64)}, r"model must be float32, .* got vertices in torch\.float64"),
    ],
)
def test_a_trainer_names_what_it_cannot_begin_with(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        a_trainer(**given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"iterations": -1}, "iterations must be an integer of at least 0, got -1"),
        ({"iterations": 1.5}, r"iterations must be an integer of at least 0, got 1\.5"),
        ({"log_every": 0}, "log_every must be an integer of at least 1, got 0"),
        ({"evaluate_every": -1}, "evaluate_every must be an integer of at least 0"),
        ({"callbacks": print}, r"callbacks must be a sequence of functions, got .*: pass \[callback\]"),
        ({"callbacks": None}, "callbacks must be a sequence of functions, got None"),
        ({"callbacks": [print, None]}, r"callbacks\[1\] must be a function of an event, got None"),
        ({"run": 3}, "run: is of type int; it must be a path"),
    ],
)
def test_a_fit_names_what_it_cannot_do(given: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, etsplat.InputError), match=message):
        a_trainer().fit(**{"iterations": 2, **given})


def test_numbers_of_numpy_and_torch_begin_the_same_run() -> None:
    def fitted(**given: Any) -> torch.Tensor:
        trainer = a_trainer(**given)
        trainer.fit(2)
        return trainer.model.vertices

    plain = fitted(seed=3, batch=2, background=(0, 0.5, 1))
    assert fitted(seed=np.int64(3), batch=torch.tensor(2), background=torch.tensor([0, 0.5, 1])).equal(plain)
    assert fitted(seed=torch.tensor(3), batch=np.int8(2), background=np.array([0, 0.5, 1])).equal(plain)


@pytest.mark.parametrize("value", [2.5, torch.tensor(2.5), np.float32(2.5), np.array(2.5)])
def test_metrics_of_ones_own_are_kept_as_numbers(value: Any, tmp_path: Path) -> None:
    """A run ended at its last step, as JSON has no tensors."""
    a_trainer(evaluate=lambda model: {"mine": value}).fit(1, run=tmp_path / "run")
    assert '"mine": 2.5' in (tmp_path / "run" / "history.jsonl").read_text()


@pytest.mark.parametrize(("value", "got"), [(3.0, r"3\.0"), ({"x": torch.zeros(2)}, "a tensor .* for 'x'")])
def test_metrics_that_are_none_are_named(value: Any, got: str) -> None:
    with pytest.raises(ValueError, match=f"evaluate must return numbers by name, got {got}"):
        a_trainer(evaluate=lambda model: value).fit(1)


@pytest.mark.parametrize(
    ("photometric", "terms", "message"),
    [
        (None, (), "photometric must be a Term, got None: make one"),
        (etsplat.Photometric, (), "photometric must be a Term, got the class Photometric: make one"),
        (etsplat.Photometric(), etsplat.EdgeLength(0.5), r"terms must be a sequence of terms, got EdgeLength"),
        (etsplat.Photometric(), [Named("depth")], r"terms\[0\]\.outputs must be a sequence of names, got 'depth'"),
        (etsplat.Photometric(), [Named(("rgb",))], r"terms\[0\]\.outputs must be one of 'color', .*, got 'rgb'"),
        (etsplat.Photometric(), [lambda drawing: 0], r"terms\[0\] must be a Term, .*: etsplat\.Custom\(function\)"),
    ],
)
def test_an_objective_is_made_of_terms(photometric: Any, terms: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        etsplat.Objective(photometric, terms)


def test_callbacks_of_a_task_are_several(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="callbacks must be a sequence of functions"):
        etsplat.reconstruct("demo:owl", tmp_path / "run", callbacks=print)
    assert not (tmp_path / "run").exists()


class RemoveAll(etsplat.Strategy):
    """Leaves nothing."""

    def next_edit(self, iteration: int) -> int:
        return iteration

    def edit(self, iteration: int) -> bool:
        kept = torch.zeros(self.model.count, dtype=torch.bool)
        self.model.load_state(etsplat.apply_rows(etsplat.RowPlan.keeping(kept), self.adam, {})[0])
        return True


class Edits(etsplat.Strategy):
    """Edits at each iteration by a function of the strategy, which says what `edit` returns."""

    def __init__(self, edit_by: Callable[[etsplat.Strategy], Any]) -> None:
        self.edit_by = edit_by

    def next_edit(self, iteration: int) -> int:
        return iteration

    def edit(self, iteration: int) -> bool:
        return self.edit_by(self)


def _assigned(strategy: etsplat.Strategy) -> bool:
    strategy.model.vertices = strategy.model.vertices.detach()[1:]
    return True


def _without_adam(strategy: etsplat.Strategy) -> bool:
    strategy.model.load_state({name: tensor[1:] for name, tensor in strategy.model.state().items()})
    return True


def _without_model(strategy: etsplat.Strategy) -> bool:
    etsplat.apply_rows(etsplat.RowPlan.keeping(torch.arange(strategy.model.count) > 0), strategy.adam, {})
    return True


def _silently(strategy: etsplat.Strategy) -> None:
    plan = etsplat.RowPlan.keeping(torch.arange(strategy.model.count) > 0)
    strategy.model.load_state(etsplat.apply_rows(plan, strategy.adam, {})[0])


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            _assigned,
            "Edits replaced vertices of the model or of its optimizer at iteration 1, and not of both: edit by",
        ),
        (_without_adam, "Edits replaced vertices, .* of the model or of its optimizer at iteration 1, and not of both"),
        (
            _without_model,
            "Edits replaced vertices, .* of the model or of its optimizer at iteration 1, and not of both",
        ),
        (_silently, "Edits replaced tensors at iteration 1, and returned None: edit is to return True"),
    ],
)
def test_an_edit_of_half_is_named(edit: Callable[[etsplat.Strategy], Any], message: str) -> None:
    """The next step said that a parameter had no gradient, or another shape than one that nobody had touched."""
    with pytest.raises(ValueError, match=message):
        a_trainer(a_soup(), strategy=Edits(edit)).fit(3)


@pytest.mark.parametrize("found", [{"seen": 3}, {"seen": {}}, [torch.zeros(1)], None])
def test_a_strategy_whose_state_cannot_be_kept_is_named(found: Any, tmp_path: Path) -> None:
    class Counting(etsplat.Strategy):
        def state(self) -> Any:
            return found

    with pytest.raises(ValueError, match=r"Counting\.state must return tensors by name, got "):
        a_trainer(strategy=Counting()).fit(1, run=tmp_path / "run")


def test_a_strategy_that_removes_all_triangles_ends_the_run() -> None:
    with pytest.raises(etsplat.DivergedError, match="RemoveAll left no triangle at iteration 1"):
        a_trainer(a_soup(), strategy=RemoveAll()).fit(2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: etsplat.DensifyAndPrune(sample_by="foo"), "sample_by must be one of 'alternate', .* got 'foo'"),
        (lambda: etsplat.DensifyAndPrune(growth=0.5), r"growth must be at least 1, got 0\.5"),
        (lambda: etsplat.DensifyAndPrune(every=0), "every must be an integer of at least 1, got 0"),
        (lambda: etsplat.Photometric(pixel="l3"), "pixel must be one of 'l1', 'l2', 'rms', got 'l3'"),
        (lambda: etsplat.Photometric(2.0), r"dssim must be from 0 to 1, got 2\.0"),
        (lambda: etsplat.CameraRefinement.of("foo", 10, 1.0), "choice must be one of 'off', 'poses', 'all', got 'foo'"),
        (lambda: etsplat.Schedule({"vertices": -1e-3}), r"rates\[vertices\] must be at least 0, got -0\.001"),
        (lambda: etsplat.Schedule({"vertices": "1"}), r"rates\[vertices\] must be a number, got '1'"),
        (lambda: Adam({"p": torch.zeros(2)}, {"p": 1.0}, betas=(0.9,)), r"betas must be two numbers in \[0, 1\), got"),
        (lambda: etsplat.EdgeLength("0.5"), r"weight must be a number, got '0\.5'"),
        (lambda: etsplat.Custom(3), "value must be a function of a drawing, got 3"),
        (lambda: etsplat.Custom(len, outputs="depht"), "outputs must be one of 'color', .* got 'depht'"),
        (lambda: etsplat.SubdivideAndUntangle([100]), "budgets must be numbers of faces by iteration, got list"),
        (lambda: etsplat.SubdivideAndUntangle({5: "9"}), r"budgets\[5\] must be an integer of at least 1, got '9'"),
        (lambda: etsplat.SubdivideAndUntangle({-5: 9}), "an iteration of budgets must be an integer of at least 1"),
        (lambda: etsplat.Guard(until="x"), "until must be an integer of at least 0, got 'x'"),
        (lambda: etsplat.register_kernel(3, len), "name must be a str, got 3"),
        (lambda: etsplat.register_kernel("k", "plateau"), "value must be a function of x and sigma, got 'plateau'"),
        (lambda: etsplat.silhouette_iou(torch.ones(2, 2).byte(), torch.ones(2, 2)), "coverage must be floats in"),
        (lambda: Adam({"p": torch.zeros(2)}, {"p": -1.0}), r"learning_rates\[p\] must be at least 0, got -1\.0"),
        (lambda: a_soup(scale=-1.0), r"scale must be positive and finite, got -1\.0"),
        (lambda: etsplat.SoupAppearance(distance="bar"), "distance must be one of 'barycentric', 'sdf', got 'bar'"),
    ],
)
def test_settings_out_of_their_range_are_named_where_they_are_given(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_a_trainer_says_so_where_somebody_else_has_replaced_tensors_of_its_model() -> None:
    """As a second Trainer on the same mesh does; the first said that a parameter had no gradient."""
    mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
    photometric = etsplat.Objective(etsplat.Photometric())
    first = etsplat.Trainer(mesh, PHOTOS, photometric)
    first.fit(1)
    etsplat.Trainer(mesh, PHOTOS, photometric, etsplat.SubdivideAndUntangle({1: 100})).fit(1)
    with pytest.raises(ValueError, match=r"model: vertices, colors, opacity_logits were replaced .* Trainer anew"):
        first.fit(2)
    again = etsplat.Trainer(mesh, PHOTOS, photometric)
    with torch.no_grad():
        mesh.vertices.mul_(1.01)
    again.fit(1)
    assert repr(again) == f"Trainer(TriangleMesh of {mesh.count} triangles, {len(PHOTOS.train)} photos, 1 steps)"


@pytest.mark.parametrize(
    ("make", "name"),
    [(lambda: etsplat.CameraRefinement("poses"), "begin"), (lambda: etsplat.Exposure("auto"), "measured_at")],  # pyright: ignore[reportArgumentType]
)
def test_choices_in_the_place_of_iterations_are_named(make: Callable[[], Any], name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be an integer of at least 0, got"):
        make()
