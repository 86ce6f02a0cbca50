"""Where the pictures of an opaque mesh are wrong: what each face has to answer for, and which are in the way.

A face is in the way if photos are explained better by what is behind it (`model/behind.py`), in the pixels in which it
is the nearest. All is looked at at half the size, which is less work, and where a face that is right but for its
outline is hardly blamed for that. Of the same pictures it is asked which faces photos agree to halve
(`optim/halving_gains.py`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from etsplat.core.rasterization import Rasterization
from etsplat.data.dataset import Dataset, middles_of
from etsplat.data.loader import View, ViewLoader
from etsplat.data.pictures import as_float
from etsplat.io.images import over_background
from etsplat.model.behind import WithBehind
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.exposure import Exposure
from etsplat.optim.halving_gains import HalvingGains

_PHOTOS = 2
"""A single photo may be explained better by many a wrong depth: so many have to show a face that is in the way."""


@dataclass(frozen=True)
class FaceErrors:
    """What pictures say of the faces of a mesh, on the CPU.

    Attributes:
        wrong: (F,) float64, the squared differences between pictures and photos of half the size, added up over the
            pixels in which a face is the nearest; 0 for one that none of the views shows.
        in_the_way: (F,) whether at least two views show a face, and all of them together would be less wrong without;
            never of the backdrop.
        gained: (F,) float64, by how much less wrong photos are that colours of the halves do not know; below 0 where
            they are more wrong.
    """

    wrong: Float[Tensor, " F"]
    in_the_way: Bool[Tensor, " F"]
    gained: Float[Tensor, " F"]


class PictureErrors:
    """Compares pictures of a mesh with photos."""

    def __init__(
        self,
        dataset: Dataset,
        views: int,
        device: torch.device,
        background: Float[Tensor, "3"],
        exposure: Exposure,
        around: Surroundings | None = None,
    ) -> None:
        """Takes what to look at.

        Args:
            dataset: some of its training views are looked at, evenly spread.
            views: how many, at most.
            device: of the mesh.
            background: behind pictures and photos.
            exposure: of the photos, as which pictures are exposed where it is learned.
            around: whose backdrop is the mesh's; None where it has none.
        """
        self._around = around
        self._views = middles_of(dataset.train, min(len(dataset.train), views))
        self._loader = ViewLoader(dataset.halved(), device)
        self._background, self._exposure = background.to(device), exposure

    @torch.no_grad()
    def __call__(self, mesh: TriangleMesh) -> FaceErrors:
        """Of a mesh as it is now."""
        wrong, without = (torch.zeros(mesh.count, dtype=torch.float64) for _ in range(2))
        photos = torch.zeros(mesh.count, dtype=torch.int64)
        corners = mesh.vertices[mesh.faces]
        gains, drawn = HalvingGains(corners), WithBehind(mesh)
        self._loader.expect(self._views)
        for number, index in enumerate(self._views):
            view = self._loader.view(index)
            nearest, behind = drawn.render(view.camera, self._background[None])
            assert nearest.triangle is not None
            assert nearest.barycentrics is not None
            face, barycentrics = nearest.triangle.flatten().long().cpu(), nearest.barycentrics.reshape(-1, 3).cpu()
            counted = self._counted(view)
            lacking = self._lacking(nearest, view)
            error, error_behind = (
                counted * lacks.square().sum(dim=-1) for lacks in (lacking, self._lacking(behind, view))
            )
            _add(wrong, face, error)
            _add(without, face, error_behind - error)
            gains.add(number, face, barycentrics, lacking, counted)
            photos += torch.bincount(face[face >= 0], minlength=mesh.count) > 0
        in_the_way = (photos >= _PHOTOS) & (without < 0)
        if self._around is not None:
            in_the_way &= ~self._around.at_backdrop(corners.flatten(0, 1)).reshape(-1, 3).all(dim=1).cpu()
        return FaceErrors(wrong, in_the_way, gains.gains())

    def _counted(self, view: View) -> Float[Tensor, " P"]:
        """How much each pixel counts."""
        return (
            torch.ones(view.photo[0, ..., 0].numel()) if view.mask is None else as_float(view.mask[0]).flatten().cpu()
        )

    def _lacking(self, seen: Rasterization, view: View) -> Float[Tensor, "P 3"]:
        """Photo minus picture."""
        shot = self._exposure.applied(seen, view, self._background[None]) if self._exposure.learned else seen
        photo = as_float(view.photo[0])
        if photo.shape[-1] == 4:
            photo = over_background(photo, self._background)
        return (photo - shot.color[0]).reshape(-1, 3).cpu()


def _add(sums: Float[Tensor, " F"], face: Int[Tensor, " P"], values: Float[Tensor, " P"]) -> None:
    sums.index_add_(0, face[face >= 0], values[face >= 0].double())
