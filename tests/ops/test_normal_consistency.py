"""The normal loss: its formula, its gradient, and that every engine computes the same."""

import pytest
import torch

from etsplat import _native
from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.engines.reference.losses import depth_normals
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.ops.normal_consistency import normal_consistency
from helpers.engines import on

SIZE = 40


def cameras(views: int = 1, width: int = SIZE, height: int = SIZE) -> Cameras:
    eyes = torch.tensor([[0.6, 0.4, 3.0], [-0.5, 0.8, 2.5]])[:views]
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1, 0]))
    return Cameras(viewmats, intrinsics(45, width, height).expand(views, 3, 3), width, height)


def images(rng: torch.Generator, views: int, height: int, width: int) -> tuple[torch.Tensor, ...]:
    """Normals of all lengths, a bumpy depth with holes, coverage."""
    normals = torch.randn((views, height, width, 3), generator=rng)
    depth = 2 + 0.3 * torch.rand((views, height, width, 1), generator=rng)
    depth[:, : height // 4] = 0
    return normals, depth, torch.rand((views, height, width, 1), generator=rng)


def test_depth_of_a_plane_has_its_normal():
    """Everywhere but on the border, and towards the camera."""
    camera = cameras()
    normal = torch.nn.functional.normalize(torch.tensor([0.3, 0.2, 1.0]), dim=0)
    rows = torch.arange(SIZE) + 0.5
    K, rotation = camera.Ks[0], camera.viewmats[0, :3, :3]
    rays = torch.stack(
        torch.broadcast_tensors((rows - K[0, 2]) / K[0, 0], ((rows - K[1, 2]) / K[1, 1])[:, None], torch.tensor(1.0)),
        dim=-1,
    )
    # The plane through the origin: n . (c + z R^T ray) = 0.
    depth = -(camera.centers[0] @ normal) / (rays @ rotation @ normal)
    found = depth_normals(depth[None, ..., None], camera.viewmats, camera.Ks)[0]
    torch.testing.assert_close(found[1:-1, 1:-1], normal.expand(SIZE - 2, SIZE - 2, 3), rtol=0, atol=1e-3)
    assert float(found[0].abs().max()) == 0


def test_passes_gradcheck(rng):
    """Gradients to normals and depth are those of finite differences."""
    camera = cameras(1, 5, 4).to(dtype=torch.float64)
    normals = torch.rand((1, 4, 5, 3), generator=rng, dtype=torch.float64).requires_grad_()
    depth = (2 + torch.rand((1, 4, 5, 1), generator=rng, dtype=torch.float64)).requires_grad_()
    alpha = torch.rand((1, 4, 5, 1), generator=rng, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda n, d: normal_consistency(n, d, alpha, camera.viewmats, camera.Ks), (normals, depth)
    )


def gradients(given: tuple[torch.Tensor, ...], camera: Cameras, engine: str) -> list[torch.Tensor]:
    normals, depth, alpha = given
    leaves = [tensor.clone().requires_grad_() for tensor in (normals, depth)]
    loss = on(engine, normal_consistency, *leaves, alpha, camera.viewmats, camera.Ks)
    (3 * loss).backward()
    return [loss.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]


@pytest.mark.sanitize
@pytest.mark.parametrize(("height", "width"), [(70, 45), (33, 2), (1, 9)])
def test_native_engines_agree_with_the_float64_reference(rng, cuda_device, height, width):
    """Value and gradients of two views, over several bands of rows, with holes in the depth, and where there is border
    alone."""
    given, camera = images(rng, 2, height, width), cameras(2, width, height)
    exact = gradients(tuple(tensor.double() for tensor in given), camera.to(dtype=torch.float64), "reference")
    on_cpu = gradients(given, camera, "cpu")
    on_device = gradients(tuple(tensor.to(cuda_device) for tensor in given), camera.to(cuda_device), "cuda")
    for result in (on_cpu, on_device):
        for tensor, expected in zip(result, exact, strict=True):
            scale = float(expected.abs().max())
            torch.testing.assert_close(tensor.cpu().double(), expected, rtol=2e-4, atol=2e-5 * scale + 1e-12)


def test_bits_depend_neither_on_threads_nor_on_anything_but_the_instruction_set(rng):
    """The same bits for any number of threads; other instruction sets agree to rounding."""
    given, camera, before = images(rng, 1, 100, 37), cameras(1, 37, 100), num_threads()
    results = []
    for count in (1, 3):
        set_num_threads(count)
        results.append(gradients(given, camera, "cpu"))
    set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    for name in _native.available_instruction_sets():
        _native.set_instruction_set(name)
        other = gradients(given, camera, "cpu")
        _native.set_instruction_set("")
        for a, b in zip(other, results[0], strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)
