"""Which triangles of a soup's sky no photo shows, since there are walls before them.

Such a sky is opaque, so that it multiplies as what is seen does, and soft triangles before it have gaps. Through these
it fits one photo or two by what the others hide, and that comes out in views between them.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset, middles_of
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.rasterize import rasterize

_VIEWS = 16
_SCALE = 0.25
"""So many training views are looked at, at a quarter of the size of their photos."""


class HiddenSky:
    """Tells the hidden triangles of the sky of a soup."""

    def __init__(self, dataset: Dataset, sky: Callable[[Float[Tensor, "N 3 3"]], Bool[Tensor, " N"]]) -> None:
        """Takes what to look at.

        Args:
            dataset: some of its training views are looked at, evenly spread.
            sky: which triangles belong to the sky, by their corners.
        """
        views = middles_of(dataset.train, min(_VIEWS, len(dataset.train)))
        self._cameras = [dataset.cameras[view].scaled(_SCALE) for view in views]
        self._sky = sky

    @torch.no_grad()
    def __call__(self, soup: TriangleSoup) -> Bool[Tensor, " N"]:
        """(N,) whether a triangle is of the sky, and at its middle no view has most of its light from the sky."""
        hidden = self._sky(soup.vertices)
        middles = soup.vertices[hidden].mean(dim=1)
        shown = torch.zeros(len(middles), dtype=torch.bool, device=middles.device)
        for camera in self._cameras:
            view = camera.to(middles.device, middles.dtype)
            shown |= _at(view, _share(soup, hidden, view), middles) > 0.5
        hidden[hidden.clone()] = ~shown
        return hidden


def _share(soup: TriangleSoup, sky: Bool[Tensor, " N"], camera: Cameras) -> Float[Tensor, "H W"]:
    """How much of the light in each pixel comes from the sky."""
    look = soup.appearance
    seen = rasterize(
        soup.vertices,
        opacities=soup.drawn_opacities,
        sigma=soup.drawn_sigma,
        face_colors=sky.to(soup.vertices)[:, None],
        cameras=camera,
        kernel=look.kernel,
        distance=look.distance,
        near_plane=look.near_plane,
        validate=False,
    )
    assert seen.color is not None
    return seen.color[0, ..., 0]


def _at(camera: Cameras, image: Float[Tensor, "H W"], points: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
    """Values of an image at the pixels of points; 0 where they are not in it."""
    located = (points @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]) @ camera.Ks[0].T
    column, row = located[:, 0] / located[:, 2], located[:, 1] / located[:, 2]
    inside = (located[:, 2] > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    column, row = (torch.where(inside, each, 0.0).long() for each in (column, row))
    return torch.where(inside, image[row, column], 0.0)
