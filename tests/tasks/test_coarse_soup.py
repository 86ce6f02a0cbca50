"""What a coarse soup sees of a hollow into which no lid of the hull can be pushed."""

import math
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import etsplat.tasks.coarse_soup as coarse_soup
import etsplat.tasks.cut_hulls as cut_hulls
import etsplat.tasks.starts as starts
from etsplat.data.closed_hollows import closed_hollows
from etsplat.data.hollows import Opened, open_hollows
from etsplat.data.photograph import photograph
from etsplat.data.visual_hull import visual_hull
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.geometry.distance import closest_points
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.parts import Shape, shape_of
from etsplat.io.mesh_files import MeshFile
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.loop import Event, NoteEvent, StageEvent
from etsplat.tasks.judgement import CLOSED, CONTRADICTED
from etsplat.tasks.reconstruct import _grown_over, _judge
from etsplat.tasks.reconstruct_config import ReconstructConfig
from helpers.painting import mean_colors, painted_pictures
from helpers.revolved import BOWL, CAN, MUG, VASE, line, revolved

CONFIG = ReconstructConfig.quick().changed({"start.hull_faces": 1600})


def test_a_hull_that_photos_contradict_is_cut_open_where_a_soup_sees_through_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A vase, behind whose opening hardly a point is seen by two photos, where walls of one thickness are not found.

    Of fewer faces its hull has edges longer than walls are thick: then it depends on what processors round.
    """
    for walls in ("between_walls", "between_plain_walls"):
        monkeypatch.setattr(cut_hulls, walls, lambda *_, **others: None)
    vertices, faces, views = painted_pictures(*revolved(VASE))
    lidded = open_hollows(views, *visual_hull(views, 3000))
    assert lidded.contradicted > CONTRADICTED
    told = list[Event]()
    started = starts.make_start(None, views, CONFIG.changed({"start.hull_faces": 3000}), tell=told.append)
    assert started.cut == "soup"
    said = "photos contradict the visual hull on (.*) % of its surface: a coarse soup is asked what is free"
    (sentence,) = [event for event in told if isinstance(event, NoteEvent)]
    fitted = [event for event in told if isinstance(event, StageEvent) and event.name == "Fitting a coarse soup"]
    assert [event.done for event in fitted] == list(range(20, 801, 20))
    assert told.index(sentence) < told.index(fitted[0])
    share = re.fullmatch(said, str(sentence))
    assert share
    assert float(share[1]) == pytest.approx(2.3, abs=0.2)  # it differs by what processors round
    assert started.contradicted < 0.5 * lidded.contradicted
    closed = closed_hollows(views, (vertices, faces), (lidded.vertices, lidded.faces))
    assert closed_hollows(views, (vertices, faces), started.mesh.surface()) < 0.6 * closed


def test_what_is_free_is_the_same_to_the_bit_on_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the surface of a resumed run, which starts once more, must be; another seed sees something else."""
    monkeypatch.setattr(coarse_soup, "STEPS", 20)
    _, _, views = painted_pictures(*revolved(VASE))
    vertices, _ = visual_hull(views, 400)
    points = torch.rand(1000, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    before, found = num_threads(), []
    for threads, seed in ((1, 0), (3, 0), (1, 1)):
        set_num_threads(threads)
        found.append(coarse_soup.seen_through(views, vertices, CONFIG.changed({"seed": seed}))(points))
    set_num_threads(before)
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


def test_no_soup_is_asked_where_photos_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bowl with a bottom thicker than its walls: its lid goes down, and is nearer once it is cut out."""
    monkeypatch.setattr(cut_hulls, "seen_through", None)
    vertices, _, views = painted_pictures(*revolved(BOWL))
    lidded = open_hollows(views, *visual_hull(views, 1600))
    assert lidded.contradicted < CONTRADICTED
    started = starts.make_start(None, views, CONFIG)
    assert started.cut == "walls"
    before, after = (closest_points(vertices, *surface)[0].mean() for surface in (lidded[:2], started.mesh.surface()))
    assert after < before / 2


def test_no_walls_are_cut_where_there_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a can without a hollow, nor where photos agree no more on what was cut out."""
    monkeypatch.setattr(cut_hulls, "seen_through", None)
    _, _, views = painted_pictures(*revolved(CAN))
    assert starts.make_start(None, views, CONFIG).cut is None
    _, _, views = painted_pictures(*revolved(BOWL))
    for walls in ("between_walls", "between_plain_walls"):
        monkeypatch.setattr(cut_hulls, walls, lambda *_, **others: lambda points: points.norm(dim=1) - 0.1)
    assert starts.make_start(None, views, CONFIG).cut is None


def test_no_soup_is_asked_where_photos_agree_on_the_walls_of_a_hollow(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mug in few photos, whose lid does not go down."""
    monkeypatch.setattr(cut_hulls, "seen_through", None)
    vertices, faces, views = painted_pictures(*revolved(MUG))
    views = replace(views, train=views.train[::2])
    lidded = open_hollows(views, *visual_hull(views, 3200))
    assert lidded.contradicted > CONTRADICTED
    started = starts.make_start(None, views, CONFIG.changed({"start.hull_faces": 3200}))
    assert started.cut == "walls"
    assert started.contradicted <= CONTRADICTED
    assert shape_of(*started.mesh.surface()) == Shape(1, 0)
    before, after = ((lidded.vertices, lidded.faces), started.mesh.surface())
    closed = closed_hollows(views, (vertices, faces), before)
    assert closed_hollows(views, (vertices, faces), after) < 0.1 * closed


def test_a_hollow_that_was_cut_open_and_is_closed_again_is_noticed() -> None:
    """Of a result that is the hull once more, and not of one that is open, nor where nothing was cut."""
    vertices, faces, views = painted_pictures(*revolved(MUG))
    opened, over = Opened(vertices, faces, 0, 0.0, 1.0, 1.0), visual_hull(views, 3200)
    look = {"colors": 0.5, "opacity": 0.98, "sigma": 0.25}
    closed, open_ = (TriangleMesh.from_mesh(*each, **look) for each in (over, (vertices, faces)))
    cut, whole = (starts.Started(open_, "hull", opened, None, cut) for cut in ("soup", None))
    assert _grown_over(views, cut, closed) > 10 * CLOSED
    assert _grown_over(views, cut, open_) == 0
    assert _grown_over(views, whole, closed) == 0


@pytest.mark.parametrize(("most", "taken"), [(5000, False), (6000, True)])
def test_no_start_has_more_faces_than_a_run_may_have(monkeypatch: pytest.MonkeyPatch, most: int, taken: bool) -> None:
    """Walls have two sides."""
    _, _, views = painted_pictures(*revolved(VASE))
    vertices, faces = icosphere(4)
    assert len(faces) == 5120
    monkeypatch.setattr(cut_hulls, "between_walls", lambda *_, **others: lambda points: points[:, 0] * 0 - 1)
    monkeypatch.setattr(cut_hulls, "seen_through", lambda *_: lambda points: points[:, 0] * 0 - 1)
    monkeypatch.setattr(cut_hulls, "visual_hull", lambda *_, **others: (vertices, faces))
    monkeypatch.setattr(cut_hulls, "open_hull", lambda _, v, f, *told: Opened(v, f, 0, 0.0, 1.0, 1.0))
    contradicted = Opened(vertices, faces[:1000], 0, 0.5, 1.0, 0.0)
    config = CONFIG.changed({"max_faces": most})
    _, cut = cut_hulls.cut_open(
        views, starts.Hull(vertices, faces, 1400, 0.5), contradicted, config, None, lambda event: None
    )
    assert bool(cut) == taken


@pytest.mark.parametrize(
    ("share", "bottom", "asked"), [(0.007, True, True), (0.007, False, False), (0.02, False, True)]
)
def test_what_is_open_is_contradicted_by_more_before_a_soup_is_asked(
    monkeypatch: pytest.MonkeyPatch, share: float, bottom: bool, asked: bool
) -> None:
    """Of a cube without its bottom a soup made walls, and what was between them was filled."""
    _, _, views = painted_pictures(*revolved(VASE))
    vertices, faces = icosphere(3)
    start = Opened(vertices, faces if bottom else faces[100:], 0, share, 1.0, 1.0)
    hull, calls = starts.Hull(vertices, faces, 1400, 0.0), list[object]()
    monkeypatch.setattr(cut_hulls, "between_walls", lambda *_, **others: None)
    monkeypatch.setattr(cut_hulls, "between_plain_walls", lambda *_, **others: None)
    monkeypatch.setattr(cut_hulls, "visual_hull", lambda *_, **others: (vertices, faces[:0]))
    monkeypatch.setattr(cut_hulls, "seen_through", lambda *_: calls.append(_))
    found, cut = cut_hulls.cut_open(views, hull, start, CONFIG, None, lambda event: None)
    assert found is start
    assert cut is (False if asked else None)
    assert bool(calls) == asked


@pytest.mark.parametrize(
    ("soup", "agreed", "taken", "by"),
    [(0.09, 0.9, 2800, "walls"), (0.05, 0.9, 1400, "soup"), (0.05, 0.7, 2800, "walls")],
)
def test_a_soup_must_be_clearly_better_than_walls(
    monkeypatch: pytest.MonkeyPatch, soup: float, agreed: float, taken: int, by: str
) -> None:
    """Of walls and a soup's cut that are contradicted about alike, walls are nearer; faces tell here which was cut.

    Nor is a cut better of which no patch is contradicted and on which photos agree less, as of a mug in few photos.
    """
    _, _, views = painted_pictures(*revolved(VASE))
    vertices, faces = icosphere(4)
    monkeypatch.setattr(cut_hulls, "between_walls", lambda *_, **others: lambda points: points[:, 0])
    monkeypatch.setattr(cut_hulls, "seen_through", lambda *_: lambda points: points[:, 0])
    monkeypatch.setattr(cut_hulls, "visual_hull", lambda _, wanted, **others: (vertices, faces[:wanted]))
    shares = {2800: 0.1, 1400: soup}  # contradicted: of walls, which have twice the faces, and of the soup's cut
    monkeypatch.setattr(cut_hulls, "open_hull", lambda _, v, f, *told: Opened(v, f, 0, shares[len(f)], 1.0, 1.0))
    asked = {2800: 0.8, 1400: agreed}
    monkeypatch.setattr(cut_hulls._Cutter, "asked", lambda _, how, surface: asked.get(len(surface[1]), 0.9))
    contradicted, hull = Opened(vertices, faces, 0, 0.5, 1.0, 0.0), starts.Hull(vertices, faces, 1400, 1.0)
    best, cut = cut_hulls.cut_open(
        views, hull, contradicted, CONFIG.changed({"max_faces": 6000}), None, lambda event: None
    )
    assert cut == by
    assert len(best.faces) == taken


def test_a_cut_that_photos_contradict_as_much_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here all space is free but for a ball, or none is."""
    _, _, views = painted_pictures(*revolved(VASE))
    plain = open_hollows(views, *visual_hull(views, 1600))
    for free in (lambda points: points.norm(dim=1) - 0.5, lambda points: points[:, 0] * 0 + 1):
        monkeypatch.setattr(cut_hulls, "seen_through", lambda *_, free=free: free)
        started = starts.make_start(None, views, CONFIG)
        assert started.cut is False
        assert started.contradicted == pytest.approx(plain.contradicted, abs=0.01)


@pytest.mark.parametrize(("share", "verdict"), [(0.002, "good"), (0.003, "poor: photos contradict each other on")])
def test_a_result_is_asked_what_photos_contradict_where_its_start_was_in_doubt(share: float, verdict: str) -> None:
    """A start just below what is cut open is so far from photos that its hollows may be closed: a pipe's two lids."""
    _, _, views = painted_pictures(*revolved(BOWL))
    vertices, faces = visual_hull(views, 1600)
    colors = mean_colors(views, vertices, faces)
    mesh = TriangleMesh.from_mesh(vertices, faces, colors=colors, opacity=None, sigma=None)
    hull = starts.Hull(vertices, faces, 1600, 0.0)
    started = starts.Started(mesh, "hull", Opened(vertices, faces, 0, share, 0.0, 1.0), hull, False)
    scorer = SimpleNamespace(opaque=lambda *_: {"silhouette_iou": 0.99, "psnr_mesh": 30.0})
    scores = {"silhouette_iou": 0.99, "psnr_mesh": 30.0, "self_intersections": 0}
    found = _judge(scorer, views, None, CONFIG, started, shape_of(vertices, faces), mesh, scores)
    assert found.verdict.startswith(verdict)


def test_a_white_vessel_with_thin_walls_is_no_open_sheet() -> None:
    """Its lid is removed, since within it looks as it does outside; how thick its walls are shading tells."""
    out, wall, low, high = 0.5, 0.06, -0.5, 0.4
    outer = [(0.0, low), *line((0.04, low), (out, low)), *line((out, low), (out, high))]
    inner = [*line((out - wall, high), (out - wall, low + wall)), *line((out - wall, low + wall), (0.04, low + wall))]
    vertices, faces = revolved([*outer, (out, high), *inner, (0.0, low + wall)])
    turned = vertices[:, [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0])  # its axis along the light
    views = photograph(MeshFile(turned, faces), 200, 200)
    started = starts.make_start(None, views, CONFIG.changed({"start.hull_faces": 3200}))
    assert started.cut == "walls"
    assert shape_of(*started.mesh.surface()) == Shape(1, 0)
    truth = views.normalization.apply(turned)
    assert float(closest_points(truth, *started.mesh.surface())[0].sqrt().max()) < 1.5 * wall


def test_a_sheet_is_known_by_its_lid_that_was_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many faces it has once what was stretched is divided: texture is not asked, both sides look alike."""
    _, _, views = painted_pictures(*revolved(VASE))
    (vertices, faces), (finer, more), asked = icosphere(3), icosphere(4), list[str]()
    monkeypatch.setattr(cut_hulls, "without_false_handles", lambda _, v, f: (v, f))
    monkeypatch.setattr(cut_hulls, "without_lids", lambda _, v, f: (v, f[100:]))
    monkeypatch.setattr(
        cut_hulls, "open_hollows", lambda _, v, f, **most: Opened(finer, more[1:], 0, 0.0, 0.0, 1.0, (v, f))
    )
    for walls in ("between_walls", "between_plain_walls"):
        monkeypatch.setattr(cut_hulls, walls, lambda *_, name=walls, **others: asked.append(name))
    opened = cut_hulls.open_hull(views, vertices, faces, 10_000, lambda event: None)
    cut_hulls.cut_open(views, starts.Hull(vertices, faces, 1400, 0.0), opened, CONFIG, None, lambda event: None)
    assert asked == ["between_plain_walls"]


def test_a_soup_opens_a_white_dimple() -> None:
    """Which has no walls, and on which nothing correlates: photos show other colours at each place of its lid."""
    outer, inner = (torch.linspace(0, end, 25).tolist() for end in (2.2, 1.18))
    ball = [(0.8 * math.sin(a), -0.8 * math.cos(a)) for a in outer]
    within = [(0.7 * math.sin(a), 0.737 - 0.7 * math.cos(a)) for a in reversed(inner[:-1])]
    vertices, faces = revolved([*ball, *within])
    views = photograph(MeshFile(vertices, faces), 160, 160)
    hull = visual_hull(views, 1600)
    told = list[Event]()
    started = starts.make_start(None, views, CONFIG, tell=told.append)
    assert started.cut == "soup"
    assert any(isinstance(event, NoteEvent) and "other colours" in event.text for event in told)
    truth = views.normalization.apply(vertices)
    before, after = (float(closest_points(truth, *each)[0].mean()) for each in (hull, started.mesh.surface()))
    assert after < 0.2 * before
