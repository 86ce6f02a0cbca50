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
from etsplat.data.depth_points import on_map
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
        self._dataset, self._sky = dataset, sky
        self._views = middles_of(dataset.train, min(_VIEWS, len(dataset.train)))

    @torch.no_grad()
    def __call__(self, soup: TriangleSoup) -> Bool[Tensor, " N"]:
        """(N,) whether a triangle is of the sky, and at its middle no view has most of its light from the sky."""
        hidden = self._sky(soup.vertices)
        middles = soup.vertices[hidden].mean(dim=1).cpu().double()
        shown = torch.zeros(len(middles), dtype=torch.bool)
        for view in self._views:
            camera = self._dataset.cameras[view].scaled(_SCALE).to(soup.vertices.device, soup.vertices.dtype)
            shown |= on_map(self._dataset, view, _share(soup, hidden, camera).cpu(), middles)[0] > 0.5
        hidden[hidden.clone()] = ~shown.to(hidden.device)
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
