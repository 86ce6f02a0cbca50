"""How many faces of a mesh are unusable: those that cut through others, and those without a shape."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from etsplat import _native
from etsplat.geometry.measures import bounding_ball, face_areas, native_mesh


def intersecting_faces(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Bool[Tensor, " F"]:
    """Marks the faces whose interior meets the interior of another face.

    The interior is the triangle without its boundary. Faces that share a corner or an edge, and faces that merely
    touch, therefore do not count unless they really cut through each other; connectivity plays no part, so that a mesh
    with unshared vertices gives the same answer as a welded one. Coplanar faces that overlap count: a strip folded back
    onto itself, and duplicate faces. Faces whose corners are collinear have no interior and never count
    (`count_degenerate_faces` sees them). Decided exactly for coordinates of sane size (csrc/cpu/predicates.h).

    Args:
        vertices: (V, 3) finite.
        faces: (F, 3).

    Raises:
        ValueError: a shape is wrong, a coordinate is not finite, or an index is out of range.
    """
    return IntersectionSearch(faces)(vertices)


class IntersectionSearch:
    """As `intersecting_faces`, again and again of a mesh that changes here and there.

    Compared with others are the faces that moved since it looked last, and those that were marked then: two of the
    others neither met then nor do now.
    """

    def __init__(self, faces: Int[Tensor, "F 3"]) -> None:
        """Nothing has been seen yet.

        Args:
            faces: (F, 3).
        """
        self._faces = faces
        self._seen: tuple[_native.FaceTree, Float[Tensor, "V 3"], Bool[Tensor, " F"]] | None = None

    def __call__(self, vertices: Float[Tensor, "V 3"]) -> Bool[Tensor, " F"]:
        """Marks the faces that cut through others.

        Args:
            vertices: (V, 3) finite, of the same number each time.

        Raises:
            ValueError: a shape is wrong, a coordinate is not finite, or an index is out of range.
        """
        now, faces = native_mesh(vertices, self._faces)
        marks, again = torch.zeros(len(faces), dtype=torch.bool), None
        if len(faces) == 0:
            return marks
        if self._seen is None:
            tree = _native.face_tree(vertices=now, faces=faces)
        else:
            tree, before, marked = self._seen
            again = marked | (now != before).any(dim=1)[faces].any(dim=1)
            _native.move_face_tree(tree=tree, vertices=now, faces=faces)
        _native.mark_intersecting_faces(tree=tree, again=again, intersecting=marks)
        self._seen = tree, now.clone(), marks.clone()
        return marks


def count_self_intersections(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> int:
    """The number of faces that `intersecting_faces` marks."""
    return int(intersecting_faces(vertices, faces).sum())


def count_degenerate_faces(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> int:
    """The number of faces without a usable shape.

    A face is degenerate if it repeats a vertex index, if its area is below 1e-12 R^2 with R the radius of the mesh
    about the centre of its bounding box, or if its height over its longest edge is below 1e-6 of that edge.

    Args:
        vertices: (V, 3) finite.
        faces: (F, 3).

    Raises:
        ValueError: a shape is wrong, a coordinate is not finite, or an index is out of range.
    """
    vertices, faces = native_mesh(vertices, faces)
    if len(faces) == 0:
        return 0
    _, radius = bounding_ball(vertices)
    corners = vertices[faces]
    areas = face_areas(vertices, faces)
    longest2 = (corners - corners.roll(-1, dims=1)).square().sum(dim=2).amax(dim=1)
    repeated = (faces == faces.roll(-1, dims=1)).any(dim=1)
    return int((repeated | (areas < 1e-12 * radius**2) | (2 * areas < 1e-6 * longest2)).sum())
