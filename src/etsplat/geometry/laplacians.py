"""The combinatorial Laplacian of a mesh, and sparse systems that it is part of."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Int
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from torch import Tensor


def laplacian(edges: Int[Tensor, "E 2"], count: int) -> csr_array:
    """(count, count) matrix of the sum over edges of squared differences: degrees less adjacency."""
    first, second = edges.cpu().numpy().T
    ends = np.r_[first, second], np.r_[second, first]
    links = csr_array((np.ones(2 * len(first)), ends), shape=(count, count))
    return (diags_array(links.sum(axis=1)) - links).tocsr()


def solver(matrix: csc_array) -> Callable[[np.ndarray], np.ndarray]:
    """The x of matrix x = b, as a function of b, for a symmetric positive definite matrix that is factorised once."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve
