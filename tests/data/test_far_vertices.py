"""Meshes that a speck far away makes small in their photos."""

import pytest
import torch

from etsplat.data.far_vertices import far_vertices_note
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile, load_mesh, save_mesh
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import load_source, make_subject

BALL = icosphere(3)
SPECK = torch.tensor([[1000.0, 0, 0], [1000, 1, 0], [1000, 0, 1]])


def with_speck() -> MeshFile:
    vertices, faces = BALL
    own = torch.arange(3)[None] + len(vertices)
    return MeshFile(torch.cat([vertices, SPECK]), torch.cat([faces, own]))


def test_a_speck_is_named_with_where_it_is_and_what_to_do(tmp_path):
    """Its photos showed a dot, and the run ended with masks that have no point in common."""
    mesh = with_speck()
    save_mesh(tmp_path / "a.ply", mesh.vertices, mesh.faces)
    for source in (mesh, tmp_path / "a.ply"):
        (note,) = load_source(source, ReconstructConfig())[1]
        assert note.startswith("3 vertices are far from all others, as that at (1000, ")
        assert "1001 times" in note or "1000 times" in note
        assert "delete what is stray" in note


def test_one_vertex_that_is_pulled_away_is_named():
    vertices = BALL[0].clone()
    vertices[7] *= 50
    note = far_vertices_note(MeshFile(vertices, BALL[1]))
    assert note is not None
    assert note.startswith("1 vertex is far from all others")


@pytest.mark.parametrize("factor", [(1.0, 1.0, 1.0), (1.0, 1.0, 40.0), (1.0, 0.01, 0.01)])
def test_meshes_of_any_shape_have_no_such_vertices(factor):
    assert far_vertices_note(MeshFile(BALL[0] * torch.tensor(factor), BALL[1])) is None
    assert (
        far_vertices_note(MeshFile(*(each[:8] for each in (torch.eye(3).repeat(3, 1), torch.tensor([[0, 1, 2]])))))
        is None
    )


def test_vertices_without_a_face_do_not_count(tmp_path):
    """They are dropped before photos are taken: these are those of the ball alone."""
    points = [*BALL[0].tolist(), *SPECK.tolist()]
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in BALL[1].tolist()]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    mesh = load_mesh(tmp_path / "a.obj")
    assert far_vertices_note(mesh) is None
    config = ReconstructConfig(resolution=32)
    views, _ = make_subject(mesh, config, lambda done, total: None, torch.device("cpu"))
    assert abs(views.normalization.radius - 1) < 1e-5
