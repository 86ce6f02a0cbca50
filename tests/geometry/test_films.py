"""A film over what nobody sees: a slit closes, and what is held stays."""

import torch

from etsplat.geometry.films import film, slits_closed, tight_film
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import enclosed_volume
from etsplat.geometry.topology import MeshTopology


def test_a_slit_in_a_ball_closes() -> None:
    vertices, faces = icosphere(4)
    slit = (vertices[:, 0].abs() < 0.1) & (vertices[:, 1] > 0.5)
    cut = vertices.clone()
    cut[slit, 1] -= 0.4
    closed = film(cut, faces, slit)
    assert torch.equal(closed[~slit], vertices[~slit])
    assert (closed[slit] - vertices[slit]).norm(dim=1).max() < 0.05
    assert 0.98 * enclosed_volume(vertices, faces) < enclosed_volume(closed, faces) <= enclosed_volume(vertices, faces)


def test_a_hollow_beside_a_slit_stays_open() -> None:
    """Each patch by itself."""
    vertices, faces = icosphere(4)
    slit, hollow = ((vertices[:, 0].abs() < 0.1) & (side * vertices[:, 1] > 0.5) for side in (1, -1))
    cut = vertices.clone()
    cut[slit, 1] -= 0.15
    cut[hollow, 1] += 0.5
    closed = slits_closed(cut, faces, slit | hollow, 0.4)
    assert torch.equal(closed[hollow], cut[hollow])
    assert (closed[slit] - vertices[slit]).norm(dim=1).max() < 0.05


def test_where_nothing_is_free_nothing_moves() -> None:
    vertices, faces = icosphere(1)
    assert torch.equal(film(vertices, faces, torch.zeros(len(vertices), dtype=torch.bool)), vertices)


def test_a_tight_film_is_where_sweeps_end() -> None:
    vertices, faces = icosphere(3)
    free = (vertices[:, 1] > 0.8) & (vertices[:, 0].abs() < 0.3)
    tight = tight_film(vertices, MeshTopology.from_faces(faces, len(vertices)).edges.long(), free)
    assert (tight[free] - vertices[free]).norm(dim=1).max() > 0.05
    torch.testing.assert_close(tight, film(vertices, faces, free), rtol=0, atol=1e-5)
