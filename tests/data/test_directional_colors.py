"""Colours that follow the direction, and what else differs from photo to photo."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from etsplat.core.cameras import camera_centers
from etsplat.data.agreement import looked_at
from etsplat.data.dataset import Dataset
from etsplat.data.directional_colors import directional_deviation
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile
from etsplat.ops.rasterize_opaque import render_opaque
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.starts import make_start

VERTICES, FACES = icosphere(4)
QUICK = ReconstructConfig.quick()

Colors = Callable[[Tensor, int], Tensor]
"""Of the vertices of a ball towards a camera at a place, in the photo of a number."""


def waves(length: float = 9.0) -> Tensor:
    return 0.5 + 0.15 * torch.sin(
        length * VERTICES @ torch.tensor([[1.0, 0.3, -0.5], [0.2, -1.0, 0.4], [0.5, 0.4, 1.0]])
    )


def pictures(colors: Colors) -> Dataset:
    """Of the ball in such colours."""
    views = photograph(MeshFile(VERTICES, FACES), 128, 128, supersampling=1)
    images = []
    for index, camera in enumerate(views.cameras[number] for number in range(len(views.names))):
        seen = colors(camera_centers(views.viewmats[index].float()[None])[0], index)
        drawn = render_opaque(VERTICES, vertex_colors=seen, cameras=camera, faces=FACES, supersampling=2)
        images.append(drawn.rgba[0])
    return replace(views, images=StoredPictures(images))


def towards(eyes: Tensor) -> Tensor:
    """Unit vectors (..., V, 3) to cameras at (..., 3)."""
    return torch.nn.functional.normalize(eyes[..., None, :] - VERTICES, dim=-1)


def facing(strength: float) -> Colors:
    """Waves, brighter by so much where a place is seen squarely."""
    return lambda eye, _: waves() + strength * (towards(eye) * VERTICES).sum(dim=1, keepdim=True)


def flash(eye: Tensor, _: int) -> Tensor:
    return waves() * (0.3 + 0.7 * (towards(eye) * VERTICES).sum(dim=1, keepdim=True).clamp_min(0))


def exposed(eye: Tensor, number: int) -> Tensor:
    """Brighter and darker photos of what is the same from all sides."""
    return waves() + 0.1 * torch.sin(torch.tensor(7.0 * number))


def deviation(views: Dataset, scale: float = 1.0) -> float:
    looked = looked_at(views, scale * VERTICES, FACES)
    assert looked is not None
    return directional_deviation(looked)


@pytest.mark.parametrize("strength", [0.05, 0.2])
def test_it_is_that_of_what_depends_linearly_on_the_direction(strength: float) -> None:
    """The standard deviation over the photos that see a place, but for what photos as a whole have of it."""
    views = pictures(facing(strength))
    cosines = (towards(camera_centers(views.viewmats[views.train].float())) * VERTICES).sum(dim=2)
    seen = cosines > 0.3
    left = torch.where(seen, cosines, torch.nan)
    for _ in range(100):
        left = left - left.nanmean(dim=1, keepdim=True)
        left = left - left.nanmean(dim=0)
    spread = left.square().nansum(dim=0) / (seen.sum(dim=0) - 1)
    assert deviation(views) == pytest.approx(strength * float(spread.quantile(0.75).sqrt()), rel=0.2)


@pytest.mark.parametrize("colors", [lambda eye, _: waves(), lambda eye, _: waves(40.0), exposed])
def test_what_is_the_same_from_all_sides_has_none(colors: Colors) -> None:
    """Photos that were exposed otherwise are, too."""
    assert deviation(pictures(colors)) < 0.008


def test_a_surface_that_is_not_quite_there_has_little() -> None:
    """Each photo shows another place of the texture there."""
    assert deviation(pictures(lambda eye, _: waves(25.0)), scale=0.97) < 0.02


def test_a_run_has_harmonics_where_the_light_is_at_the_camera() -> None:
    """If nothing else is asked for, and places may have more than one colour."""
    lit, same = pictures(flash), pictures(lambda eye, _: waves())
    started = make_start(None, lit, QUICK)
    assert started.deviation is not None
    assert started.deviation > 0.03
    assert started.mesh.degree == 2
    assert make_start(None, same, QUICK).mesh.degree == 0
    for unmeasured in (
        make_start(None, lit, QUICK, one_color=True),
        make_start(None, lit, QUICK.changed({"drawing.harmonics": 0})),
        make_start(None, lit, QUICK.changed({"drawing.colors": "vertex"})),
        make_start(None, lit, QUICK.changed({"start.shape": "sphere"})),
    ):
        assert (unmeasured.mesh.degree, unmeasured.deviation) == (0, None)
    assert make_start(None, same, QUICK.changed({"drawing.harmonics": 1})).mesh.degree == 1
    given = MeshFile(1.02 * VERTICES, FACES)
    assert make_start(given, lit, QUICK).mesh.degree == 2
