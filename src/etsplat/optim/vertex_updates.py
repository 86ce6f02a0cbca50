"""Steps for vertices other than Adam's own: equal scale everywhere, and smoothed by the mesh's Laplacian.

Large steps (Nicolet et al. 2021): with M = I + w L, L the combinatorial Laplacian, the gradient g by the vertices
becomes M^-1 g by the differential coordinates u = M v, Adam's moments are taken of that, all components are divided by
the one largest second moment (Adam divides each by its own, which would undo the smoothing), and the step goes back to
v as M^-1 again. No u is stored: v moves by M^-1 times u's step.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from scipy.sparse import csc_array, identity
from torch import Tensor

from etsplat.geometry.laplacians import laplacian, solver
from etsplat.geometry.topology import MeshTopology
from etsplat.model.model import model_for
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.adam import Adam

Solve = Callable[[Float[Tensor, "V 3"]], Float[Tensor, "V 3"]]


def laplacian_solver(topology: MeshTopology, weight: float) -> Solve:
    """X -> (I + weight L)^-1 x, factorised once; float64 inside."""
    V = topology.num_vertices
    solution = solver(csc_array(identity(V) + weight * laplacian(topology.edges, V)))

    def solve(x: Tensor) -> Tensor:
        return torch.from_numpy(solution(x.detach().cpu().double().numpy())).to(x)

    return solve


class UniformSteps:
    """Steps of a mesh's vertices with one scale for all of them; of other parameters Adam's own.

    Example:
        >>> photos = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0,), azimuths=3, supersampling=1)
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(2), colors=0.7, opacity=0.98, sigma=0.25)
        >>> objective, smooth = etsplat.Objective(etsplat.Photometric()), etsplat.UniformSteps(smoothing=10.0)
        >>> before = mesh.vertices.detach().clone()
        >>> outcome = etsplat.Trainer(mesh, photos, objective, update=smooth).fit(2)
        >>> bool((mesh.vertices - before).norm(dim=1).min() > 0)  # also of those that no photo shows
        True
    """

    def __init__(self, smoothing: float | None = None) -> None:
        """Takes the weight of the Laplacian beside the identity, or None for no smoothing."""
        self._smoothing = smoothing
        self._solve: Solve | None = None
        self._topology: MeshTopology | None = None

    def __call__(self, adam: Adam, mesh: TriangleMesh) -> None:
        """One step, by the gradients and learning rates that `adam` has. ValueError for another model than a mesh."""
        mesh = model_for(self, mesh, TriangleMesh)
        if self._smoothing is not None and mesh.topology is not self._topology:
            self._topology, self._solve = mesh.topology, laplacian_solver(mesh.topology, self._smoothing)
        uniform_step(adam, "vertices", adam.learning_rates["vertices"], self._solve)


@torch.no_grad()
def uniform_step(adam: Adam, name: str, rate: float, solve: Solve | None) -> None:
    """Adam's step for all parameters, but for `name` with one scale for all of its components.

        p <- p - rate M^-1 m / max(sqrt(v)),   m and v the bias-corrected moments of M^-1 g

    times the pace of each row, where it has one.

    Args:
        adam: every parameter has its gradient.
        name: which one.
        rate: its learning rate.
        solve: x -> M^-1 x, or None for no smoothing.
    """
    parameter = adam.parameters[name]
    if solve is not None and parameter.grad is not None:
        parameter.grad = solve(parameter.grad)
    adam.learning_rates[name] = 0.0  # the moments are updated, the parameter is not
    adam.step()
    beta1, beta2 = adam.betas
    scale = float(adam.second_moments[name].max()) / (1 - beta2**adam.step_count)
    direction = adam.first_moments[name] / ((1 - beta1**adam.step_count) * (scale**0.5 + adam.eps))
    step = rate * (direction if solve is None else solve(direction))
    parameter -= step * adam.paces[name][:, None] if name in adam.paces else step
