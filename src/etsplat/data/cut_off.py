"""Where a visual hull ends because photos do: the frame cuts the object off, and nobody knows how it goes on."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from etsplat.data.carving import Carving
from etsplat.data.dataset import Dataset
from etsplat.data.photos import reduced
from etsplat.data.silhouettes import Silhouette
from etsplat.geometry.measures import face_areas, vertex_normals

_BESIDE = 0.02
"""How far beside the surface it is asked who says that nothing is there, in units of the ball around the object."""


@torch.no_grad()
def cut_off(dataset: Dataset, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> float:
    """The part of a hull's area beyond which too few views look to judge, and none of these says that nothing is there.

    0 where every silhouette keeps off its frame.

    Args:
        dataset: photos with alpha around an object in the unit ball.
        vertices: (V, 3) of the hull, from `visual_hull`.
        faces: (F, 3) of it.
    """
    dataset = reduced(dataset)
    views = [Silhouette(dataset, index) for index in dataset.train]
    if len(faces) == 0 or all(view.whole for view in views):
        return 0.0
    lowest, judges = Carving().judged(views, vertices + _BESIDE * vertex_normals(vertices, faces))
    open_ended = (2 * judges < len(views)) & (lowest >= 0)
    area = face_areas(vertices, faces)
    return float(area[open_ended[faces].all(dim=1)].sum() / area.sum())
