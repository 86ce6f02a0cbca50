"""The opaque mesh of a scene: from a soup, fitted by the z-buffer, kept beside the soup, resumed to the bit."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from safetensors.torch import load_file

from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.shown_width import ShownWidths
from etsplat.geometry.regions import Sphere
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.io.opaque_files import load_opaque, save_opaque
from etsplat.io.run_directory import RunDirectory
from etsplat.model.solid_soup import SolidSoup
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import FOCAL_NOTE, TriangleSoup
from etsplat.optim.exposure import Exposure
from etsplat.optim.loop import DivergedError, Event, StageEvent
from etsplat.optim.schedules import NEVER
from etsplat.tasks import train as tasks_train
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opaque import finished_mesh, make_opaque_trainer, opaque_mesh, start_mesh
from etsplat.tasks.opened_runs import SoupRun, open_run
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.render_soup import draw, drawn_soup
from etsplat.tasks.scoring import evaluate_run
from etsplat.tasks.soup_trainer import shown_across
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig
from helpers.captures import small_demo_scene
from helpers.reconstructions import KilledError

CONFIG = TrainConfig.tiny().changed(
    {
        "asset": True,
        "sky": "sphere",
        "iterations": 60,
        "max_triangles": 1200,
        "output.log_every": 3,
        "output.checkpoint_every": 6,
    }
)
STAGES = ["Making opaque triangles", "Fitting the opaque mesh"]


@pytest.fixture(scope="module")
def capture() -> Dataset:
    return small_demo_scene()


@pytest.fixture(scope="module")
def run(capture: Dataset, tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDirectory, list[Event]]:
    events: list[Event] = []
    out = tmp_path_factory.mktemp("opaque") / "run"
    train(capture, out, CONFIG, callbacks=[events.append])
    return RunDirectory(out), events


def soup_of(*opacities: float) -> TriangleSoup:
    count = len(opacities)
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]]) + torch.arange(count)[:, None, None]
    colors = torch.linspace(0.1, 0.9, 3 * count).reshape(count, 3)
    soup = TriangleSoup.from_triangles(corners, colors, opacity=0.5, sigma=0.3, sh_degree=1)
    soup.opacity_logits = torch.logit(torch.tensor(opacities))
    return soup


def grey_soup(capture: Dataset, count: int) -> TriangleSoup:
    """Triangles at some of the points of a capture."""
    assert capture.points is not None
    offsets = 0.05 * torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(1))
    corners = (capture.points[:count, None] + offsets).float()
    return TriangleSoup.from_triangles(corners, torch.full((count, 3), 0.5), opacity=0.9, sigma=0.1, sh_degree=0)


def die_in(name: str, done: int) -> Callable[[Event], None]:
    """A callback that stands for a kill at a step of a stage."""

    def callback(event: Event) -> None:
        if isinstance(event, StageEvent) and event.name == name and event.done >= done:
            raise KilledError

    return callback


def files(run: RunDirectory) -> dict[str, bytes]:
    """All results that have no times in them."""
    paths = [run.soup_path, run.opaque_path, *sorted(run.test.iterdir())]
    return {path.name: path.read_bytes() for path in paths}


def test_the_mesh_of_a_soup_has_its_opaque_triangles_with_corners_of_their_own() -> None:
    """Those half opaque and more, in their constant colour at each of their corners."""
    soup = soup_of(0.9, 0.2, 0.6)
    mesh = opaque_mesh(soup)
    assert mesh.count == 2
    assert len(mesh.vertices) == 6
    assert torch.equal(mesh.vertices[mesh.faces], soup.vertices.detach()[[0, 2]])
    torch.testing.assert_close(mesh.colors[mesh.faces], soup.display_colors()[[0, 2], None].expand(2, 3, 3))


@pytest.mark.parametrize(("most", "fewest"), [(500, 500), (800, 550)])
def test_fitting_comes_closer_to_the_photos_and_divides_where_they_are_wrong(
    most: int, fewest: int, capture: Dataset
) -> None:
    """From grey triangles: the loss falls, and there are as many faces as photos carry; more where they agree."""
    own = capture.normalized()
    mesh = opaque_mesh(grey_soup(own, 300))
    trainer = make_opaque_trainer(
        mesh, own, iterations=80, unit=1.0, carried=500, max_faces=most, background=(0.0, 0.0, 0.0)
    )
    losses: list[float] = []
    trainer.fit(80, callbacks=[lambda event: losses.append(getattr(event, "loss", losses[-1] if losses else 1.0))])
    assert losses[-1] < 0.8 * losses[0]
    assert fewest <= mesh.count <= most


def test_no_view_looks_through_a_mesh_with_a_backdrop(capture: Dataset) -> None:
    """It stays closed and in its place while it is coloured and halved; other corners move."""
    own = capture.normalized()
    around = Surroundings.of(own)
    mesh = opaque_mesh(grey_soup(own, 300), around.backdrop(own))
    corners = mesh.vertices.detach().clone()
    far = around.at_backdrop(corners)
    trainer = make_opaque_trainer(
        mesh, own, iterations=20, unit=1.0, carried=800, max_faces=900, background=(0.0, 0.0, 0.0), around=around
    )
    trainer.fit(2)  # before the first edit
    moved = (mesh.vertices.detach() != corners).any(dim=1)
    assert not bool(moved[far].any())
    assert bool(moved[~far].any())
    trainer.fit(20)
    assert mesh.count > 620
    for camera in own.cameras:
        seen = mesh.render(camera).triangle
        assert seen is not None
        assert int((seen < 0).sum()) <= 2  # a halved edge is one of floats beside a whole one


@pytest.mark.parametrize("sky", ["sphere", "dome", "none"])
def test_runs_with_a_sky_have_a_backdrop(sky: str, capture: Dataset) -> None:
    own = capture.normalized()
    trainer = start_mesh(grey_soup(own, 300), Exposure(NEVER), own, own, CONFIG.changed({"sky": sky}))
    seen = trainer.model.render(own.cameras[0]).triangle
    assert seen is not None
    assert bool((seen < 0).any()) == (sky == "none")


def test_what_no_photo_shows_gets_the_colours_of_what_is_near(capture: Dataset) -> None:
    """What one shows keeps its own; doing it again changes nothing."""
    own = capture.normalized()
    soup = grey_soup(own, 300)
    soup = soup.joined(replace(soup, vertices=soup.vertices + 1000.0))  # out of sight
    mesh = opaque_mesh(soup)
    with torch.no_grad():
        mesh.colors[:900] = torch.tensor([0.9, 0.1, 0.1])
    finished_mesh(mesh, own)
    colors = mesh.colors.detach().clone()
    torch.testing.assert_close(colors, torch.tensor([[0.9, 0.1, 0.1]]).expand_as(colors))
    assert torch.equal(finished_mesh(mesh, own).colors, colors)


def test_corners_move_as_fast_on_screen_near_and_far(capture: Dataset) -> None:
    """In proportion to what photos show where they are, within limits, after halving too; unseen ones as usual."""
    own = capture.normalized()
    assert own.points is not None
    middles = torch.cat([own.points[:200], 1e6 * own.points[:1]])[:, None]
    corners = middles + 0.01 * torch.randn(201, 3, 3, generator=torch.Generator().manual_seed(1))
    soup = TriangleSoup.from_triangles(corners.float(), torch.full((201, 3), 0.5), opacity=0.9, sigma=0.1, sh_degree=0)
    unit = shown_across(soup, own)
    trainer = make_opaque_trainer(
        opaque_mesh(soup), own, iterations=40, unit=unit, carried=300, max_faces=300, background=(0.0, 0.0, 0.0)
    )
    for edits in (0, 1):
        trainer.fit(8 * edits)
        paces, model = trainer.adam.paces["vertices"].reshape(-1, 3), trainer.model
        assert (len(paces) > 201) == bool(edits)
        assert (paces == paces[:, :1]).all()
        places = trainer.adam.parameters["vertices"].detach().reshape(-1, 3, 3).mean(dim=1)
        shown = ShownWidths(own)(places) / unit
        seen = shown.isfinite()
        assert 0 < int((~seen).sum()) < len(seen) == model.count
        assert (paces[~seen] == 1).all()
        tolerance = 1e-6 if edits == 0 else 0.2  # they have moved since
        torch.testing.assert_close(paces[seen, 0], shown[seen].clamp(0.1, 30.0), rtol=tolerance, atol=tolerance)
        assert paces.max() > 1.2 * paces.min()


def test_a_run_ends_with_a_soup_and_a_better_opaque_mesh(run: tuple[RunDirectory, list[Event]]) -> None:
    """In the scene's units; it looks more like the photos than the soup does where that is drawn opaque."""
    directory, events = run
    metrics, mesh = directory.read_metrics(), load_opaque(directory.opaque_path)
    assert metrics["psnr_asset"] > metrics["psnr_opaque"] + 1
    assert metrics["asset_triangles"] == len(mesh.faces)
    soup = TriangleSoup.load(directory.soup_path)
    assert float(soup.notes[FOCAL_NOTE]) > 1
    assert float((mesh.vertices.median(dim=0).values - soup.vertices.reshape(-1, 3).median(dim=0).values).norm()) < 2
    stages = [event for event in events if isinstance(event, StageEvent)]
    assert list(dict.fromkeys(event.name for event in stages)) == STAGES
    assert all(event.done == event.total for event in stages if event is stages[-1])


def test_a_run_is_evaluated_with_its_opaque_mesh(run: tuple[RunDirectory, list[Event]], capture: Dataset) -> None:
    """As it was scored at its end, and apart from the soup drawn opaque."""
    directory = run[0]
    soup, mesh = TriangleSoup.load(directory.soup_path), load_opaque(directory.opaque_path)
    found, metrics = evaluate_run(SoupRun(directory.path, soup, capture, mesh)), directory.read_metrics()
    for name in ("psnr_asset", "ssim_asset", "flip_asset", "psnr_opaque"):
        assert found[name] == pytest.approx(metrics[name], rel=1e-3)


@pytest.mark.parametrize("stage", STAGES)
def test_a_run_killed_while_it_makes_the_mesh_ends_with_the_same_bits(
    stage: str, run: tuple[RunDirectory, list[Event]], capture: Dataset, tmp_path: Path
) -> None:
    """In either of its stages."""
    with pytest.raises(KilledError):
        train(capture, tmp_path / "run", CONFIG, callbacks=[die_in(stage, 7)])
    train(capture, tmp_path / "run", CONFIG, resume=True, callbacks=[lambda event: None])
    assert files(RunDirectory(tmp_path / "run")) == files(run[0])


def test_without_it_nothing_else_changes(
    run: tuple[RunDirectory, list[Event]], capture: Dataset, tmp_path: Path
) -> None:
    """The soup has the same bits, and no mesh lies beside it; not after a run with one is replaced either."""
    train(capture, tmp_path / "run", CONFIG, callbacks=[lambda event: None])
    train(capture, tmp_path / "run", CONFIG.changed({"asset": False}), overwrite=True, callbacks=[lambda event: None])
    directory = RunDirectory(tmp_path / "run")
    assert TriangleSoup.load(directory.soup_path).vertices.equal(TriangleSoup.load(run[0].soup_path).vertices)
    assert not directory.opaque_path.exists()
    assert not (directory.path / "stages").exists()
    assert "psnr_asset" not in directory.read_metrics()


def test_exports_and_opaque_pictures_are_of_the_mesh(run: tuple[RunDirectory, list[Event]], tmp_path: Path) -> None:
    """opaque.glb is what `export` writes; PLY has the same corners; --triangles soup those of the soup."""
    opened = replace(open_run(run[0].path), capture=demo_scene(64, 48))
    assert opened.opaque is not None
    assert opened.solid is not None
    export_soup(opened, tmp_path / "opaque.glb", ExportConfig())
    assert (tmp_path / "opaque.glb").read_bytes() == (run[0].path / "opaque.glb").read_bytes()
    export_soup(opened, tmp_path / "mesh.ply", ExportConfig(up="keep", sky="joined"))
    written, mesh = load_mesh(tmp_path / "mesh.ply"), opened.opaque
    assert torch.equal(written.vertices[written.faces], mesh.vertices[mesh.faces])
    assert written.vertex_colors is not None or written.face_colors is not None
    soup = export_soup(opened, tmp_path / "soup.ply", ExportConfig(triangles="soup", up="keep", sky="joined"))
    assert soup.triangles == int(opened.soup.seen_opaque.sum())
    assert opened.capture is not None
    camera = opened.capture.cameras[0]
    drawn = draw(drawn_soup(opened, RenderConfig(opaque=True)), camera, RenderConfig(opaque=True))["color"]
    model = TriangleMesh.from_mesh(
        mesh.vertices, mesh.faces, colors=mesh.vertex_colors, opacity=None, sigma=None, vertex_colored=True
    )
    expected = model.render_opaque(camera)[0, ..., :3]
    assert float(((drawn - expected).abs() > 1e-4).float().mean()) < 0.01  # equally near triangles
    cropped = drawn_soup(opened, RenderConfig(opaque=True), Sphere((0.0, 0.0, 0.0), 1.0))
    assert 0 < len(cropped) < len(opened.solid)
    assert isinstance(cropped, SolidSoup)
    assert len(cropped.corner_colors) == len(cropped)


@pytest.mark.usefixtures("command_line")
def test_the_soup_in_the_place_of_the_mesh_is_whole_and_said(
    run: tuple[RunDirectory, list[Event]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With --alpha what is faint stays; where most is left out the remedy is not to train with what it was trained."""
    opacities = TriangleSoup.load(run[0].soup_path).drawn_opacities
    most = float(opacities.quantile(0.8))
    command = ["export", str(run[0].path), "--sky", "joined", "--out"]
    assert parse([*command, str(tmp_path / "a.glb"), "--alpha"]).run([]) == 0
    said = capsys.readouterr().out
    assert f"{len(opacities):,} triangles" in said
    assert "It is the soup, not the run's opaque mesh (--alpha)." in said
    assert "Left out" not in said
    assert parse([*command, str(tmp_path / "b.glb"), "--triangles", "soup", "--min-opacity", str(most)]).run([]) == 0
    said = capsys.readouterr().out
    assert "not the run's opaque mesh (--triangles soup)" in said
    assert "Most of it is too faint; lower --min-opacity, or take the run's opaque mesh (without" in said
    assert "--asset" not in said


def test_the_file_of_the_opaque_mesh_is_drawn_and_exported_by_itself(
    run: tuple[RunDirectory, list[Event]], capture: Dataset, tmp_path: Path
) -> None:
    whole, alone = open_run(run[0].path), open_run(run[0].opaque_path)
    assert whole.solid is not None
    camera = capture.cameras[0]
    assert torch.equal(alone.soup.render_opaque(camera), whole.solid.render_opaque(camera))
    config = ExportConfig(up="keep", sky="joined")
    for opened, name in ((whole, "a.ply"), (alone, "b.ply")):
        export_soup(opened, tmp_path / name, config)
    assert torch.equal(load_mesh(tmp_path / "a.ply").vertices, load_mesh(tmp_path / "b.ply").vertices)


def test_corners_of_the_sky_keep_their_colours_when_they_are_turned_inwards(tmp_path: Path) -> None:
    """A sky triangle that runs outwards is turned in the file; what each of its corners is coloured stays."""
    far = torch.tensor([[10.0, -1, 0], [10, 1, 0], [10, 0, 1]])  # counterclockwise from outside
    for corners in (far, far.flip(0)):
        vertices = torch.cat([corners, torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])])
        colors = torch.cat([torch.eye(3), torch.full((3, 3), 0.5)])
        mesh = MeshFile(vertices, torch.arange(6).reshape(2, 3), vertex_colors=colors)
        soup = replace(soup_of(0.9), notes={Surroundings.NOTE: Surroundings(torch.zeros(3), 10.0).note})
        export_soup(SoupRun(tmp_path, soup, None, mesh), tmp_path / "o.glb", ExportConfig(up="keep"))
        sky = trimesh.load(tmp_path / "o.glb").geometry["sky"]
        a, b, c = torch.tensor(np.array(sky.triangles[0]))
        assert float(torch.linalg.cross(b - a, c - a)[0]) < 0  # towards the middle
        found = dict(
            zip(map(tuple, sky.vertices.round(3).tolist()), sky.visual.vertex_attributes["color"], strict=True)
        )
        for position, color in zip(corners.tolist(), torch.eye(3).tolist(), strict=True):
            assert found[tuple(position)][:3].tolist() == color


def test_an_opaque_soup_becomes_the_mesh_itself(capture: Dataset, tmp_path: Path) -> None:
    """With finish opaque there is no second soup."""
    events: list[Event] = []
    train(capture, tmp_path / "run", CONFIG.changed({"finish": "opaque"}), callbacks=[events.append])
    assert {event.name for event in events if isinstance(event, StageEvent)} == {STAGES[1]}


def test_without_points_the_mesh_begins_where_the_soup_is(capture: Dataset, tmp_path: Path) -> None:
    """Random points would all become opaque, and stand before the scene: 10.6 dB on a capture that has 28.1 so."""
    bare = replace(capture, exact_points=None, point_colors=None)
    config = CONFIG.changed({"iterations": 150, "start.points": 3000, "max_triangles": 1000, "sky": "none"})
    metrics = train(bare, tmp_path / "run", config, callbacks=[lambda event: None]).metrics
    assert metrics["asset_triangles"] <= 1000
    assert metrics["psnr_asset"] > metrics["psnr"] - 4


def fallen_apart(*_: object) -> TriangleMesh:
    raise DivergedError("no triangle is left at iteration 3")


def nothing_but_sky(job: object, soup: TriangleSoup, exposure: Exposure, capture: Dataset, _: object) -> TriangleMesh:
    return opaque_mesh(
        replace(soup, **{name: values[:0] for name, values in soup.state().items()}),
        Surroundings.of(capture).backdrop(capture),
    )


@pytest.mark.parametrize(
    ("fit", "told"),
    [(fallen_apart, "no triangle is left at iteration 3"), (nothing_but_sky, "nothing but the sky is left")],
)
def test_a_mesh_that_falls_apart_takes_nothing_from_the_soup(
    run: tuple[RunDirectory, list[Event]],
    capture: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    fit: Callable[..., TriangleMesh],
    told: str,
) -> None:
    """The run ends as one without a mesh, and a note says why."""
    monkeypatch.setattr(tasks_train, "fit_opaque_mesh", fit)
    events: list[Event] = []
    result = train(capture, tmp_path / "run", CONFIG, callbacks=[events.append])
    assert f"no opaque mesh: {told}" in [str(event) for event in events]
    assert result.opaque is None
    assert "asset_triangles" not in result.metrics
    assert (result.path / "soup.safetensors").read_bytes() == run[0].soup_path.read_bytes()


def test_exposures_that_the_run_learned_hold_for_the_mesh(capture: Dataset, tmp_path: Path) -> None:
    """From its first step on: photos would otherwise pull its colours apart."""
    config = CONFIG.changed({"exposure": "on", "output.checkpoint_every": 1})
    train(capture, tmp_path / "run", config, callbacks=[lambda event: None])
    learned, taken = (
        load_file(str(sorted((tmp_path / "run" / place).glob("*.safetensors"))[-1]))["exposure.values"]
        for place in ("checkpoints", "stages/mesh/checkpoints")
    )
    assert float(learned.abs().max()) > 1e-3
    assert float((taken - learned).norm()) < float(learned.norm())


def test_a_soup_that_is_opaque_through_and_through_can_be_read_again(tmp_path: Path) -> None:
    """What the floor brings to 1 has a finite logit."""
    soup = soup_of(0.9, 1 - 2.0**-24)
    soup.opacity_logits = torch.tensor([40.0, 90.0])
    soup.appearance = SoupAppearance(opacity_floor=0.995, sigma_ceiling=0.05)
    soup.finished().save(tmp_path / "soup.safetensors")
    assert float(TriangleSoup.load(tmp_path / "soup.safetensors").opacities.min()) > 0.99


def test_the_mesh_comes_back_exactly_and_other_files_are_refused(tmp_path: Path) -> None:
    """Errors name the file."""
    path = tmp_path / "opaque.safetensors"
    mesh = MeshFile(torch.rand(6, 3), torch.arange(6).reshape(2, 3), vertex_colors=torch.rand(6, 3))
    save_opaque(path, mesh)
    again = load_opaque(path)
    assert torch.equal(again.vertices, mesh.vertices)
    assert torch.equal(again.faces, mesh.faces)
    assert again.vertex_colors is not None
    assert torch.equal(again.vertex_colors, mesh.vertex_colors)
    for spoilt in (
        replace(mesh, vertices=torch.full((6, 3), torch.nan)),
        replace(mesh, faces=torch.full((2, 3), 6)),
        replace(mesh, vertex_colors=torch.rand(5, 3)),
    ):
        save_opaque(path, spoilt)
        with pytest.raises(InputError, match=r"opaque\.safetensors: cannot be read"):
            load_opaque(path)
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(InputError, match="cannot be read"):
        load_opaque(path)
    soup_of(0.9).save(path)
    with pytest.raises(InputError, match="not an opaque mesh"):
        load_opaque(path)
