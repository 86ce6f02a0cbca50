"""Where the pictures of an opaque mesh are wrong: how much of it each face has to answer for."""

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset, middles_of
from etsplat.data.loader import ViewLoader
from etsplat.data.pictures import as_float
from etsplat.io.images import over_background
from etsplat.model.triangle_mesh import TriangleMesh


class PictureErrors:
    """The squared differences between pictures and photos, added up over the pixels in which a face is the nearest."""

    def __init__(self, dataset: Dataset, views: int, device: torch.device, background: Float[Tensor, "3"]) -> None:
        """Takes what to look at.

        Args:
            dataset: some of its training views are looked at, evenly spread, at the size that they have.
            views: how many, at most.
            device: of the mesh.
            background: behind pictures and photos.
        """
        self._views = middles_of(dataset.train, min(len(dataset.train), views))
        self._loader, self._background = ViewLoader(dataset, device), background.to(device)

    @torch.no_grad()
    def __call__(self, mesh: TriangleMesh) -> Float[Tensor, " F"]:
        """(F,) float64, on the CPU: the sum for each face, 0 for one that none of the views shows."""
        errors = torch.zeros(mesh.count, dtype=torch.float64)
        self._loader.expect(self._views)
        for index in self._views:
            view = self._loader.view(index)
            seen = mesh.render(view.camera, backgrounds=self._background[None])
            photo = as_float(view.photo[0])
            if photo.shape[-1] == 4:
                photo = over_background(photo, self._background)
            wrong = (seen.color[0] - photo).square().sum(dim=-1)
            if view.mask is not None:
                wrong = wrong * as_float(view.mask[0])
            assert seen.triangle is not None
            face, wrong = seen.triangle[0].flatten().cpu().long(), wrong.flatten().cpu().double()
            errors.index_add_(0, face[face >= 0], wrong[face >= 0])
        return errors
