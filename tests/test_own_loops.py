"""Loops of one's own, on any number of torch's threads."""

import torch

import etsplat
from helpers.torch_threads import on_each_count


def test_gradients_have_the_same_bits_on_any_number_of_threads() -> None:
    """Of a picture and of the energies of 81,920 faces: enough for torch to share out what it adds up."""
    vertices, faces = etsplat.icosphere(6)
    generator = torch.Generator().manual_seed(0)
    vertices = vertices + 0.01 * torch.randn(vertices.shape, generator=generator)
    mesh = etsplat.TriangleMesh.from_mesh(vertices, faces, colors=0.7, opacity=0.98, sigma=0.25)
    camera = etsplat.orbit_cameras(48, 48, elevations=(0.0,), azimuths=1)
    photo, black = torch.rand((1, 48, 48, 4), generator=generator), torch.zeros(1, 3)

    def gradients() -> dict[str, torch.Tensor]:
        for parameter in mesh.parameters().values():
            parameter.grad = None
        seen = mesh.render(camera, backgrounds=black)
        loss = etsplat.photometric_loss(seen.color, photo, 0.2, backgrounds=black)
        energies = etsplat.mesh_energies(mesh.vertices, mesh.topology.connectivity)
        (loss + energies.edge + energies.laplacian).backward()
        return {name: parameter.grad for name, parameter in mesh.parameters().items() if parameter.grad is not None}

    first, *others = on_each_count(gradients)
    assert {"vertices", "colors"} <= set(first)
    for other in others:
        assert set(other) == set(first)
        for name, gradient in other.items():
            assert gradient.equal(first[name]), name
