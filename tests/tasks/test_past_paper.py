"""Settings of shape reconstruction that the paper does not have: each does what it says, and resumes to the bit."""

from pathlib import Path

import pytest
import torch

from etsplat.data.agreement import settled, unseen_vertices
from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.intersections import count_self_intersections
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.untangle import untangle
from etsplat.io.mesh_files import MeshFile
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.adam import Adam
from etsplat.optim.loop import StepEvent
from etsplat.optim.schedules import NEVER, coarse_level, evenly, regularization_weight
from etsplat.optim.vertex_updates import laplacian_solver, uniform_step
from etsplat.tasks.reconstruct import make_trainer, reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.reconstruct_schedule import outlines_after
from helpers.meshes import bumpy_sphere
from helpers.painting import painted_pictures
from helpers.revolved import BOWL, revolved

SHORT = ReconstructConfig.tiny().changed(
    {"iterations": 40, "output.checkpoint_every": 10, "refinement.subdivisions": 3, "output.chamfer_samples": 2000}
)


def _small_ball(harmonics: int = 0) -> tuple[TriangleMesh, Dataset]:
    """A start of 320 faces, and photos of the demo's object."""
    views = photograph(demo_object(), 16, 16, elevations=(0.0,), azimuths=3, supersampling=1)
    mesh = TriangleMesh.from_mesh(*icosphere(2), colors=0.7, opacity=0.98, sigma=0.25, harmonics=harmonics)
    return mesh, views


def test_untangling_leaves_no_intersection_and_the_rest_in_place() -> None:
    """A sphere with a vertex pushed through its far side: only vertices near it move, and nothing intersects after."""
    vertices, faces = icosphere(3)
    vertices = vertices.clone()
    vertices[5] *= -1.2
    assert count_self_intersections(vertices, faces) > 0
    untangled, left = untangle(vertices, MeshTopology.from_faces(faces, len(vertices)))
    assert left == count_self_intersections(untangled, faces) == 0
    moved = (untangled != vertices).any(dim=1)
    assert bool(moved[5])
    assert int(moved.sum()) < len(vertices) / 2
    clean, _ = untangle(untangled, MeshTopology.from_faces(faces, len(vertices)))
    assert torch.equal(clean, untangled)


def test_untangling_moves_no_farther_than_it_must(monkeypatch: pytest.MonkeyPatch) -> None:
    """Vertices that smoothing moved go most of the way back, and nothing intersects for that."""
    vertices, faces = icosphere(3)
    vertices = vertices.clone()
    vertices[5] *= -1.2
    topology = MeshTopology.from_faces(faces, len(vertices))
    monkeypatch.setattr("etsplat.geometry.untangle._PUSHES", 0)
    untangled, _ = untangle(vertices, topology)
    monkeypatch.setattr("etsplat.geometry.untangle._RETURNS", 0)
    smoothed, _ = untangle(vertices, topology)
    moved = [float((result - vertices).norm(dim=1).sum()) for result in (untangled, smoothed)]
    assert moved[0] < 0.3 * moved[1]
    assert count_self_intersections(untangled, faces) == 0


def test_folds_out_of_reach_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cap pushed through the far side stays where it is, as a whole, while a stray vertex elsewhere is put right.

    If it is too thick to be turned right: else it and what it went through change places.
    """
    monkeypatch.setattr("etsplat.geometry.inside_out._THICK", 0.0)
    vertices, faces = icosphere(4)
    vertices = vertices.clone()
    topology = MeshTopology.from_faces(faces, len(vertices))
    cap, stray = vertices[:, 2] > 0.8, int(vertices[:, 0].argmax())
    vertices[cap, 2] -= 2.0
    of_cap = count_self_intersections(vertices, faces)
    vertices[stray] += torch.tensor([-0.02, 0.2, 0.0])
    assert count_self_intersections(vertices, faces) > of_cap > 0
    untangled, left = untangle(vertices, topology, reach=0.5)
    assert left == count_self_intersections(untangled, faces) == of_cap
    assert torch.equal(untangled[cap], vertices[cap])
    assert not torch.equal(untangled[stray], vertices[stray])


def test_small_faces_do_not_count_as_far() -> None:
    """A tangled patch, its edges a tenth of the others', is put right though vertices move by more than such edges."""
    vertices, faces = icosphere(4)
    vertices = vertices.clone()
    topology = MeshTopology.from_faces(faces, len(vertices))
    center = vertices[vertices[:, 2].argmax()].clone()
    patch = (vertices - center).norm(dim=1) < 0.2
    vertices[patch] = center + 0.1 * (vertices[patch] - center)
    vertices[patch] += 0.01 * torch.randn(int(patch.sum()), 3, generator=torch.Generator().manual_seed(0))
    assert count_self_intersections(vertices, faces) > 0
    untangled, left = untangle(vertices, topology, reach=0.155)
    assert left == count_self_intersections(untangled, faces) == 0


def test_the_solver_inverts_the_laplacian() -> None:
    """(I + w L) applied by hand to the solution gives back the right-hand side; constants stay as they are."""
    vertices, faces = bumpy_sphere(2, seed=1)
    topology = MeshTopology.from_faces(faces, len(vertices))
    solution = laplacian_solver(topology, 7.0)(vertices)
    laplacian = torch.zeros_like(solution)
    for first, second in topology.edges.tolist():
        laplacian[first] += solution[first] - solution[second]
        laplacian[second] += solution[second] - solution[first]
    torch.testing.assert_close(solution + 7.0 * laplacian, vertices, rtol=1e-4, atol=1e-5)
    ones = torch.ones(len(vertices), 3)
    torch.testing.assert_close(laplacian_solver(topology, 7.0)(ones), ones)


def test_a_uniform_step_keeps_the_proportions_of_the_gradient() -> None:
    """After the first step vertices moved along the gradient, the largest component by the rate; others as ever."""
    vertices, other = torch.zeros(4, 3, requires_grad=True), torch.zeros(2, requires_grad=True)
    adam = Adam({"vertices": vertices, "other": other}, {"vertices": 0.1, "other": 0.5})
    gradient = torch.tensor([[1.0, -2.0, 0.0]] * 4) * torch.tensor([[1.0], [0.5], [0.25], [0.0]])
    vertices.grad, other.grad = gradient.clone(), torch.tensor([3.0, -1e-3])
    uniform_step(adam, "vertices", 0.1, None)
    torch.testing.assert_close(vertices.detach(), -0.05 * gradient)
    torch.testing.assert_close(other.detach(), torch.tensor([-0.5, 0.5]))


def test_schedules_past_the_paper() -> None:
    """Levels fall one by one to 0 at the given time; the cosine ends where told; untanglings end with the run."""
    levels = [coarse_level(iteration, 100, 2, 0.5) for iteration in range(1, 101)]
    assert levels == [2] * 25 + [1] * 25 + [0] * 50
    assert coarse_level(1, 100, 0, 0.5) == 0
    assert coarse_level(1, 100, 3, 0.0) == 0
    assert regularization_weight(100, 100, 10, final=0.25) == pytest.approx(0.25)
    assert regularization_weight(55, 100, 10, final=0.2) == pytest.approx(0.6)
    assert evenly(100, 4, 0.6) == [70, 80, 90, 100]
    assert evenly(100, 0, 0.6) == []


@pytest.mark.parametrize("near", [False, True])
def test_the_rate_of_vertices_falls_late_near_the_surface_alone(near: bool) -> None:
    """Only of a start from a hull is it known what a late fall does; halfway it is higher."""
    mesh, views = _small_ball()
    late = {"start.shape": "hull", "start.near_fall": "late", "optimizer.lr_vertices_final": 0.04}
    config = SHORT.changed({"iterations": 11, "refinement.subdivisions": 0, **late})
    trainer = make_trainer(mesh, views, config, near=near)
    trainer.fit(6)
    halfway = 0.04 + 0.96 / 4 if near else 0.04**0.5
    assert trainer.adam.learning_rates["vertices"] == pytest.approx(halfway * config.optimizer.lr_vertices)


@pytest.mark.parametrize("update", ["adam", "large-steps"])
def test_what_no_photo_sees_of_a_start_that_was_cut_open_stays(update: str) -> None:
    """Regularizers would draw it together: the inner side of walls, of which photos see the upper part, to the outer.

    Of other starts it goes as regularizers have it.
    """
    vertices, faces = icosphere(3)
    views = photograph(MeshFile(vertices, faces), 64, 64, elevations=(40.0,), azimuths=6)
    hidden = unseen_vertices(views)(vertices, faces)
    assert 100 < int(hidden.sum()) < 400
    config = SHORT.changed({"iterations": 11, "refinement.subdivisions": 0, "optimizer.vertex_update": update})
    moved = {}
    for cut in (True, False):
        mesh = TriangleMesh.from_mesh(vertices, faces, colors=0.75, opacity=0.98, sigma=0.25)
        make_trainer(mesh, views, config, near=True, cut=cut).fit(6)
        moved[cut] = (mesh.vertices.detach() - vertices).norm(dim=1)
    assert float(moved[True][hidden].max()) == 0
    assert float(moved[False][hidden].min()) > 0
    assert float(moved[True][~hidden].min()) > 0


def test_what_photos_agree_on_moves_slowly_from_a_hull_and_the_rest_at_the_whole_rate() -> None:
    """A painted bowl with a lid: noise throws about what is there, and the lid has a way to go."""
    _, _, views = painted_pictures(*revolved(BOWL))
    vertices, faces = visual_hull(views, 1600)
    agreed = settled(views)(vertices, faces)
    config, paces = SHORT.changed({"start.shape": "hull", "start.near_pace": 0.2}), []
    for near, changes in ((True, {}), (False, {}), (True, {"start.near_pace": 1.0})):
        mesh = TriangleMesh.from_mesh(vertices, faces, colors=0.75, opacity=0.98, sigma=0.25)
        paces.append(make_trainer(mesh, views, config.changed(changes), near=near).adam.paces)
    assert paces[1:] == [{}, {}]
    torch.testing.assert_close(paces[0]["vertices"], 1 - 0.8 * agreed)
    assert float(agreed.min()) == 0
    assert float(agreed.max()) == 1


def test_a_mesh_is_opaque_at_last_and_its_outline_comes_nearer() -> None:
    """A ball 4 % too small, 8 % by what it covers, grows as photos say; softness and opacities rest."""
    vertices, faces = icosphere(3)
    views = photograph(MeshFile(vertices, faces), 64, 64, elevations=(-40.0, 0.0, 40.0), azimuths=5)
    mesh = TriangleMesh.from_mesh(0.96 * vertices, faces, colors=0.75, opacity=0.98, sigma=0.25)
    changes = {"iterations": 400, "drawing.opaque_from": 0.05, "optimizer.lr_opaque": 3e-3}
    still = {"optimizer.lr_vertices": 0.0, "refinement.subdivisions": 0}
    still |= {"regularization.lambda_edge": 0.0, "regularization.lambda_laplacian": 0.05}
    trainer = make_trainer(mesh, views, SHORT.changed({**changes, **still}))
    trainer.fit(20)
    assert mesh.appearance.kernel == "elastic"
    assert mesh.log_sigma is not None
    assert mesh.opacity_logits is not None
    sigma, opacities = mesh.log_sigma.detach().clone(), mesh.opacity_logits.detach().clone()
    trainer.fit(400)
    assert mesh.appearance.kernel is None
    assert torch.equal(mesh.log_sigma, sigma)
    assert torch.equal(mesh.opacity_logits, opacities)
    for index in views.train:
        wanted = float(views.images[index][..., 3].float().sum())
        assert float(mesh.render_opaque(views.cameras[index])[..., 3].sum()) == pytest.approx(wanted, rel=0.03)


def test_triangles_may_be_opaque_from_the_first_step_on() -> None:
    mesh, views = _small_ball()
    vertices = mesh.vertices.detach().clone()
    make_trainer(mesh, views, SHORT.changed({"drawing.opaque_from": 0.0, "iterations": 4})).fit(4)
    assert mesh.appearance.kernel is None
    assert not torch.equal(mesh.vertices, vertices)


def test_harmonics_rest_once_triangles_are_opaque() -> None:
    """These have no colours that depend on the direction: what is learned is what is written."""
    mesh, views = _small_ball(harmonics=2)
    trainer = make_trainer(mesh, views, ReconstructConfig.quick().changed({"drawing.harmonics": 2, "iterations": 20}))
    trainer.fit(18)
    assert mesh.harmonics is not None
    learned, colors = mesh.harmonics.detach().clone(), mesh.display_colors
    assert bool((learned != 0).any())
    trainer.fit(20)
    assert mesh.appearance.kernel is None
    assert torch.equal(mesh.harmonics, learned)
    assert not torch.equal(mesh.display_colors, colors)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 95),
        ({"method": "raster-face"}, NEVER),
        ({"drawing.opaque_from": 0.5}, 75),
        ({"drawing.opaque_from": 1.0}, NEVER),
        ({"drawing.harmonics": 2}, 95),
        ({"refine_cameras": "poses"}, NEVER),
        ({"refinement.outlines": False}, NEVER),
    ],
)
def test_outlines_are_asked_while_triangles_are_opaque(changes, expected) -> None:
    """Soft pictures have theirs elsewhere, and cameras that are refined are not those of the photos."""
    assert outlines_after(ReconstructConfig.quick().changed({"iterations": 100, **changes})) == expected


def test_edits_are_judged_before_triangles_become_opaque() -> None:
    """Losses of soft and of opaque pictures say nothing of each other."""
    guarded = {"drawing.opaque_from": 0.5, "refinement.untanglings": 2, "refinement.guard": 0.02}
    mesh, views = _small_ball()
    trainer = make_trainer(mesh, views, SHORT.changed({**guarded, "iterations": 40, "refinement.last": 0.2}))
    edits, guard = sorted({*trainer.strategy._budgets, *trainer.strategy._untangle_after}), trainer.guard
    assert guard is not None
    last = max(each for each in edits if each < 20)
    trainer.fit(last)
    assert guard.held is None or guard.due <= 20
    assert trainer._stepper.alike_until(last) == 20
    assert trainer._stepper.alike_until(21) > 40


@pytest.mark.parametrize("untanglings", [0, 1])
def test_vertices_of_what_is_untangled_stay_at_the_end(untanglings: int) -> None:
    """The last fiftieth of a run changes colours alone, so that nothing folds again."""
    mesh, views = _small_ball()
    config = SHORT.changed({"iterations": 50, "refinement.subdivisions": 0, "refinement.untanglings": untanglings})
    trainer = make_trainer(mesh, views, config)
    trainer.fit(49)
    vertices, colors = mesh.vertices.detach().clone(), mesh.colors.detach().clone()
    trainer.fit(50)
    assert torch.equal(mesh.vertices, vertices) == (untanglings > 0)
    assert not torch.equal(mesh.colors, colors)


@pytest.mark.parametrize(
    "settings",
    [
        {
            "pictures.coarse_levels": 1,
            "batch": 2,
            "refinement.untanglings": 3,
            "regularization.final": 0.1,
        },
        {
            "optimizer.vertex_update": "large-steps",
            "optimizer.lr_vertices": 1e-2,
            "optimizer.sigma_final": 0.05,
        },
        {"optimizer.vertex_update": "uniform", "drawing.colors": "vertex"},
        {"drawing.opaque_from": 0.5, "refinement.untanglings": 3, "refinement.guard": 0.02},
        {"drawing.opaque_from": 0.9},
        {"drawing.opaque_from": 0.4, "refinement.outlines": True, "refinement.guard": 0.02},
    ],
)
def test_settings_run_and_resume_to_the_same_bits(tmp_path: Path, settings: dict[str, object]) -> None:
    """A run that died at iteration 27 ends with the history of one that did not."""
    vertices, faces = icosphere(3)
    pebble = MeshFile(vertices * torch.tensor([1.0, 0.6, 0.8]), faces)
    config = SHORT.changed(settings)
    reconstruct(pebble, tmp_path / "whole", config)

    def die(event: object) -> None:
        if isinstance(event, StepEvent) and event.iteration >= 27:
            raise RuntimeError

    with pytest.raises(RuntimeError):
        reconstruct(pebble, tmp_path / "killed", config, callbacks=[die])
    reconstruct(pebble, tmp_path / "killed", config, resume=True)
    histories = [RunDirectory(tmp_path / name).read_history() for name in ("whole", "killed")]
    for lines in histories:
        for line in lines:
            del line["seconds"]
    assert histories[0] == histories[1]
    if "optimizer.sigma_final" in settings:
        assert histories[0][-1]["sigma"] == pytest.approx(0.05)
