"""Vertices of a mesh that are far from all others: a speck, for which everything else is small in its photos."""

from etsplat.io.mesh_files import MeshFile

FEW = 0.01
"""So many of the vertices at most, or three, are taken for strays."""

FAR = 4.0
"""They are told of where they are so many times as far from the middle as all others: these are a quarter as wide in
photos as they could be."""


def far_vertices_note(mesh: MeshFile) -> str | None:
    """What there is to know of a mesh that is small in its photos for the sake of a few vertices; None of others."""
    distances = (mesh.vertices - mesh.vertices.median(dim=0).values).norm(dim=1)
    order = distances.argsort()
    few = max(3, int(FEW * len(order)))
    if len(order) <= 2 * few:
        return None
    reach = float(distances[order[-few - 1]])
    farthest = float(distances[order[-1]])
    if farthest <= FAR * reach:
        return None
    count = int((distances > FAR * reach).sum())
    x, y, z = mesh.vertices[order[-1]].tolist()
    some = "1 vertex is" if count == 1 else f"{count} vertices are"
    return (
        f"{some} far from all others, as that at ({x:.4g}, {y:.4g}, {z:.4g}), {farthest / max(reach, 1e-30):.0f} times"
        " as far from the middle: everything else is small in the photos; delete what is stray from the mesh"
    )
