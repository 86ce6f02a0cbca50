"""How many pixels photos have for a surface."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.photos import blank_photos, first_hits


@torch.no_grad()
def surface_pixels(dataset: Dataset, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> float:
    """The pixels of all faces, each as large as the training photo has it that shows it largest.

    A photo shows a face that is nearest in one of its pixels. What no photo shows counts nothing.

    Args:
        dataset: photos.
        vertices: (V, 3) of a surface in their frame, on the CPU.
        faces: (F, 3) of it.
    """
    largest = torch.zeros(len(faces))
    for photo in blank_photos(dataset):
        shown = first_hits(photo, vertices, faces)[1].unique()
        shown = shown[shown >= 0]
        places = photo.project(vertices[faces[shown]])[0]
        height, width = photo.pixels.shape[2:]
        first, second = (places[:, 1:] - places[:, :1]).unbind(dim=1)
        square = 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).abs()  # -1 to 1 across the picture
        largest[shown] = torch.maximum(largest[shown], square * (width * height / 4))
    return float(largest.sum())
