import sys

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.unwrap import texel_points, unwrapped

pytest.importorskip("xatlas")
SIZE = 256


def test_charts_lie_in_the_texture_apart_from_each_other() -> None:
    """Texels that the layout covers are as many as its triangles are large: none lies on another."""
    vertices, faces = icosphere(2)
    uvs = unwrapped(vertices, faces, SIZE)
    assert uvs.shape == (len(faces), 3, 2)
    assert uvs.min() >= 0
    assert uvs.max() <= 1
    a, b = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    area = 0.5 * float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs().sum())
    covered, _, _ = texel_points(vertices, faces, uvs, SIZE)
    assert area > 0.4
    assert float(covered.float().mean()) == pytest.approx(area, rel=0.02)
    assert torch.equal(uvs, unwrapped(vertices, faces, SIZE))


def test_texels_know_their_place_on_the_surface() -> None:
    """The centre of a texel, taken back to the texture by the corners' coordinates."""
    vertices, faces = icosphere(2)
    uvs = unwrapped(vertices, faces, SIZE)
    covered, points, face = texel_points(vertices, faces, uvs, SIZE)
    rows, columns = covered.nonzero().unbind(dim=1)
    corners = vertices[faces[face]].double()
    weights = torch.linalg.solve(corners.transpose(1, 2), points.double())
    back = (weights[..., None] * uvs[face]).sum(dim=1) * SIZE
    assert (back - torch.stack([columns, rows], dim=1) - 0.5).abs().max() < 0.02


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(InputError, match=r"pip install 'etsplat\[texture\]'"):
        unwrapped(*icosphere(1), 64)
