"""How far a picture is from its photo."""

from typing import Literal

from jaxtyping import Float
from torch import Tensor

from etsplat.core.validation import check_choice, check_number
from etsplat.ops.photometric import photometric_loss
from etsplat.optim.objective import Drawing, Term

TINY = 1e-12
"""Added under the root, whose slope a picture without an error would not have."""


class Photometric(Term):
    """(1 - l) L_1 + l (1 - SSIM) over the same background; with l = 0 the paper's L_c (ops/photometric.py).

    In the place of L_1 there may be mean squares, or their root, which pulls at a pixel by how much more wrong it is
    than the picture as a whole: what is far off counts more than in L_1, however good the picture is.

    Example:
        >>> objective = etsplat.Objective(etsplat.Photometric(dssim=0.2, pixel="l1"))
    """

    outputs = ("color",)
    looks_at = "colors"

    def __init__(self, dssim: float = 0.0, pixel: Literal["l1", "l2", "rms"] = "l1") -> None:
        """Takes its settings.

        Args:
            dssim: l, the share of 1 - SSIM, from 0 to 1.
            pixel: "l1"; "l2" for squares, as Triangle Splatting has it for very large outdoor scenes; or "rms" for the
                root of their mean.

        Raises:
            ValueError: another share, or another kind of difference.
        """
        check_number("dssim", dssim, 0, 1)
        check_choice("pixel", pixel, ("l1", "l2", "rms"))
        super().__init__()
        self._dssim = dssim
        self._pixel: Literal["l1", "l2", "rms"] = pixel

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._dssim:.3g}, {self._pixel!r})"

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of one view; pixels that its mask leaves out count as right."""
        mask = None if drawing.mask is None else drawing.mask.float() / 255
        color, photo, background = drawing.rendering.color, drawing.photo, drawing.background
        if self._pixel != "rms":
            return photometric_loss(color, photo, self._dssim, mask, backgrounds=background, pixel=self._pixel)
        squares = photometric_loss(color, photo, 0.0, mask, backgrounds=background, pixel="l2")
        root = (squares + TINY).sqrt()
        if self._dssim == 0.0:
            return root
        dissimilar = photometric_loss(color, photo, 1.0, mask, backgrounds=background)
        return (1 - self._dssim) * root + self._dssim * dissimilar
