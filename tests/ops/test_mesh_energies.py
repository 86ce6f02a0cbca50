import math

import pytest
import torch

from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.ops.mesh_energies import MeshConnectivity, mesh_energies
from helpers.engines import on


def bumpy_sphere(rng: torch.Generator, level: int, noise: float) -> tuple[torch.Tensor, MeshConnectivity]:
    vertices, faces = icosphere(level)
    jitter = noise * torch.randn(vertices.shape, generator=rng)
    return vertices + jitter, MeshTopology.from_faces(faces, len(vertices)).connectivity


def mesh(faces: list[list[int]], num_vertices: int) -> MeshConnectivity:
    return MeshTopology.from_faces(torch.tensor(faces, dtype=torch.int64).reshape(-1, 3), num_vertices).connectivity


def values_and_gradients(vertices, connectivity, power, engine=None):
    leaf = vertices.clone().requires_grad_()
    energies = on(engine, mesh_energies, leaf, connectivity, edge_power=power)
    gradients = [torch.autograd.grad(energy, leaf, retain_graph=True)[0] for energy in energies]
    return torch.stack(energies).detach(), torch.stack(gradients)


@pytest.mark.sanitize
@pytest.mark.parametrize("power", [1, 2])
@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
def test_native_agrees_with_float64_reference(rng, power, noise):
    """Values agree to 1e-5, gradients to 1e-4 of the largest, for smooth and for crumpled meshes."""
    vertices, connectivity = bumpy_sphere(rng, 3, noise)
    values, gradients = values_and_gradients(vertices, connectivity, power)
    exact, exact_gradients = values_and_gradients(vertices.double(), connectivity, power)
    torch.testing.assert_close(values.double(), exact, rtol=1e-5, atol=0)
    for gradient, exact_gradient in zip(gradients, exact_gradients, strict=True):
        error = (gradient.double() - exact_gradient).norm(dim=1).max()
        assert float(error) <= 1e-4 * float(exact_gradient.norm(dim=1).max())


@pytest.mark.parametrize("power", [1, 2])
def test_reference_passes_gradcheck(rng, power):
    """The reference's gradients are those of finite differences, on a closed and on an open mesh."""
    vertices, connectivity = bumpy_sphere(rng, 0, 0.1)
    opened = mesh(connectivity.faces[:-3].tolist(), len(vertices))
    for who in (connectivity, opened):
        start = vertices.double().requires_grad_()
        assert torch.autograd.gradcheck(lambda v, who=who: tuple(mesh_energies(v, who, edge_power=power)), start)


def test_icosphere_has_the_known_energies(engine):
    """Level 4: mean edge 0.0755, mean squared edge 0.00572, L_n 0.00098, L_lap 0.0040."""
    vertices, faces = icosphere(4)
    connectivity = MeshTopology.from_faces(faces, len(vertices)).connectivity
    energies = on(engine, mesh_energies, vertices, connectivity)
    assert float(energies.edge) == pytest.approx(0.0755, abs=5e-5)
    assert float(energies.normal) == pytest.approx(0.00098, abs=5e-6)
    assert float(energies.laplacian) == pytest.approx(0.0040, abs=5e-5)
    squared = on(engine, mesh_energies, vertices, connectivity, edge_power=2)
    assert float(squared.edge) == pytest.approx(0.00572, abs=5e-6)


def test_radial_derivatives_of_a_sphere(engine):
    """Scaling by R multiplies L_e by R^power and L_lap by R and leaves L_n: that is what <gradient, v> must say."""
    vertices, faces = icosphere(3)
    connectivity = MeshTopology.from_faces(faces, len(vertices)).connectivity
    for power in (1, 2):
        values, gradients = values_and_gradients(vertices, connectivity, power, engine)
        radial = (gradients * vertices).sum(dim=(1, 2))
        expected = torch.stack([power * values[0], torch.zeros(()), values[2]])
        torch.testing.assert_close(radial, expected, rtol=1e-4, atol=1e-6)


def test_closed_forms_of_a_folded_square(engine):
    """Two triangles that meet at a right angle: known edges, 1 - cos 90 degrees, known Laplacian."""
    vertices = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    energies = on(engine, mesh_energies, vertices, mesh([[0, 1, 2], [1, 0, 3]], 4))
    assert float(energies.edge) == pytest.approx((3 + 2 * math.sqrt(2)) / 5, rel=1e-6)
    assert float(energies.normal) == pytest.approx(1.0, rel=1e-6)
    ends = torch.tensor([[1 / 3, 1 / 3, 1 / 3], [1.0, -1 / 3, -1 / 3], [-0.5, 1.0, 0.0], [-0.5, 0.0, 1.0]])
    assert float(energies.laplacian) == pytest.approx(float(ends.norm(dim=1).mean()), rel=1e-6)


def test_flat_mesh_has_zero_normal_energy(engine, rng):
    """Every pair of coplanar faces agrees, and the gradient is zero."""
    vertices = torch.cat([torch.rand((4, 2), generator=rng), torch.zeros(4, 1)], dim=1)
    vertices[:, :2] += torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    values, gradients = values_and_gradients(vertices, mesh([[0, 1, 2], [0, 2, 3]], 4), 1, engine)
    assert abs(float(values[1])) < 1e-6
    assert float(gradients[1].abs().max()) < 1e-5


@pytest.mark.sanitize
@pytest.mark.parametrize("power", [1, 2])
def test_degenerate_elements_give_zero_gradient(engine, power):
    """Vertices that coincide and faces without area: finite values, and no gradient from what has no direction."""
    coincident = torch.zeros(4, 3)
    values, gradients = values_and_gradients(coincident, mesh([[0, 1, 2], [1, 0, 3]], 4), power, engine)
    assert float(values.abs().max()) == 0
    assert float(gradients.abs().max()) == 0
    needle = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1e-8, 0.0], [0.3, -1.0, 0.2]])
    values, gradients = values_and_gradients(needle, mesh([[0, 1, 2], [1, 0, 3]], 4), power, engine)
    assert bool(values.isfinite().all())
    assert bool(gradients.isfinite().all())
    assert float(values[1]) == 0
    assert float(gradients[1].abs().max()) == 0


@pytest.mark.sanitize
def test_extreme_coordinates_stay_finite(engine):
    """Tiny and huge meshes: no overflow in the gradients of what is finite."""
    vertices, faces = icosphere(1)
    connectivity = MeshTopology.from_faces(faces, len(vertices)).connectivity
    for scale in (1e-15, 1e-8, 1e6, 1e12):
        values, gradients = values_and_gradients(vertices * scale, connectivity, 1, engine)
        assert bool(values.isfinite().all())
        assert bool(gradients.isfinite().all())


@pytest.mark.sanitize
def test_empty_and_unused(engine):
    """No faces and unused vertices count zero; edges, pairs or vertices may be missing."""
    for vertices, connectivity in [
        (torch.zeros(0, 3), mesh([], 0)),
        (torch.rand(3, 3), mesh([], 3)),
        (torch.rand(5, 3), mesh([[0, 1, 4]], 5)),
    ]:
        values, gradients = values_and_gradients(vertices, connectivity, 1, engine)
        assert bool(values.isfinite().all())
        assert float(values[1]) == 0
        assert bool(gradients.isfinite().all())
    assert float(gradients[:, 2:4].abs().max()) == 0


def test_an_edge_with_three_faces_counts_every_pair(engine):
    """Three half-planes at 120 degrees about one edge give three pairs; both engines agree on each."""
    angles = torch.arange(3) * (2 * math.pi / 3)
    wings = torch.stack([angles.cos(), angles.sin(), torch.full((3,), 0.5)], dim=1)
    vertices = torch.cat([torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), wings])
    energies = on(engine, mesh_energies, vertices, mesh([[0, 1, 2], [0, 1, 3], [0, 1, 4]], 5))
    assert float(energies.normal) == pytest.approx(1.5, rel=1e-6)


@pytest.mark.sanitize
def test_same_bits_for_any_number_of_threads(rng):
    """Values and gradients are gathered, and summed in a fixed order."""
    vertices, connectivity = bumpy_sphere(rng, 4, 0.01)
    before = num_threads()
    results = []
    for count in (1, 2, 5):
        set_num_threads(count)
        results.append(values_and_gradients(vertices, connectivity, 1))
    set_num_threads(before)
    for values, gradients in results[1:]:
        assert torch.equal(values, results[0][0])
        assert torch.equal(gradients, results[0][1])


def test_gradient_of_a_weighted_sum(rng):
    """One backward through a weighted sum equals the weighted sum of the gradients, also with an unused energy."""
    vertices, connectivity = bumpy_sphere(rng, 2, 0.05)
    _, gradients = values_and_gradients(vertices, connectivity, 1)
    leaf = vertices.clone().requires_grad_()
    energies = mesh_energies(leaf, connectivity)
    (1.5 * energies.edge + 0.5 * energies.laplacian).backward()
    torch.testing.assert_close(leaf.grad, 1.5 * gradients[0] + 0.5 * gradients[2])


def test_non_contiguous_vertices(rng):
    """Transposed storage gives the values of its contiguous copy."""
    vertices, connectivity = bumpy_sphere(rng, 1, 0.05)
    strided = vertices.T.contiguous().T
    assert not strided.is_contiguous()
    for energy, expected in zip(
        mesh_energies(strided, connectivity), mesh_energies(vertices, connectivity), strict=True
    ):
        assert torch.equal(energy, expected)


def test_wrong_arguments_are_named(rng):
    """Each wrong argument is a ValueError that names it."""
    vertices, connectivity = bumpy_sphere(rng, 0, 0.0)
    with pytest.raises(ValueError, match="vertices must have shape"):
        mesh_energies(vertices[:-1], connectivity)
    with pytest.raises(ValueError, match=r"vertices must be of floating-point numbers, got torch\.int32"):
        mesh_energies(vertices.int(), connectivity)
    with pytest.raises(ValueError, match=r"connectivity must be a MeshConnectivity, got MeshTopology: .*connectivity"):
        mesh_energies(vertices, MeshTopology.from_faces(connectivity.faces, len(vertices)))
    with pytest.raises(ValueError, match="edge_power"):
        mesh_energies(vertices, connectivity, edge_power=3)
    arrays = {
        name: getattr(connectivity, name)
        for name in ("edges", "face_pairs", "faces", "neighbor_offsets", "neighbor_indices")
    }
    for name, wrong in [
        ("edges", connectivity.edges + 5),
        ("faces", connectivity.faces.float()),
        ("face_pairs", connectivity.face_pairs[:, :1]),
        ("neighbor_offsets", connectivity.neighbor_offsets.flip(0)),
        ("neighbor_indices", connectivity.neighbor_indices[:-1]),
    ]:
        with pytest.raises(ValueError, match=name):
            MeshConnectivity.build(**{**arrays, name: wrong})
