import sys

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.geometry.decimation import decimated
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology

pytest.importorskip("fast_simplification")


def test_a_sphere_keeps_its_shape_and_stays_closed_with_few_faces() -> None:
    vertices, faces = icosphere(4)
    fewer, triangles = decimated(vertices, faces, 400)
    topology = MeshTopology.from_faces(triangles, len(fewer))
    assert 300 <= len(triangles) <= 400
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.euler_characteristic() == 2
    assert fewer.norm(dim=1).sub(1).abs().max() < 0.05
    again = decimated(vertices, faces, 400)
    assert torch.equal(fewer, again[0])
    assert torch.equal(triangles, again[1])


def test_a_mesh_of_no_more_faces_is_returned_as_it_is() -> None:
    vertices, faces = icosphere(1)
    same, triangles = decimated(vertices, faces, 80)
    assert torch.equal(same, vertices)
    assert torch.equal(triangles, faces)


def test_there_are_never_more_faces_than_asked_for() -> None:
    """The simplifier alone leaves 152 of this one."""
    vertices, faces = icosphere(5)
    rough = vertices * (1 + 0.02 * torch.randn(len(vertices), 1, generator=torch.Generator().manual_seed(0)))
    fewer, triangles = decimated(rough, faces, 100)
    assert 50 < len(triangles) <= 100
    topology = MeshTopology.from_faces(triangles, len(fewer))
    assert topology.is_closed()
    assert topology.is_manifold()


def test_an_open_mesh_may_stay_open() -> None:
    vertices, faces = icosphere(3)
    _, triangles = decimated(vertices, faces[faces.max(dim=1).values < 500], 200)
    assert 0 < len(triangles) <= 200


def test_wrong_arguments_are_named() -> None:
    vertices, faces = icosphere(1)
    with pytest.raises(ValueError, match="count"):
        decimated(vertices, faces, 3)
    with pytest.raises(ValueError, match="faces"):
        decimated(vertices[:3], faces, 10)


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(InputError, match=r"pip install 'etsplat\[texture\]'"):
        decimated(*icosphere(2), 100)
