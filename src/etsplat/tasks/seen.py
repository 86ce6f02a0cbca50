"""One view of a model beside its photograph, as it is and as it would be if more were known of the photograph."""

from dataclasses import replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import Rasterization
from etsplat.data.loader import View
from etsplat.data.pictures import as_float
from etsplat.engines.threads import all_torch_threads
from etsplat.io.images import over_background
from etsplat.metrics.image import colors_fitted
from etsplat.model.model import Model
from etsplat.optim.camera_alignment import aligned
from etsplat.optim.terms.photometric import Photometric

DSSIM = 0.2
"""Share of 1 - SSIM in what poses are aligned by."""


class Seen:
    """One view of a model beside its photograph; colours over the background, in [0, 1]. Drawn when it is asked for.

    Attributes:
        photo: (H, W, 3) the photograph.
        alpha: (H, W) of the photograph; None where it has none.
        start: the camera from which the view may be aligned to the model; None where its pose is not in doubt.
    """

    def __init__(
        self,
        model: Model,
        view: View,
        background: Float[Tensor, "3"],
        supersampling: int,
        start: Cameras | None = None,
    ) -> None:
        self.start = start
        self._model, self._view, self._background, self._supersampling = model, view, background, supersampling
        photo = as_float(view.photo[0])
        self.alpha = photo[..., 3] if photo.shape[-1] == 4 else None
        self.photo: Float[Tensor, "H W 3"] = photo if self.alpha is None else over_background(photo, background)

    @cached_property
    def splatted(self) -> Float[Tensor, "H W 3"]:
        """(H, W, 3) the model as it is trained."""
        return self._rendered.color[0].clamp(0.0, 1.0)

    @property
    def fitted(self) -> Float[Tensor, "H W 3"]:
        """(H, W, 3) the same with its colours mapped to those of the photograph, as another exposure would."""
        mask, coverage = self._view.mask, None if self.alpha is None else self._rendered.alpha[0, ..., 0]
        counts = None if mask is None else as_float(mask[0])
        behind = self._background
        return colors_fitted(self.splatted, self.photo, counts=counts, coverage=coverage, background=behind)

    @property
    def aligned(self) -> Float[Tensor, "H W 3"]:
        """(H, W, 3) the model from where it looks most like the photograph, near `start`."""
        assert self.start is not None
        behind = self._background[None]
        view = replace(self._view, camera=self.start.to(self._background.device))
        camera = aligned(self._model, Photometric(DSSIM), view, behind).camera
        with torch.no_grad():
            return self._model.render(camera, backgrounds=behind).color[0].clamp(0.0, 1.0)

    @cached_property
    @torch.no_grad()
    def _rendered(self) -> Rasterization:
        return self._model.render(self._view.camera, backgrounds=self._background[None])

    @cached_property
    def covered(self) -> Float[Tensor, "H W 4"]:
        """(H, W, 4) as a mesh viewer draws it, premultiplied."""
        with all_torch_threads():
            return self._model.render_opaque(self._view.camera, supersampling=self._supersampling)[0]

    @property
    def opaque(self) -> Float[Tensor, "H W 3"]:
        """(H, W, 3) the same over the background."""
        return over_background(self.covered, self._background).clamp(0.0, 1.0)

    def counting(self, picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """A picture with the photograph's pixels where the view's mask leaves them out."""
        mask = self._view.mask
        return picture if mask is None else self.photo + as_float(mask[0])[..., None] * (picture - self.photo)
