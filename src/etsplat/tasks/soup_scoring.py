"""How good a soup is: on the test views of its capture, splatted and as opaque triangles."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.loader import ViewLoader
from etsplat.data.pictures import as_float
from etsplat.io.images import over_background, save_image
from etsplat.metrics.image import psnr, ssim
from etsplat.model.soup_rendering import SoupAppearance, render_soup, render_soup_opaque
from etsplat.model.triangle_soup import TriangleSoup

SUPERSAMPLING = 4


class SoupScorer:
    """Measures soups in the frame of one capture. Measuring changes nothing and draws no random number of the run.

    Images are compared over the background, in float, renders clamped to [0, 1]; pixels that a mask excludes count as
    right.
    """

    def __init__(
        self,
        capture: Dataset,
        background: Float[Tensor, "3"],
        device: torch.device = torch.device("cpu"),  # noqa: B008 (immutable)
    ) -> None:
        self._capture = capture
        self._views = ViewLoader(capture, device)
        self._background = background.to(device)

    def cheap(self, soup: TriangleSoup, appearance: SoupAppearance) -> dict[str, float]:
        """For the history: "psnr" if there are test views."""
        if not self._capture.test:
            return {}
        values = [self._psnr(self.splatted(soup, appearance, view), view) for view in self._capture.test]
        return {"psnr": sum(values) / len(values)}

    def full(self, soup: TriangleSoup, appearance: SoupAppearance, folder: Path) -> dict[str, Any]:
        """For metrics.json; draws the test views into `folder` on the way.

        Args:
            soup: what to measure.
            appearance: how it is drawn.
            folder: gets NNN_render.png, NNN_truth.png and NNN_opaque.png for every test view.

        Returns:
            Means over the test views, and the values per view; null where there are no test views.
        """
        scores: dict[str, list[float]] = {"psnr": [], "ssim": [], "psnr_opaque": [], "ssim_opaque": []}
        for number, view in enumerate(self._capture.test):
            photo = self.photo(view)
            pictures = {
                "render": self.splatted(soup, appearance, view),
                "opaque": self.opaque(soup, appearance, view),
            }
            for kind, suffix in (("render", ""), ("opaque", "_opaque")):
                picture = self.masked(pictures[kind], photo, view)
                scores[f"psnr{suffix}"].append(psnr(picture, photo))
                scores[f"ssim{suffix}"].append(ssim(picture, photo))
            for kind, picture in (("truth", photo), *pictures.items()):
                save_image(folder / f"{number:03d}_{kind}.png", picture)
        names = [self._capture.names[view] for view in self._capture.test]
        means = {name: sum(values) / len(values) if values else None for name, values in scores.items()}
        return {**means, "test_views": [{"name": name, **_row(scores, i)} for i, name in enumerate(names)]}

    def _psnr(self, picture: Float[Tensor, "H W 3"], view: int) -> float:
        photo = self.photo(view)
        return psnr(self.masked(picture, photo, view), photo)

    def photo(self, view: int) -> Float[Tensor, "H W 3"]:
        """The photograph of a view, over the background."""
        photo = as_float(self._views.view(view).photo[0])
        return photo if photo.shape[-1] == 3 else over_background(photo, self._background)

    def masked(self, picture: Tensor, photo: Tensor, view: int) -> Float[Tensor, "H W 3"]:
        """The picture, with the photograph's pixels where the view's mask excludes them."""
        mask = self._views.view(view).mask
        return picture if mask is None else photo + mask[0, ..., None].float() / 255 * (picture - photo)

    @torch.no_grad()
    def splatted(self, soup: TriangleSoup, appearance: SoupAppearance, view: int) -> Float[Tensor, "H W 3"]:
        """A view of the soup, clamped to [0, 1]."""
        rendering = render_soup(soup, self._views.view(view).camera, appearance, backgrounds=self._background[None])
        return rendering.color[0].clamp(0.0, 1.0)

    def opaque(self, soup: TriangleSoup, appearance: SoupAppearance, view: int) -> Float[Tensor, "H W 3"]:
        """The same as a mesh viewer would draw it."""
        picture = render_soup_opaque(
            soup,
            self._views.view(view).camera,
            appearance,
            background=self._background,
            supersampling=SUPERSAMPLING,
        )
        return picture[0].clamp(0.0, 1.0)


def _row(scores: dict[str, list[float]], index: int) -> dict[str, float]:
    return {name: values[index] for name, values in scores.items()}
