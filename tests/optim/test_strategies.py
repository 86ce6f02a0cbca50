"""When strategies edit, and what they refuse."""

from typing import Any

import pytest
import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.intersections import count_self_intersections
from etsplat.geometry.measures import face_areas
from etsplat.geometry.topology import MeshTopology
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.adam import Adam
from etsplat.optim import strategies
from etsplat.optim.densification import PruneRules
from etsplat.optim.loop import DivergedError
from etsplat.optim.strategies import NEVER, DensifyAndPrune, Fixed, Strategy, SubdivideAndUntangle


def started(strategy: Strategy, model: Any, views: int = 2) -> Adam:
    adam = Adam(model.parameters(), dict.fromkeys(model.parameters(), 0.1))
    strategy.start(model, adam, views, torch.Generator().manual_seed(0))
    return adam


def a_mesh() -> TriangleMesh:
    vertices, faces = icosphere(2)
    return TriangleMesh.from_mesh(vertices, faces, colors=0.5, opacity=0.9, sigma=0.5)


def a_soup(rng: torch.Generator, count: int = 40) -> TriangleSoup:
    return TriangleSoup.from_triangles(
        torch.randn((count, 3, 3), generator=rng),
        torch.rand((count, 3), generator=rng),
        opacity=0.5,
        sigma=0.5,
        sh_degree=0,
    )


def seen_by_all(strategy: DensifyAndPrune) -> None:
    """As after an epoch in which every triangle was large and important."""
    for tensor in strategy.statistics.tensors().values():
        tensor.fill_(5)


def test_a_fixed_model_is_never_edited() -> None:
    strategy = Fixed()
    started(strategy, a_mesh())
    assert strategy.next_edit(1) == NEVER
    assert not strategy.edit(1)


def test_edges_are_flipped_after_a_subdivision_where_that_is_asked_for() -> None:
    """What was longest is cut in two, and no face is as slender as without; vertices, rows and moments are the same."""
    worst, made = [], []
    for flips in (False, True):
        strategy, mesh = SubdivideAndUntangle({3: 480}, flips=flips), a_mesh()
        with torch.no_grad():
            mesh.vertices[:, 0] *= 3
        adam = started(strategy, mesh)
        adam.first_moments["colors"].copy_(torch.arange(320.0)[:, None].expand(320, 3))
        assert strategy.edit(3)
        corners = mesh.vertices.detach()[mesh.faces]
        areas, edges = face_areas(*mesh.surface()), (corners - corners.roll(1, dims=1)).norm(dim=2)
        worst.append(float((edges.amax(1).square() / areas).mean()))
        made.append((mesh.vertices.detach(), adam.first_moments["colors"]))
        assert mesh.count == 480
        assert mesh.topology.is_manifold()
        assert mesh.topology.is_closed()
    assert worst[1] < 0.95 * worst[0]
    assert all(torch.equal(*both) for both in zip(*made, strict=True))


def test_what_no_picture_shows_becomes_a_film_where_meshes_are_untangled() -> None:
    """And nowhere else, nor at another time; without being told what that is nothing moves."""
    hidden = icosphere(2)[0][:, 1] > 0.7
    meshes = []
    for unseen in (None, lambda vertices, faces: hidden):
        strategy, mesh = SubdivideAndUntangle({}, [5], unseen=unseen), a_mesh()
        with torch.no_grad():
            mesh.vertices[hidden, 1] -= 0.3
        before = mesh.vertices.detach().clone()
        started(strategy, mesh)
        strategy.edit(4)
        assert torch.equal(mesh.vertices, before)
        strategy.edit(5)
        assert torch.equal(mesh.vertices[~hidden], before[~hidden])
        meshes.append(mesh.vertices.detach())
    assert torch.equal(meshes[0], before)
    assert meshes[1][hidden, 1].std() < before[hidden, 1].std() / 2


def test_vertices_go_to_outlines_once_in_place() -> None:
    """After that iteration and no other; what is to be told from outlines is asked of the mesh as it is."""
    asked = []

    def doubled(vertices: torch.Tensor, topology: MeshTopology) -> torch.Tensor:
        asked.append((vertices.clone(), topology.num_faces))
        return 2 * vertices

    strategy, mesh = SubdivideAndUntangle({3: 400}, [9], outlines=doubled, outlines_after=7), a_mesh()
    started(strategy, mesh)
    before = mesh.vertices.detach().clone()
    assert [strategy.next_edit(i) for i in (3, 4, 8, 10)] == [3, 7, 9, NEVER]
    assert strategy.attempts(7) == 1
    assert not strategy.edit(6)
    assert not strategy.edit(7)
    assert torch.equal(mesh.vertices, 2 * before)
    assert len(asked) == 1
    assert torch.equal(asked[0][0], before)
    assert asked[0][1] == mesh.count


def test_lids_are_removed_at_each_edit_but_the_last_with_all_that_belongs_to_them() -> None:
    """Parameters and moments of the other faces and their vertices stay as they are; where that was undone, all do."""
    strategy, mesh = (
        SubdivideAndUntangle({3: 320}, [5, 9], lids=lambda vertices, faces, _: vertices[faces][..., 1].amin(1) > 0),
        a_mesh(),
    )
    adam = started(strategy, mesh)
    adam.first_moments["colors"].copy_(torch.arange(320.0)[:, None].expand(320, 3))
    vertices, faces = mesh.surface()
    lid = vertices[faces][..., 1].amin(dim=1) > 0
    assert [strategy.attempts(iteration) for iteration in (3, 4, 5, 9)] == [2, 1, 2, 1]
    strategy.undone = 1
    assert not strategy.edit(5)
    assert mesh.count == 320
    strategy.undone = 0
    assert not strategy.edit(9)
    assert strategy.edit(5)
    assert mesh.count == int((~lid).sum())
    assert torch.equal(mesh.vertices[mesh.faces], vertices[faces[~lid]])
    assert torch.equal(mesh.faces.unique(), torch.arange(len(mesh.vertices)))
    assert torch.equal(adam.first_moments["colors"][:, 0], torch.arange(320.0)[~lid])
    assert len(adam.second_moments["vertices"]) == len(mesh.vertices)
    assert all(adam.parameters[name] is parameter for name, parameter in mesh.parameters().items())
    assert mesh.topology.is_manifold()
    assert (strategy.attempts(5), strategy.edit(5)) == (1, False)  # nothing is left of it


def test_a_mesh_is_subdivided_at_its_times_and_only_then() -> None:
    """The model, its topology and the optimizer's state have the new faces; in between nothing changes."""
    strategy, mesh = SubdivideAndUntangle({3: 400, 7: 450}, [5]), a_mesh()
    adam = started(strategy, mesh)
    assert [strategy.next_edit(i) for i in (1, 3, 4, 6, 8)] == [3, 3, 5, 7, NEVER]
    assert not strategy.edit(2)
    assert mesh.count == 320
    assert strategy.edit(3)
    assert 320 < mesh.count <= 400
    assert len(mesh.colors) == len(adam.first_moments["colors"]) == mesh.count == len(mesh.topology.faces)
    assert all(adam.parameters[name] is parameter for name, parameter in mesh.parameters().items())


def test_folds_are_smoothed_away_in_place() -> None:
    """A vertex pushed through the far side comes back, and no tensor is replaced."""
    strategy, mesh = SubdivideAndUntangle({}, [4, 9]), a_mesh()
    started(strategy, mesh)
    before = mesh.vertices
    with torch.no_grad():
        mesh.vertices[5] *= -1.2
    assert not strategy.edit(4)
    assert mesh.vertices is before
    assert count_self_intersections(mesh.vertices.detach(), mesh.faces) == 0


def test_a_long_reach_is_tried_before_a_short_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once it was undone; a short one has no other, nor has a subdivision."""
    seen = []

    def look(vertices: torch.Tensor, topology: object, *, reach: float) -> tuple[torch.Tensor, int]:
        seen.append(reach)
        return vertices, 0

    monkeypatch.setattr(strategies, "untangle", look)
    for reach, attempts in ((2.0, 2), (0.5, 1), (0.1, 1)):
        strategy = SubdivideAndUntangle({3: 400}, [4], reach=reach)
        started(strategy, a_mesh())
        assert (strategy.attempts(4), strategy.attempts(3)) == (attempts, 1)
        for strategy.undone in range(attempts):
            strategy.edit(4)
    assert seen == [2.0, 0.5, 0.5, 0.1]


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e30])
def test_a_mesh_that_went_to_infinity_is_neither_untangled_nor_divided(number: float) -> None:
    """Nor is the last number one whose square float32 holds."""
    strategy, mesh = SubdivideAndUntangle({8: 400}, [4]), a_mesh()
    started(strategy, mesh)
    with torch.no_grad():
        mesh.vertices[5] = number
    for iteration in (4, 8):
        with pytest.raises(DivergedError, match=f"not finite at iteration {iteration}"):
            strategy.edit(iteration)
    assert not strategy.edit(5)  # there is nothing to do, so nobody looks


def test_a_soup_is_edited_between_its_first_and_its_last_time(rng: torch.Generator) -> None:
    """At multiples of `every`, after `begin`, before `last`; from `end` on triangles only die."""
    strategy, soup = DensifyAndPrune(begin=10, end=20, every=5, last=30, max_triangles=1000), a_soup(rng)
    started(strategy, soup)
    grown = {}
    for iteration in range(1, 35):
        seen_by_all(strategy)
        before = soup.count
        if strategy.edit(iteration):
            grown[iteration] = soup.count - before
    assert list(grown) == [15, 20, 25]
    assert grown[15] > 0 == grown[20] == grown[25]
    assert [strategy.next_edit(i) for i in (1, 5, 6)] == [5, 5, 10]


def test_faint_triangles_die_and_others_take_their_place(rng: torch.Generator) -> None:
    """With `replace_dead` the number grows by the factor all the same; without it less."""
    counts = {}
    for replaces in (True, False):
        strategy, soup = DensifyAndPrune(replace_dead=replaces, max_triangles=1000, split_size=1e9), a_soup(rng, 100)
        adam = started(strategy, soup)
        seen_by_all(strategy)
        with torch.no_grad():
            soup.opacity_logits[:20] = -20
        strategy.densify(100)
        counts[replaces] = soup.count
        assert float(soup.opacities.detach().min()) > 0.014
        assert all(adam.parameters[name] is parameter for name, parameter in soup.parameters().items())
    assert counts == {True: 130, False: 104}


def test_what_is_spared_stays_where_nobody_looks(rng: torch.Generator) -> None:
    """Unseen and faint, it lives; seen, it dies like any other."""
    spared = torch.zeros(40, dtype=torch.bool)
    spared[:10] = True
    strategy, soup = DensifyAndPrune(end=0, begin=0, every=1, spared=lambda _: spared), a_soup(rng)
    started(strategy, soup)
    with torch.no_grad():
        soup.opacity_logits[:20] = -20
    strategy.statistics.screen_size[5:10] = 3.0
    strategy.edit(3)
    assert soup.count == 25


def test_who_is_barren_does_not_multiply(rng: torch.Generator) -> None:
    """Though it is the most opaque. It stays."""
    strategy, soup = DensifyAndPrune(growth=1.5, split_size=1e9, barren=lambda soup: soup.opacities > 0.9), a_soup(rng)
    started(strategy, soup)
    seen_by_all(strategy)
    with torch.no_grad():
        soup.opacity_logits[:20] = 9
        soup.sh_dc.copy_(torch.arange(40.0)[:, None, None].expand(40, 1, 3))
    strategy.densify(200)
    numbers = soup.sh_dc.detach()[:, 0, 0].int().bincount(minlength=40)
    assert numbers[:20].tolist() == [1] * 20
    assert numbers[20:].tolist() == [2] * 20


def test_a_soup_that_dies_out_is_an_error(rng: torch.Generator) -> None:
    """In words that name the iteration and what to change."""
    strategy, soup = DensifyAndPrune(prune=PruneRules(opacity=0.9)), a_soup(rng)
    started(strategy, soup)
    with pytest.raises(DivergedError, match=r"no triangle is left at iteration 7; lower loss\.lambda_opacity and"):
        strategy.densify(7)


def test_statistics_survive_a_checkpoint(rng: torch.Generator) -> None:
    first, second = DensifyAndPrune(), DensifyAndPrune()
    started(first, a_soup(rng))
    started(second, a_soup(rng))
    seen_by_all(first)
    second.load_state(first.state())
    assert all(torch.equal(tensor, first.state()[name]) for name, tensor in second.state().items())
