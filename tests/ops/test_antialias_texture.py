"""Textures of the antialiased z-buffer rasterizer: where they lie, at which level, and their gradients."""

import pytest
import torch
from torch import Tensor

from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.engines.choice import engine_for
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.ops.antialias import rasterize_antialiased
from etsplat.ops.rasterize_opaque import rasterize_opaque
from helpers.engines import dtype_of, on
from helpers.tolerances import assert_close_to_scale

pytestmark = pytest.mark.sanitize

EYES = torch.tensor([[1.0, 2.0, 3.0], [-2.0, 0.3, 2.5]])
VIEWS = Cameras(
    look_at(EYES, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])), intrinsics(40.0, 45, 31).expand(2, 3, 3), 45, 31
)
QUAD = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), torch.tensor([[0, 1, 2], [0, 2, 3]])
"""Its corners clockwise from the upper left, as texture coordinates have them."""


def square(size: float, slope: float = 0.0) -> tuple[Tensor, Cameras]:
    """A square over the pixels from (0, 0) to (size, size), at z from 1 to 1 + slope from the left to the right."""
    positions = QUAD[0] * size
    z = 1 + slope * QUAD[0][:, :1]
    return torch.cat([positions * z, z], dim=1), Cameras(torch.eye(4)[None], torch.eye(3)[None], int(size), int(size))


def test_engines_agree_with_the_reference(engine, rng):
    """Image and all gradients of a folded mesh in two views, whose faces show textures of several levels."""
    vertices, faces = icosphere(2)
    vertices = vertices * (1 + 0.35 * torch.sin(5 * vertices[:, :1]) * torch.cos(4 * vertices[:, 1:2]))
    connectivity = MeshTopology.from_faces(faces, len(vertices)).connectivity
    leaves = {
        "vertices": vertices,
        "texture": torch.rand(32, 48, 2, generator=rng),
        "face_uvs": torch.rand(len(faces), 3, 2, generator=rng),
        "backgrounds": torch.rand(2, 2, generator=rng),
    }
    cotangent, results = torch.randn(2, 31, 45, 2, generator=rng), []
    for name in (engine, "reference"):
        given = {key: leaf.detach().to(dtype_of(name), copy=True).requires_grad_() for key, leaf in leaves.items()}
        views = VIEWS.to(dtype=dtype_of(name))
        image = on(name, rasterize_antialiased, connectivity=connectivity, cameras=views, **given).color
        (image * cotangent.to(image)).sum().backward()
        results.append({"image": image.detach(), **{key: leaf.grad for key, leaf in given.items()}})
    for key, exact in results[1].items():
        # Of places within rounding of a texel's centre the derivative is that of either side.
        assert_close_to_scale(results[0][key], exact, 1e-4, outliers=0.01, outlier_tolerance=0.02, name=key)


def test_a_ramp_is_interpolated_like_colors(engine, rng):
    """A texture that is u and v itself looks like vertices of these colours, in perspective and at silhouettes."""
    vertices, faces = icosphere(1)
    connectivity = MeshTopology.from_faces(faces, len(vertices)).connectivity
    ramp = (torch.arange(512.0) + 0.5) / 512
    texture = torch.stack([*torch.meshgrid(ramp, ramp, indexing="xy")], dim=-1)
    uvs, results = 0.1 + 0.8 * torch.rand(len(vertices), 2, generator=rng), []
    cotangent = torch.randn(2, 31, 45, 2, generator=rng)
    for colors in ({"vertex_colors": uvs}, {"texture": texture, "face_uvs": uvs[faces], "max_level": 0}):
        leaf = vertices.detach().to(dtype_of(engine), copy=True).requires_grad_()
        colors = {key: value.to(leaf) if isinstance(value, Tensor) else value for key, value in colors.items()}
        views = VIEWS.to(dtype=dtype_of(engine))
        image = on(engine, rasterize_antialiased, leaf, connectivity=connectivity, cameras=views, **colors).color
        (image * cotangent.to(image)).sum().backward()
        results.append((image.detach(), leaf.grad))
    for textured, colored in zip(results[1], results[0], strict=True):
        assert_close_to_scale(textured, colored.double(), 1e-3)  # differences of texels in float32


def test_a_texture_that_is_shown_small_is_averaged(engine, rng):
    """64 x 64 texels on 16 x 16 pixels: each shows the mean of its 4 x 4, with max_level=0 of the middle 2 x 2."""
    texture = torch.rand(64, 64, 3, generator=rng, dtype=dtype_of(engine))
    vertices, cameras = square(16)
    connectivity = MeshTopology.from_faces(QUAD[1], 4).connectivity
    shown = {"connectivity": connectivity, "cameras": cameras.to(dtype=texture.dtype), "texture": texture}
    shown |= {"face_uvs": QUAD[0][QUAD[1]].to(texture)}
    blocks = texture.reshape(16, 4, 16, 4, 3)
    for most, expected in ((None, blocks.mean(dim=(1, 3))), (0, blocks[:, 1:3, :, 1:3].mean(dim=(1, 3)))):
        image = on(engine, rasterize_antialiased, vertices.to(texture), max_level=most, **shown).color[0]
        torch.testing.assert_close(image[1:-1, 1:-1], expected[1:-1, 1:-1], atol=1e-4, rtol=0)


def test_levels_follow_what_coordinates_do_between_pixels(engine):
    """On a slanted square: the difference of texture coordinates over two pixels, and the longer axis of the two."""
    vertices, cameras = square(24, slope=2.0)
    dtype, faces = dtype_of(engine), QUAD[1].int()
    vertices, cameras, uvs = vertices.to(dtype), cameras.to(dtype=dtype), QUAD[0][QUAD[1]].to(dtype)

    def detail(vertices: Tensor, cameras: Cameras, uvs: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
        seen = rasterize_opaque(vertices, cameras=cameras, faces=faces)
        assert seen.depth is not None
        places = cameras.viewmats, cameras.Ks, faces, seen.triangle, seen.barycentrics
        chosen = engine_for(vertices)
        uv = chosen.interpolate(vertices, uvs, *places)
        return uv, chosen.texture_detail(vertices, uvs, *places, seen.depth[..., 0], 400, 100)

    uv, lod = on(engine, detail, vertices, cameras, uvs, faces)
    texels = uv[0] * uv.new_tensor([400.0, 100.0])
    along, down = (texels[1:-1, 2:] - texels[1:-1, :-2]) / 2, (texels[2:, 1:-1] - texels[:-2, 1:-1]) / 2
    expected = torch.maximum(along.norm(dim=-1), down.norm(dim=-1)).log2()
    assert float(expected.amax() - expected.amin()) > 1
    torch.testing.assert_close(lod[0, 1:-1, 1:-1], expected, atol=0.05, rtol=0)  # the steps themselves grow by 4 %


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"face_uvs": None}, "face_uvs must be given with texture"),
        ({"texture": None, "face_colors": torch.zeros(2, 3)}, "face_uvs must be None without texture"),
        (
            {"texture": None, "face_uvs": None, "face_colors": torch.zeros(2, 3), "max_level": 0},
            "max_level must be None",
        ),
        ({"face_colors": torch.zeros(2, 3)}, "exactly one of face_colors, vertex_colors and texture"),
        ({"texture": torch.zeros(4, 4)}, "texture must have shape"),
        ({"texture": torch.zeros(0, 4, 3)}, "texture must have a texel"),
        ({"texture": torch.full((4, 4, 3), torch.nan)}, "texture must be finite"),
        ({"face_uvs": torch.zeros(3, 3, 2)}, "face_uvs must have shape"),
        ({"max_level": -1}, "max_level must be an integer of at least 0"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    vertices, cameras = square(4)
    arguments = {
        "vertices": vertices,
        "connectivity": MeshTopology.from_faces(QUAD[1], 4).connectivity,
        "cameras": cameras,
        "texture": torch.zeros(4, 4, 3),
        "face_uvs": QUAD[0][QUAD[1]],
    }
    with pytest.raises(ValueError, match=message):
        rasterize_antialiased(**{**arguments, **change})
