"""What is minimised: the paper's L_mesh."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.mesh_energies import mesh_energies
from etsplat.ops.photometric import photometric_loss
from etsplat.ops.weighted_sum import Term, weighted_sum


@dataclass(frozen=True)
class MeshWeights:
    """Weights of the regularizers in L_mesh (paper, implementation details).

    Attributes:
        edge: lambda_e.
        normal: lambda_n.
        laplacian: lambda_lap.
        softness: lambda_sigma.
        edge_power: 1 for mean edge lengths as the paper prints it, 2 for mean squared lengths.
    """

    edge: float
    normal: float
    laplacian: float
    softness: float
    edge_power: int


def mesh_objective(
    color: Float[Tensor, "B H W 3"],
    target: Float[Tensor, "B H W 4"],
    backgrounds: Float[Tensor, "B 3"],
    mesh: TriangleMesh,
    weights: MeshWeights,
    gamma: float | Float[Tensor, ""],
) -> Float[Tensor, ""]:
    """The paper's training objective of shape reconstruction (section 3.3, L_mesh).

    L_mesh = L_c + gamma (lambda_e L_e + lambda_n L_n + lambda_lap L_lap + lambda_sigma sigma^-2), with L_c the mean
    absolute difference to the target over the same background. A mesh of opaque triangles has no sigma term.

    Args:
        color: (B, H, W, 3) rendered over `backgrounds`.
        target: (B, H, W, 4) premultiplied RGBA.
        backgrounds: (B, 3).
        mesh: whose geometry and softness are regularized.
        weights: lambda_e, lambda_n, lambda_lap, lambda_sigma and the exponent of L_e.
        gamma: global weight of the regularizers; at the number 0 they are not computed.

    Returns:
        Scalar, differentiable with respect to `color` and the mesh's parameters.
    """
    photometric = photometric_loss(color, target, 0.0, backgrounds=backgrounds)
    if not isinstance(gamma, Tensor) and gamma == 0.0:
        return photometric
    energies = mesh_energies(mesh.vertices, mesh.topology.connectivity, edge_power=weights.edge_power)
    terms = [
        Term(weights.edge, energies.edge),
        Term(weights.normal, energies.normal),
        Term(weights.laplacian, energies.laplacian),
    ]
    if mesh.log_sigma is not None:
        terms.append(Term(weights.softness, mesh.sigma, -2))
    return weighted_sum(photometric, terms, gamma)
