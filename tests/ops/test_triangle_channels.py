"""Depths and normals of triangles, and their way to pixels and back."""

import math

import pytest
import torch

import etsplat
from etsplat.core.cameras import look_at
from etsplat.engines.choice import engine_for
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.ops.pick_values import pick_values
from etsplat.ops.triangle_channels import triangle_channels
from helpers.engines import on

pytestmark = pytest.mark.sanitize


def viewmats() -> torch.Tensor:
    return look_at(torch.tensor([[0.6, 0.4, 3.0], [-2.0, 1.0, -0.5]]), torch.zeros(3), torch.tensor([0.0, 1, 0]))


def gradients(corners: torch.Tensor, views: torch.Tensor, cotangent: torch.Tensor, engine: str, **wanted: bool):
    leaves = corners.clone().requires_grad_(), views.clone().requires_grad_()
    channels = on(engine, triangle_channels, *leaves, **wanted)
    (channels * cotangent.to(channels)).sum().backward()
    return [channels.detach(), *(torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves)]


@pytest.mark.parametrize("wanted", [(True, True), (True, False), (False, True)])
def test_native_engines_agree_with_the_float64_reference(rng, cuda_device, wanted):
    """Values and gradients to corners and cameras, of triangles of sizes from 1e-3 to 10 in two views."""
    sizes = 10 ** (4 * torch.rand((1500, 1, 1), generator=rng) - 3)
    corners = torch.randn((1500, 1, 3), generator=rng) + sizes * torch.randn((1500, 3, 3), generator=rng)
    options = dict(zip(("depth", "normals"), wanted, strict=True))
    cotangent = torch.randn((2, 1500, wanted[0] + 3 * wanted[1]), generator=rng)
    exact = gradients(corners.double(), viewmats().double(), cotangent, "reference", **options)
    on_cpu = gradients(corners, viewmats(), cotangent, "cpu", **options)
    on_device = gradients(corners.to(cuda_device), viewmats().to(cuda_device), cotangent, "cuda", **options)
    for result in (on_cpu, on_device):
        for tensor, expected in zip(result, exact, strict=True):
            torch.testing.assert_close(tensor.cpu().double(), expected, rtol=1e-3, atol=2e-4)


def test_gradients_are_finite_differences(rng):
    """Of the reference, in float64."""
    corners = torch.randn((4, 3, 3), generator=rng, dtype=torch.float64).requires_grad_()
    views = viewmats().double()[:, :, :].requires_grad_()

    def depths_and_normals(c: torch.Tensor, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        both = triangle_channels(c, v, depth=True, normals=True)
        return both[..., :1], triangle_channels(c, viewmats().double(), depth=False, normals=True)

    assert torch.autograd.gradcheck(depths_and_normals, (corners, views))


def test_what_is_not_finite_or_has_no_area_is_left_out(cuda_device):
    """Zeros and zero gradients, and the other triangles and cameras have theirs."""
    corners = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]).repeat(5, 1, 1)
    corners[4] *= 3e38
    corners[4, 0] = -3e38
    corners[1, 2] = torch.tensor([2.0, 0, 0])
    corners[2, 0, 0] = math.nan
    views = viewmats()
    views[1, 0, 0] = math.inf
    for engine, device in (("reference", "cpu"), ("cpu", "cpu"), ("cuda", cuda_device)):
        cotangent = torch.ones(2, 5, 4, device=device)
        given = corners.to(device), views.to(device)
        channels, grad, _ = gradients(*given, cotangent, engine, depth=True, normals=True)
        assert bool(channels.isfinite().all())
        assert bool(grad.isfinite().all())
        assert channels[0, 1, 1:].tolist() == channels[0, 4, 1:].tolist() == [0, 0, 0]
        assert channels[0, 2].tolist() == [0, 0, 0, 0]
        assert channels[1, :, 0].tolist() == [0, 0, 0, 0, 0]
        assert float(grad[2].abs().max()) == 0
        assert float(grad[3].abs().max()) > 0


def test_picked_values_and_their_gradients(rng, cuda_device):
    """Those of the chosen triangles; gradients are the sums over pixels, one of them over a whole block."""
    values = torch.randn((2, 50), generator=rng)
    chosen = torch.randint(0, 51, (2, 23, 31), generator=rng, dtype=torch.int32)
    chosen[1, :15] = 7
    cotangent = torch.randn(chosen.shape, generator=rng)
    results = []
    for engine, device in (("reference", "cpu"), ("cpu", "cpu"), ("cuda", cuda_device)):
        dtype = torch.float64 if engine == "reference" else torch.float32
        leaf = values.to(device, dtype, copy=True).requires_grad_()
        image = on(engine, pick_values, leaf, chosen.to(device))
        (image * cotangent.to(image)).sum().backward()
        results.append([tensor.detach().cpu().double() for tensor in (image, leaf.grad) if tensor is not None])
    assert float(results[0][0][chosen == 0].abs().max()) == 0
    for result in results[1:]:
        for tensor, expected in zip(result, results[0], strict=True):
            torch.testing.assert_close(tensor, expected, rtol=1e-5, atol=1e-5)


def test_bits_do_not_depend_on_threads(rng):
    """Values and gradients."""
    corners, before = torch.randn((5000, 3, 3), generator=rng), num_threads()
    cotangent, results = torch.randn((2, 5000, 4), generator=rng), []
    for count in (1, 3):
        set_num_threads(count)
        results.append(gradients(corners, viewmats(), cotangent, "cpu", depth=True, normals=True))
    set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("odd", [-1, 1, 2**40, None, "yes"])
@pytest.mark.parametrize("name", ["depth", "normals"])
def test_flags_that_are_no_bool_are_refused_by_name(name, odd):
    with pytest.raises(ValueError, match=f"{name} must be True or False, got"):
        triangle_channels(torch.rand(5, 3, 3), viewmats(), **{"depth": True, "normals": True, name: odd})


@pytest.mark.parametrize("odd", [-1, 10, 2**31 - 1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numbers_of_triangles_out_of_range_are_refused(odd, dtype):
    """In every engine on the CPU."""
    chosen = torch.zeros(2, 5, 4, dtype=torch.int32)
    chosen[1, 2, 3] = odd
    with pytest.raises(ValueError, match="chosen must be indices from 0 to 9, got indices from"):
        pick_values(torch.rand(2, 9, dtype=dtype), chosen)


def test_kernels_show_nothing_where_the_number_is_out_of_range(cuda_device):
    """There it is not asked for before: 0, and no gradient."""
    values = torch.rand(2, 9, device=cuda_device).requires_grad_()
    chosen = torch.tensor([[[-5, 0, 9]], [[1, 10, 2**31 - 1]]], dtype=torch.int32, device=cuda_device)
    with etsplat.engine("cuda"):
        image = engine_for(values).pick_values(values, chosen)
    image.sum().backward()
    expected, gradient = torch.zeros(2, 1, 3), torch.zeros(2, 9)
    expected[0, 0, 2], expected[1, 0, 0] = values[0, 8].item(), values[1, 0].item()
    gradient[0, 8] = gradient[1, 0] = 1
    assert torch.equal(image.detach().cpu(), expected)
    assert values.grad is not None
    assert torch.equal(values.grad.cpu(), gradient)
