"""The mean area of triangles, in plain PyTorch."""

import torch
from torch import Tensor


def mean_area(vertices: Tensor) -> Tensor:
    """See `etsplat.ops.triangle_area`."""
    first, second = vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]
    return 0.5 * torch.linalg.cross(first, second).norm(dim=1).mean()
