"""How far a picture is from its photo."""

from typing import Literal

from jaxtyping import Float
from torch import Tensor

from etsplat.ops.photometric import photometric_loss
from etsplat.optim.objective import Drawing, Term


class Photometric(Term):
    """(1 - l) L_1 + l (1 - SSIM) over the same background; with l = 0 the paper's L_c (ops/photometric.py).

    Example:
        >>> objective = etsplat.Objective(etsplat.Photometric(dssim=0.2, pixel="l1"))
    """

    outputs = ("color",)

    def __init__(self, dssim: float = 0.0, pixel: Literal["l1", "l2"] = "l1") -> None:
        """Takes its settings.

        Args:
            dssim: l, the share of 1 - SSIM, from 0 to 1.
            pixel: "l1", or "l2" for squares, as Triangle Splatting has it for very large outdoor scenes.
        """
        super().__init__()
        self._dssim = dssim
        self._pixel: Literal["l1", "l2"] = pixel

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of one view; pixels that its mask leaves out count as right."""
        mask = None if drawing.mask is None else drawing.mask.float() / 255
        color, photo, background = drawing.rendering.color, drawing.photo, drawing.background
        return photometric_loss(color, photo, self._dssim, mask, backgrounds=background, pixel=self._pixel)
