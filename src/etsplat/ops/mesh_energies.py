"""The energies that keep a mesh well shaped (paper, section 3.3), with analytic gradients.

    L_e   = 1/|E| sum over edges of |e|               (or |e|^2, as in pytorch3d)
    L_n   = 1/|P| sum over pairs of adjacent faces of 1 - n0 . n1
    L_lap = 1/|V| sum over vertices of |v_i - mean of its neighbours|

What has no direction gives no gradient: an edge or a Laplacian of length 1e-12 or less, and a face whose doubled area
is at most 1e-6 of its longest edge squared, whose pairs count 0 in L_n. A vertex without neighbours counts 0 in L_lap.
"""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from etsplat.core.connectivity import HOW_CONNECTED, MeshConnectivity
from etsplat.core.precision import as_given
from etsplat.core.validation import check_floating, check_kind, check_shape
from etsplat.engines.choice import engine_for


class MeshEnergies(NamedTuple):
    """Three differentiable scalars.

    Attributes:
        edge: L_e.
        normal: L_n, in [0, 2].
        laplacian: L_lap.

    Example:
        >>> vertices, faces = etsplat.icosphere(2)
        >>> connectivity = etsplat.MeshTopology.from_faces(faces, len(vertices)).connectivity
        >>> edge, normal, laplacian = etsplat.mesh_energies(vertices, connectivity)
        >>> bool(normal > 0)
        True
    """

    edge: Float[Tensor, ""]
    normal: Float[Tensor, ""]
    laplacian: Float[Tensor, ""]


@as_given
def mesh_energies(
    vertices: Float[Tensor, "V 3"],
    connectivity: MeshConnectivity,
    *,
    edge_power: int = 1,
) -> MeshEnergies:
    """L_e, L_n and L_lap of a mesh, differentiable by its vertices.

    Args:
        vertices: (V, 3).
        connectivity: Of the mesh; ``MeshTopology.connectivity``.
        edge_power: 1 for the mean length of the edges (the paper's formula), 2 for the mean squared length.

    Returns:
        The three scalars. The native engines' values and gradients are the same bits in every run, for any number of
        threads.

    Raises:
        ValueError: Wrong shape, dtype or device, another power, or a topology in the place of its connectivity.

    Example:
        >>> vertices, faces = etsplat.icosphere(2)
        >>> topology = etsplat.MeshTopology.from_faces(faces, len(vertices))
        >>> energies = etsplat.mesh_energies(vertices.requires_grad_(), topology.connectivity)
        >>> (energies.edge + energies.laplacian).backward()
        >>> vertices.grad.shape
        torch.Size([162, 3])
    """
    check_kind("connectivity", connectivity, MeshConnectivity, HOW_CONNECTED)
    check_shape("vertices", vertices, (connectivity.num_vertices, 3))
    check_floating("vertices", vertices)
    if connectivity.faces.device != vertices.device:
        raise ValueError(f"connectivity must be on {vertices.device}, got {connectivity.faces.device}")
    if edge_power not in (1, 2):
        raise ValueError(f"edge_power must be 1 or 2, got {edge_power}")
    return MeshEnergies(*engine_for(vertices).mesh_energies(vertices, connectivity, edge_power))
