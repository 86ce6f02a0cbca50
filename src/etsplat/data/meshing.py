"""Dual contouring: a triangle mesh of a signed distance function that keeps its creases and corners.

Ju, Losasso, Schaefer, Warren, "Dual Contouring of Hermite Data", SIGGRAPH 2002: a vertex in each grid cell that the
surface enters, placed where the tangent planes at the cell's edge crossings meet best; one quad per crossed edge.
A cell that the surface enters in several sheets gets a vertex for each, as in Nielson, "Dual Marching Cubes", 2004.
"""

from collections.abc import Callable
from functools import cache
from itertools import product

import numpy as np

SignedDistance = Callable[[np.ndarray], np.ndarray]
"""(n, 3) float64 points to (n,) values, negative inside. Needs to be continuous, not to be a true distance."""

# Cells around an edge along each axis, counter-clockwise seen from the axis's positive end.
_RING = {
    0: np.array([[0, 0, 0], [0, -1, 0], [0, -1, -1], [0, 0, -1]]),
    1: np.array([[0, 0, 0], [0, 0, -1], [-1, 0, -1], [-1, 0, 0]]),
    2: np.array([[0, 0, 0], [-1, 0, 0], [-1, -1, 0], [0, -1, 0]]),
}


def dual_contour(
    sdf: SignedDistance,
    lower: tuple[float, float, float],
    cell: float,
    cells: tuple[int, int, int],
    *,
    bisections: int = 30,
    values: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mesh the zero level of `sdf` inside a box of cubic cells. The surface must stay off the box's outermost cells.

    The mesh is closed and consistently oriented, counter-clockwise seen from outside. It is manifold unless the shape
    has holes narrower than a cell.

    Args:
        sdf: the shape.
        lower: the box's lowest corner.
        cell: side of a cell.
        cells: number of cells along x, y, z.
        bisections: the surface is found to this power of 2 of a cell; 30 are far below float32 resolution.
        values: of `sdf` at the cells' corners, (x + 1, y + 1, z + 1), where they are known.

    Returns:
        vertices (V, 3) float64 and faces (F, 3) int64.

    Raises:
        ValueError: the surface reaches the border of the box.
    """
    origin = np.asarray(lower, dtype=np.float64)
    if values is None:
        axes = [origin[k] + cell * np.arange(cells[k] + 1) for k in range(3)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        values = sdf(nodes.reshape(-1, 3)).reshape(nodes.shape[:3])
    inside = values < 0

    sheet, corners = _sheets(), _corner_codes(inside)
    quads, points, normals = [], [], []
    for axis in range(3):
        start, inward = _crossed_edges(inside, axis)
        if len(start) and (start.min() == 0 or (start >= np.array(cells)).any()):
            raise ValueError("lower, cell, cells: the surface reaches the border of the box")
        around = start[:, None] + _RING[axis]
        u, v = np.delete(-_RING[axis], axis, axis=1).T
        edge = 4 * axis + u + 2 * v
        # The vertices of one quad: the cells around the edge, in each the sheet that the edge belongs to.
        code = corners[tuple(np.moveaxis(around, -1, 0))]
        ring = 4 * np.ravel_multi_index(tuple(np.moveaxis(around, -1, 0)), cells) + sheet[code, edge]
        # From inside to outside along the axis the outward side is the axis's positive end.
        quads.append(np.where(inward[:, None], ring[:, ::-1], ring))
        crossing = _crossings(sdf, origin + cell * start, axis, cell, bisections)
        points.append(crossing)
        normals.append(_gradient(sdf, crossing, 1e-4 * cell))
    used, quad = np.unique(np.concatenate(quads), return_inverse=True)
    quad = quad.reshape(-1, 4)
    corner = origin + cell * np.stack(np.unravel_index(used // 4, cells), axis=-1)
    vertices = _cell_vertices(quad, np.concatenate(points), np.concatenate(normals), corner, cell)
    return vertices, _split_quads(sdf, vertices, quad)


def _corner_codes(inside: np.ndarray) -> np.ndarray:
    """For each cell a byte: bit x + 2 y + 4 z tells whether that corner is inside."""
    n = np.array(inside.shape) - 1
    codes = np.zeros(n, dtype=np.uint8)
    for x, y, z in product(range(2), repeat=3):
        codes |= inside[x : n[0] + x, y : n[1] + y, z : n[2] + z].astype(np.uint8) << (x + 2 * y + 4 * z)
    return codes


@cache
def _sheets() -> np.ndarray:
    """(256, 12) number of the sheet (0..3) that each crossed edge of a cell belongs to, by corner code.

    Edge 4 a + u + 2 v runs along axis a at position (u, v) on the other two axes. On every face of the cell crossed
    edges are joined in pairs; where all four are crossed, the two that meet in an inside corner (so that both cells at
    the face agree). A sheet is a loop of joined edges.
    """
    table = np.zeros((256, 12), dtype=np.int64)
    for code in range(256):
        parent = list(range(12))

        def root(edge: int, parent: list[int] = parent) -> int:
            while parent[edge] != edge:
                edge = parent[edge]
            return edge

        crossed = [edge for edge in range(12) if len({code >> corner & 1 for corner in _edge_corners(edge)}) == 2]
        for face_axis, side in product(range(3), range(2)):
            face = {corner for corner in range(8) if corner >> face_axis & 1 == side}
            edges = [edge for edge in crossed if set(_edge_corners(edge)) <= face]
            for first, second in product(edges, edges):
                shared = set(_edge_corners(first)) & set(_edge_corners(second))
                if first < second and (len(edges) == 2 or any(code >> corner & 1 for corner in shared)):
                    parent[root(second)] = root(first)
        roots = sorted({root(edge) for edge in crossed})
        for edge in crossed:
            table[code, edge] = roots.index(root(edge))
    return table


def _edge_corners(edge: int) -> tuple[int, int]:
    axis, position = edge // 4, edge % 4
    u, v = [other for other in range(3) if other != axis]
    low = ((position & 1) << u) | ((position >> 1) << v)
    return low, low | (1 << axis)


def _crossed_edges(inside: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower end (n, 3) of each grid edge along `axis` with a sign change, and whether it leads into the shape."""
    along = np.moveaxis(inside, axis, 0)
    crossed = np.moveaxis(along[1:] != along[:-1], 0, axis)
    start = np.argwhere(crossed)
    return start, ~inside[tuple(start.T)]


def _crossings(sdf: SignedDistance, start: np.ndarray, axis: int, cell: float, bisections: int) -> np.ndarray:
    """Where the surface crosses each edge, by bisection."""
    low, high = np.zeros(len(start)), np.full(len(start), cell)
    point = start.copy()
    start_inside = sdf(start) < 0
    for _ in range(bisections):
        middle = (low + high) / 2
        point[:, axis] = start[:, axis] + middle
        same = (sdf(point) < 0) == start_inside
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return point


def _gradient(sdf: SignedDistance, points: np.ndarray, step: float) -> np.ndarray:
    """Unit gradient by central differences."""
    gradient = np.stack([sdf(points + offset) - sdf(points - offset) for offset in step * np.eye(3)], axis=-1)
    return gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-300)


def _cell_vertices(
    quad: np.ndarray, points: np.ndarray, normals: np.ndarray, corner: np.ndarray, cell: float
) -> np.ndarray:
    """Minimise sum_i (n_i . (x - p_i))^2 over each vertex's crossings, starting from their mean (section 2.3).

    Directions in which the planes say nothing (singular value below a tenth of the largest) keep the mean. The
    result is held inside its cell, without which neighbouring quads could fold over each other.
    """
    index, count = quad.reshape(-1), np.zeros(len(corner))
    np.add.at(count, index, 1)
    mean = np.zeros_like(corner)
    np.add.at(mean, index, np.repeat(points, 4, axis=0))
    mean /= count[:, None]
    n, p = np.repeat(normals, 4, axis=0), np.repeat(points, 4, axis=0)
    matrix, rhs = np.zeros((len(corner), 3, 3)), np.zeros((len(corner), 3))
    np.add.at(matrix, index, n[:, :, None] * n[:, None, :])
    np.add.at(rhs, index, n * np.sum(n * (p - mean[index]), axis=1, keepdims=True))
    eigenvalues, basis = np.linalg.eigh(matrix)
    inverse = np.where(eigenvalues > 0.01 * eigenvalues[:, -1:], 1 / np.maximum(eigenvalues, 1e-12), 0)
    shift = np.einsum("vij,vj,vkj,vk->vi", basis, inverse, basis, rhs)
    margin = 0.02 * cell
    return np.clip(mean + shift, corner + margin, corner + cell - margin)


def _split_quads(sdf: SignedDistance, vertices: np.ndarray, quad: np.ndarray) -> np.ndarray:
    """Two triangles per quad, along the diagonal whose middle is nearer the surface: diagonals follow creases."""
    middle = [(vertices[quad[:, k]] + vertices[quad[:, k + 2]]) / 2 for k in range(2)]
    second = np.abs(sdf(middle[1])) < np.abs(sdf(middle[0]))
    turned = np.where(second[:, None], np.roll(quad, -1, axis=1), quad)
    return np.concatenate([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]]).astype(np.int64)
