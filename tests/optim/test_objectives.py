"""The objective is the paper's L_mesh, term by term."""

import math

import pytest
import torch
from torch import Tensor

from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.objectives import MeshWeights, mesh_objective

# Two faces that share the edge (0, 2) of a folded unit square.
VERTICES = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.0, 1.0, 0.0], [0.0, 1.0, 0.25]]
FACES = [[0, 1, 2], [0, 2, 3]]
NONE = MeshWeights(edge=0.0, normal=0.0, laplacian=0.0, softness=0.0, edge_power=1)


def a_mesh(sigma: float = 0.5) -> TriangleMesh:
    vertices = torch.tensor(VERTICES, dtype=torch.float64)
    return TriangleMesh.from_mesh(vertices, torch.tensor(FACES), colors=0.3, opacity=0.9, sigma=sigma)


def some_images(rng: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    color = torch.rand(2, 5, 7, 3, generator=rng, dtype=torch.float64)
    straight = torch.rand(2, 5, 7, 4, generator=rng, dtype=torch.float64)
    target = torch.cat([straight[..., :3] * straight[..., 3:], straight[..., 3:]], dim=-1)
    return color, target, torch.rand(2, 3, generator=rng, dtype=torch.float64)


def distance(i: int, j: int) -> float:
    return math.dist(VERTICES[i], VERTICES[j])


def to_mean(i: int, neighbors: list[int]) -> float:
    return math.dist(VERTICES[i], [sum(VERTICES[j][k] for j in neighbors) / len(neighbors) for k in range(3)])


def unit_normal(face: list[int]) -> list[float]:
    a, b, c = (VERTICES[i] for i in face)
    u, v = [b[k] - a[k] for k in range(3)], [c[k] - a[k] for k in range(3)]
    n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    return [x / math.hypot(*n) for x in n]


EDGES = [(0, 1), (1, 2), (0, 2), (2, 3), (0, 3)]
EXPECTED = {
    "edge": sum(distance(i, j) for i, j in EDGES) / 5,
    "edge squared": sum(distance(i, j) ** 2 for i, j in EDGES) / 5,
    "normal": 1 - sum(a * b for a, b in zip(unit_normal(FACES[0]), unit_normal(FACES[1]), strict=True)),
    "laplacian": (to_mean(0, [1, 2, 3]) + to_mean(1, [0, 2]) + to_mean(2, [0, 1, 3]) + to_mean(3, [0, 2])) / 4,
    "softness": 1 / 0.5**2,
}


@pytest.mark.parametrize(
    ("term", "weights"),
    [
        ("edge", MeshWeights(1.0, 0.0, 0.0, 0.0, 1)),
        ("edge squared", MeshWeights(1.0, 0.0, 0.0, 0.0, 2)),
        ("normal", MeshWeights(0.0, 1.0, 0.0, 0.0, 1)),
        ("laplacian", MeshWeights(0.0, 0.0, 1.0, 0.0, 1)),
        ("softness", MeshWeights(0.0, 0.0, 0.0, 1.0, 1)),
    ],
)
def test_each_term_is_the_papers_formula(rng: torch.Generator, term: str, weights: MeshWeights) -> None:
    """With one weight at 1 and gamma 0.7, the objective exceeds the photometric loss by 0.7 of that term."""
    color, target, backgrounds = some_images(rng)
    photometric = mesh_objective(color, target, backgrounds, a_mesh(), NONE, 0.7)
    objective = mesh_objective(color, target, backgrounds, a_mesh(), weights, 0.7)
    assert float((objective - photometric).detach()) == pytest.approx(0.7 * EXPECTED[term], rel=1e-12)


def test_the_photometric_term_compares_over_the_same_background(rng: torch.Generator) -> None:
    """L_c is the mean of |color - (rgb + (1 - a) background)| with the background of each view."""
    color, target, backgrounds = some_images(rng)
    composited = target[..., :3] + (1 - target[..., 3:]) * backgrounds[:, None, None]
    loss = mesh_objective(color, target, backgrounds, a_mesh(), NONE, 0.0)
    assert float(loss) == pytest.approx(float((color - composited).abs().mean()), rel=1e-12)


def test_the_papers_weights_add_up(rng: torch.Generator) -> None:
    """With lambda 1.5, 0.01, 0.5 and 1e-4 the objective is L_c + gamma times the weighted sum."""
    color, target, backgrounds = some_images(rng)
    weights = MeshWeights(1.5, 0.01, 0.5, 1e-4, 1)
    photometric = float(mesh_objective(color, target, backgrounds, a_mesh(), NONE, 0.0))
    terms = {"edge": 1.5, "normal": 0.01, "laplacian": 0.5, "softness": 1e-4}
    expected = photometric + 0.25 * sum(weight * EXPECTED[term] for term, weight in terms.items())
    objective = mesh_objective(color, target, backgrounds, a_mesh(), weights, 0.25)
    assert float(objective.detach()) == pytest.approx(expected, rel=1e-12)


def test_softness_pushes_sigma_up() -> None:
    """The gradient of sigma^-2 with respect to log sigma is -2 sigma^-2: descent makes a small sigma larger."""
    mesh = a_mesh(sigma=0.1)
    image = torch.zeros(1, 2, 2, 3, dtype=torch.float64)
    weights = MeshWeights(0.0, 0.0, 0.0, 1e-3, 1)
    target = torch.zeros(1, 2, 2, 4, dtype=torch.float64)
    mesh_objective(image, target, torch.zeros(1, 3, dtype=torch.float64), mesh, weights, 1.0).backward()
    assert mesh.log_sigma.grad is not None
    assert float(mesh.log_sigma.grad) == pytest.approx(-2 * 1e-3 / 0.1**2, rel=1e-12)


def test_parameters_start_where_they_are_told_to() -> None:
    """Opacity, sigma and colour come back from their parametrisation; the display colours are clamped."""
    mesh = a_mesh(sigma=0.25)
    assert mesh.opacities.tolist() == pytest.approx([0.9, 0.9])
    assert float(mesh.sigma.detach()) == pytest.approx(0.25)
    with torch.no_grad():
        mesh.colors[0] = torch.tensor([-0.5, 0.5, 1.5])
    assert mesh.display_colors[0].tolist() == [0.0, 0.5, 1.0]
