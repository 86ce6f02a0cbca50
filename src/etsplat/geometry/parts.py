"""Connected parts of a mesh, and their genus: how many holes go through each."""

import numpy as np
import torch
from jaxtyping import Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor


def face_parts(faces: Int64[Tensor, "F 3"], num_vertices: int) -> Int64[Tensor, " F"]:
    """The part that each face belongs to, those with most faces first; faces with a common vertex are together."""
    first, second = faces.numpy().ravel(), faces.roll(1, dims=1).numpy().ravel()
    links = coo_matrix((np.ones(len(first), dtype=bool), (first, second)), (num_vertices, num_vertices))
    label = torch.from_numpy(connected_components(links, directed=False)[1]).long()[faces[:, 0]]
    rank = torch.argsort(torch.argsort(label.bincount(), descending=True, stable=True))
    return rank[label]


def genera(faces: Int64[Tensor, "F 3"], num_vertices: int) -> list[int]:
    """The genus of each part of a closed mesh, in the order of `face_parts`: 1 - (V - E + F) / 2, rounded down."""
    part, found = face_parts(faces, num_vertices), []
    for number in range(int(part.max()) + 1 if len(part) else 0):
        own = faces[part == number]
        edges = torch.cat([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]]).sort(dim=1).values.unique(dim=0)
        found.append((2 - (len(own.unique()) - len(edges) + len(own))) // 2)
    return found
