"""What no photo sees of a surface."""

import torch

from etsplat.data.agreement import unseen_vertices
from etsplat.data.photograph import photograph
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile


def test_of_a_ball_all_is_seen_and_of_a_deep_pit_in_it_the_bottom_is_not() -> None:
    vertices, faces = icosphere(4)
    unseen = unseen_vertices(photograph(MeshFile(vertices, faces), 400, 400, supersampling=1))
    assert not unseen(vertices, faces).any()
    pit = vertices[:, 1] > 0.98
    assert pit.sum() > 10
    for depth, hides in ((0.2, False), (1.2, True)):
        cut = torch.where(pit[:, None], vertices - torch.tensor([0.0, depth, 0.0]), vertices)
        hidden = unseen(cut, faces)
        assert bool(hidden[pit].all()) is hides
        assert bool(hidden[pit].any()) is hides
        assert not hidden[~pit].any()
