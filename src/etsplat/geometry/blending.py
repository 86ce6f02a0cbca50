"""Values of places that have none, from the nearest places that have some."""

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

_NEAREST = 8
_CLOSE = 1e-6


def blended(
    places: Float[Tensor, "M 3"], known: Float[Tensor, "K 3"], values: Float[Tensor, "K C"]
) -> Float[Tensor, "M C"]:
    """At each place a mean of the values of the eight nearest that are known, by the reciprocal of their distance.

    Args:
        places: on the CPU, as are the others.
        known: at least one.
        values: of these.
    """
    found = KDTree(known.numpy()).query(places.numpy(), k=min(_NEAREST, len(known)))
    distance, nearest = (torch.from_numpy(array).reshape(len(places), -1) for array in found)
    weight = 1 / distance.float().clamp_min(_CLOSE)
    return (weight[..., None] * values[nearest]).sum(dim=1) / weight.sum(dim=1, keepdim=True)
