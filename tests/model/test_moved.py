"""Models go to another device or precision, as cameras do."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

import etsplat
from etsplat.model.model import Model

CAMERAS = etsplat.orbit_cameras(16, 12, azimuths=1)
VERTICES, FACES = etsplat.icosphere(1)


def mesh() -> etsplat.TriangleMesh:
    return etsplat.TriangleMesh.from_mesh(VERTICES, FACES, colors=0.5, opacity=0.9, sigma=0.3)


def soup() -> etsplat.TriangleSoup:
    return etsplat.TriangleSoup.from_triangles(VERTICES[FACES], 0.5, opacity=0.9, sigma=0.3, sh_degree=1)


def textured() -> etsplat.TexturedMesh:
    return etsplat.TexturedMesh.from_mesh(VERTICES, FACES, torch.rand(8, 8, 3), torch.rand(80, 3, 2))


@pytest.mark.parametrize("make", [mesh, soup, textured])
def test_double_precision_draws_the_same_picture(make: Callable[[], Model]) -> None:
    """For gradients to compare with; faces stay what they are."""
    model = make()
    double = model.to(dtype=torch.float64)
    assert all(p.dtype == torch.float64 and p.requires_grad and p.is_leaf for p in double.parameters().values())
    seen = double.render(CAMERAS.to(dtype=torch.float64)).color
    assert seen.dtype == torch.float64
    torch.testing.assert_close(seen.float(), model.render(CAMERAS).color, atol=1e-4, rtol=0)


@pytest.mark.parametrize("thing", [mesh(), soup(), textured(), CAMERAS])
def test_a_dtype_is_no_device(thing: Any) -> None:
    """It was taken for one, and made faces of floats."""
    with pytest.raises(ValueError, match=r"device must be a device, got torch\.float64: pass dtype=torch\.float64"):
        thing.to(torch.float64)


def test_opaque_meshes_take_one_output_as_a_word() -> None:
    """As `rasterize` does."""
    assert textured().render(CAMERAS, outputs="color").color.shape == (5, 12, 16, 3)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("path", [3, None])
def test_what_is_no_path_is_named(path: Any) -> None:
    for save in (mesh().save, soup().save, textured().save):
        with pytest.raises(etsplat.InputError, match=r"path: is .*; it must be a path"):
            save(path)
