"""Terms that keep a mesh well shaped (paper section 3.3, L_mesh; formulas in ops/mesh_energies.py)."""

from jaxtyping import Float
from torch import Tensor

from etsplat.model.model import model_for
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.mesh_energies import MeshEnergies, mesh_energies
from etsplat.optim.objective import Drawing, Term
from etsplat.optim.schedules import Scheduled


def _energies(drawing: Drawing, term: Term, edge_power: int | None = None) -> MeshEnergies:
    """All three at once, as one call computes them; any exponent serves those that have none."""
    energies = drawing.shared.setdefault("mesh_energies", {})
    chosen = edge_power or next(iter(energies), 1)
    if chosen not in energies:
        mesh = model_for(term, drawing.model, TriangleMesh)
        energies[chosen] = mesh_energies(mesh.vertices, mesh.topology.connectivity, edge_power=chosen)
    return energies[chosen]


class EdgeLength(Term):
    """L_e: the mean length of the edges, or the mean of its square.

    Example:
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(0), colors=0.5, opacity=0.98, sigma=0.25)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> drawing = etsplat.Drawing(mesh, camera, torch.zeros(1, 16, 16, 3), None, black, mesh.render(camera))

        >>> mean, square = etsplat.EdgeLength()(drawing), etsplat.EdgeLength(power=2)(drawing)
        >>> round(mean.item(), 4), round(square.item(), 4)
        (1.0515, 1.1056)
    """

    name = "edge"

    def __init__(self, weight: Scheduled = 1.0, power: int = 1) -> None:
        """Takes lambda_e and the exponent, 1 as the paper prints it or 2."""
        super().__init__(weight)
        self._edge_power = power

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of the mesh."""
        return _energies(drawing, self, self._edge_power).edge


class SmoothNormals(Term):
    """L_n: the mean of 1 - cos of the angle between neighbouring faces.

    Example:
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(0), colors=0.5, opacity=0.98, sigma=0.25)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> drawing = etsplat.Drawing(mesh, camera, torch.zeros(1, 16, 16, 3), None, black, mesh.render(camera))

        >>> round(etsplat.SmoothNormals()(drawing).item(), 4)  # of an icosahedron; 0 where all is flat
        0.2546
    """

    name = "smooth_normal"

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of the mesh."""
        return _energies(drawing, self).normal


class Laplacian(Term):
    """L_lap: the mean distance of vertices from the mean of their neighbours.

    Example:
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(0), colors=0.5, opacity=0.98, sigma=0.25)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> drawing = etsplat.Drawing(mesh, camera, torch.zeros(1, 16, 16, 3), None, black, mesh.render(camera))

        >>> round(etsplat.Laplacian()(drawing).item(), 4)
        0.5528
    """

    name = "laplacian"

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of the mesh."""
        return _energies(drawing, self).laplacian


class Softness(Term):
    """sigma^-2, for the one softness of a mesh.

    Example:
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(0), colors=0.5, opacity=0.98, sigma=0.25)
        >>> camera, black = etsplat.orbit_cameras(16, 16)[0], torch.zeros(1, 3)
        >>> drawing = etsplat.Drawing(mesh, camera, torch.zeros(1, 16, 16, 3), None, black, mesh.render(camera))

        >>> term = etsplat.Softness(weight=0.01)
        >>> round((term.weight * term(drawing) ** term.power).item(), 4)
        0.16
    """

    name = "sigma"
    power = -2

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Sigma."""
        return model_for(self, drawing.model, TriangleMesh).sigma
