"""A fit that makes no new folds."""

import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.adam import Adam
from etsplat.optim.new_folds import NoNewFolds
from etsplat.optim.strategies import NEVER


def started() -> tuple[NoNewFolds, TriangleMesh]:
    vertices, faces = icosphere(2)
    mesh = TriangleMesh.from_mesh(vertices, faces, colors=0.5, opacity=None, sigma=None)
    strategy = NoNewFolds(torch.zeros(len(faces), dtype=torch.bool), every=10, last=25)
    strategy.start(mesh, Adam(mesh.parameters(), dict.fromkeys(mesh.parameters(), 0.1)), 3, torch.Generator())
    return strategy, mesh


def grow(mesh: TriangleMesh, factor: float) -> None:
    with torch.no_grad():
        mesh.vertices.mul_(factor)


def fold(mesh: TriangleMesh) -> None:
    """One vertex goes through to the other side."""
    with torch.no_grad():
        mesh.vertices[0] *= -1.3


def test_it_looks_now_and_then_and_at_the_end() -> None:
    strategy, _ = started()
    assert [strategy.next_edit(iteration) for iteration in (1, 10, 11, 21, 25, 26)] == [10, 10, 20, 25, 25, NEVER]


def test_vertices_go_back_to_where_they_were_when_it_last_looked() -> None:
    strategy, mesh = started()
    grow(mesh, 1.1)
    at_ten = mesh.vertices.detach().clone()
    assert not strategy.edit(10)
    assert torch.equal(mesh.vertices, at_ten)
    fold(mesh)
    strategy.edit(15)  # it is not time
    assert not torch.equal(mesh.vertices, at_ten)
    strategy.edit(20)
    assert torch.equal(mesh.vertices, at_ten)


def test_it_goes_on_from_its_state() -> None:
    strategy, mesh = started()
    grow(mesh, 1.1)
    strategy.edit(10)
    at_ten, state = mesh.vertices.detach().clone(), strategy.state()
    other, again = started()
    grow(again, 1.1)
    other.load_state(state)
    fold(again)
    other.edit(20)
    assert torch.equal(again.vertices, at_ten)
