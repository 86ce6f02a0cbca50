"""Meshes of fewer faces, by collapsing edges at the least quadric error (fast-simplification)."""

from typing import Any

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.validation import check_count, check_indices, check_shape
from etsplat.geometry.manifold import taken_apart
from etsplat.geometry.topology import MeshTopology

HASTES = (5.0, 3.0, 7.0)
"""How fast the error that a collapse may make grows: tried in this order until the result is as sound as the input, and
has no more faces than asked for."""

_TRIES = 4
"""How often a result of too many faces is made again with fewer, each time by twice what there were too many."""


def decimated(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], count: int
) -> tuple[Float[Tensor, "V2 3"], Int64[Tensor, "F2 3"]]:
    """A mesh of at most so many faces. The same for the same input.

    Args:
        vertices: (V, 3) finite.
        faces: (F, 3).
        count: faces, at least 4. A mesh that has no more is returned as it is.

    Returns:
        Vertices and faces, on the CPU; closed, manifold and oriented where the input is.

    Raises:
        ValueError: wrong shape, index or number.
        InputError: fast-simplification is not installed; or a mesh does not come to so few without being torn.
    """
    check_shape("vertices", vertices, ("V", 3))
    check_shape("faces", faces, ("F", 3))
    check_indices("faces", faces, len(vertices))
    count = check_count("count", count, least=4)
    vertices, faces = vertices.detach().cpu(), faces.detach().cpu().long()
    if len(faces) <= count:
        return vertices, faces
    simplify = load_simplifier().simplify
    sound = _is_sound(faces, len(vertices))
    for haste in HASTES:
        target = count
        for _ in range(_TRIES):
            points, triangles = simplify(vertices.numpy(), faces.int().numpy(), target_count=target, agg=haste)
            found = torch.from_numpy(points).to(vertices), _clean(torch.from_numpy(triangles).long())
            whole = _repaired(*found) if sound else _compact(*found)
            if whole is None:
                break
            if len(whole[1]) <= count:
                return whole
            target = max(4, target - 2 * (len(whole[1]) - count))
    raise InputError(f"faces: at {count} the mesh would not stay {'closed' if sound else 'whole'}; ask for more")


def _repaired(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor] | None:
    """The mesh, taken apart where it touches itself; None where it has holes."""
    if not len(faces):
        return None
    try:
        vertices, faces = taken_apart(vertices, faces)
    except (ValueError, IndexError, RuntimeError):  # not closed: half-edges do not pair up
        return None
    return _compact(vertices, faces) if _is_sound(faces, len(vertices)) else None


def _is_sound(faces: Tensor, count: int) -> bool:
    topology = MeshTopology.from_faces(faces, count)
    return topology.is_closed() and topology.is_manifold() and topology.is_oriented()


def _clean(faces: Tensor) -> Tensor:
    """Without faces that repeat a vertex."""
    return faces[(faces != faces.roll(-1, dims=1)).all(dim=1)]


def _compact(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Without vertices that no face uses."""
    used, compact = faces.unique(return_inverse=True)
    return vertices[used], compact


def load_simplifier() -> Any:
    """The package; InputError, which says how to install it, where it is missing."""
    try:
        import fast_simplification
    except ImportError as error:
        raise InputError("fewer faces need fast-simplification: pip install 'etsplat[texture]'") from error
    return fast_simplification
