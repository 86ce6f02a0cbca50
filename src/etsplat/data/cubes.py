"""Points thinned to the means of those in each cube of a grid; cubes may be as large as they look."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from etsplat.data.dataset import Dataset

OCTAVE = 2
"""In so many steps cubes grow to twice the side."""

_NEAREST = 1e-6
"""Of the distance of the farthest point: cubes do not get smaller where points are nearer to a camera than that."""


def thinned(
    points: Float[Tensor, "P 3"],
    colors: Float[Tensor, "P 3"] | None,
    most: int,
    sizes: Int[Tensor, " P"] | None = None,
    beside: tuple[Float[Tensor, "K 3"], Int[Tensor, " K"]] | None = None,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"] | None]:
    """At most so many points: the means of those in each cube of the smallest cubes that are no more than that.

    Cubes are sized by halving an interval, to 2 %.

    Args:
        points: (P, 3) float64.
        colors: (P, 3), whose means are taken, too.
        most: so many points at most.
        sizes: (P,) how large cubes are where a point is, in steps of which `OCTAVE` double the side; None for one size.
        beside: other points and their sizes, whose cubes are left out; not looked at where `points` are few enough.
    """
    if len(points) <= most:
        return points, colors
    sizes = torch.zeros(len(points), dtype=torch.long) if sizes is None else sizes
    taken, taken_sizes = (points[:0], sizes[:0]) if beside is None else beside
    everything, steps = torch.cat([points, taken]), torch.cat([sizes, taken_sizes])
    low, steps = everything.amin(dim=0), steps - steps.min()
    extent, bits = float((everything.amax(dim=0) - low).max()), (63 - int(steps.max()).bit_length()) // 3

    def free(side: float) -> tuple[Tensor, Tensor, int]:
        cube = _cubes(everything - low, side, steps, bits)
        left = ~torch.isin(cube[: len(points)], cube[len(points) :])
        cubes, number = torch.unique(cube[: len(points)][left], return_inverse=True)
        return left, number, len(cubes)

    least, largest = extent / 2 ** (bits - 1), max(extent, 1e-300)
    while largest > 1.02 * least:
        middle = (least * largest) ** 0.5
        if free(middle)[2] > most:
            least = middle
        else:
            largest = middle
    left, number, count = free(largest)
    held = torch.bincount(number, minlength=count)[:, None]
    means = torch.zeros((count, 3), dtype=points.dtype).index_add_(0, number, points[left]) / held
    if colors is None:
        return means, None
    return means, torch.zeros((count, 3), dtype=colors.dtype).index_add_(0, number, colors[left]) / held


def seen_sizes(points: Float[Tensor, "P 3"], capture: Dataset) -> Int[Tensor, " P"]:
    """Sizes of cubes that look about as large everywhere, from the nearest camera of a training photo.

    Args:
        points: (P, 3) in the frame of the capture.
        capture: photos.
    """
    distances = torch.as_tensor(KDTree(capture.centers[capture.train].numpy()).query(points.numpy())[0])
    return (OCTAVE * distances.clamp_min(_NEAREST * float(distances.max())).log2()).floor().long()


def _cubes(places: Float[Tensor, "P 3"], side: float, steps: Int[Tensor, " P"], bits: int) -> Int[Tensor, " P"]:
    """Numbers of the cubes that places are in, of grids from 0 on; so many bits along each axis, then the size."""
    x, y, z = (places / (side * 2.0 ** (steps[:, None] / OCTAVE))).long().unbind(dim=1)
    return (((steps << bits | x) << bits) | y) << bits | z
