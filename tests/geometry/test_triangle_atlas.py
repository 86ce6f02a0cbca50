"""Packing of triangles into one texture."""

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.geometry.triangle_atlas import MOST_TEXELS, pack_triangles
from etsplat.ops.texture import sample_texture


def touched(uvs: torch.Tensor, width: int, height: int, samples: int = 200) -> torch.Tensor:
    """How much each texel gets of samples all over a triangle, its edges and corners among them."""
    rng = torch.Generator().manual_seed(0)
    inside = torch.rand(samples, 3, generator=rng)
    inside = inside / inside.sum(dim=1, keepdim=True)
    edges = torch.rand(samples, 1, generator=rng)
    ends = torch.eye(3)
    borders = [edges * ends[k] + (1 - edges) * ends[(k + 1) % 3] for k in range(3)]
    places = torch.cat([inside, *borders, ends]) @ uvs
    texture = torch.zeros(height, width, 1, dtype=torch.float64).requires_grad_()
    sample_texture(texture, places.double()).sum().backward()
    assert texture.grad is not None
    return texture.grad[..., 0]


def test_no_texel_belongs_to_two_triangles():
    """Of triangles of all sizes, an odd number of each: bilinear samples of one touch no texel that another's do."""
    texels = torch.tensor([1, 2, 4, 8, 3, 1, 2, 4, 8, 1, 2, 4, 8, 16, 3, 3])
    atlas = pack_triangles(texels)
    # Float32 places are off by 1e-6 of a texel, which touches the next one by as much.
    owned = torch.stack([touched(uvs, atlas.width, atlas.height) > 1e-3 for uvs in atlas.face_uvs])
    assert int(owned.sum(dim=0).max()) == 1
    assert bool((owned.sum(dim=(1, 2)) >= texels * (texels + 1) // 2).all())


def test_legs_have_their_texels():
    """From corner 0 to both others, in texels, between centres; in the order of the faces."""
    texels = torch.tensor([4, 1, 16, 4, 2])
    atlas = pack_triangles(texels)
    places = atlas.face_uvs.double() * torch.tensor([atlas.width, atlas.height])
    for corner, axis in ((1, 0), (2, 1)):
        legs = (places[:, corner] - places[:, 0]).abs()
        torch.testing.assert_close(legs[:, axis], (texels - 1).double(), atol=1e-4, rtol=0)
        torch.testing.assert_close(legs[:, 1 - axis], torch.zeros(5).double(), atol=1e-4, rtol=0)
    torch.testing.assert_close(places % 1, torch.full_like(places, 0.5), atol=1e-4, rtol=0)


def test_many_triangles_lie_within_an_almost_square_texture(rng):
    """200,000 of five sizes: the same layout again, nearly filled."""
    texels = 2 ** torch.randint(0, 5, (200_000,), generator=rng)
    atlas, again = pack_triangles(texels), pack_triangles(texels.int())
    assert torch.equal(atlas.face_uvs, again.face_uvs)
    assert 0 <= float(atlas.face_uvs.min()) < float(atlas.face_uvs.max()) <= 1
    assert 0.95 < atlas.width / atlas.height < 1.05
    cells = torch.where(texels < 4, 2 * texels**2, (texels + 1) * (texels + 2)).sum() / 2
    assert float(cells) > 0.97 * atlas.width * atlas.height


@pytest.mark.parametrize("odd", [torch.tensor([1, 0]), torch.tensor([-3]), torch.tensor([MOST_TEXELS + 1])])
def test_odd_numbers_are_refused(odd):
    with pytest.raises(ValueError, match="texels must be"):
        pack_triangles(odd)


def test_too_many_texels_are_refused():
    with pytest.raises(InputError, match="larger than 65536: ask for fewer texels"):
        pack_triangles(torch.full((1000,), MOST_TEXELS))
