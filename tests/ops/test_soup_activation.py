"""What is computed of every triangle of a soup in every step, besides its colour."""

from itertools import pairwise

import pytest
import torch

import etsplat
from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.core.rasterization import TriangleStatistics
from etsplat.core.soup_numbers import SoupNumbers
from etsplat.ops.soup_activation import soup_activation
from etsplat.optim.densification import SoupStatistics
from helpers.engines import on

pytestmark = pytest.mark.sanitize

N = 700


def camera() -> Cameras:
    viewmats = look_at(torch.tensor([[0.3, 0.2, 3.0]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return Cameras(viewmats, intrinsics(40.0, 64, 48)[None], 64, 48)


def soup(rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Triangles of all sizes, some of them behind the camera, and parameters of all sizes."""
    middles, sizes = 2 * torch.randn((N, 1, 3), generator=rng), 0.2 * torch.rand((N, 1, 1), generator=rng)
    vertices = middles + sizes * torch.randn((N, 3, 3), generator=rng)
    return vertices, 3 * torch.randn(N, generator=rng), torch.randn(N, generator=rng) - 1


@pytest.mark.parametrize("numbers", [SoupNumbers(), SoupNumbers(0.6, 0.4), SoupNumbers(dropout=0.3, draw=2.0**24 - 1)])
@pytest.mark.parametrize("culling", [True, False])
def test_native_engines_agree_with_the_float64_reference(rng, cuda_device, numbers, culling):
    """Values and gradients; the engines leave out the same triangles, by size and by chance."""
    vertices, logits, raw = soup(rng)
    cotangents = torch.randn((2, N), generator=rng)
    results = []
    for engine, device in (("reference", "cpu"), ("cpu", "cpu"), ("cuda", cuda_device)):
        dtype = torch.float64 if engine == "reference" else torch.float32
        leaves = [tensor.to(device, dtype, copy=True).requires_grad_() for tensor in (logits, raw)]
        given = torch.tensor(numbers, device=device) if engine == "cuda" else numbers
        seen = camera().to(torch.device(device), dtype=dtype) if culling else None
        sizes = {"smallest": 1.0, "largest": 20.0}
        drawn = torch.stack(on(engine, soup_activation, vertices.to(device, dtype), *leaves, given, seen, **sizes))
        (drawn * cotangents.to(drawn)).sum().backward()
        results.append([tensor.detach().cpu().double() for tensor in (drawn, *(leaf.grad for leaf in leaves))])
    exact, on_cpu, on_device = results
    left_out = (exact[0][0] == 0).float().mean()
    assert left_out > 0.2 if culling else left_out == pytest.approx(numbers.dropout, abs=0.05)
    for result in (on_cpu, on_device):
        for tensor, expected in zip(result, exact, strict=True):
            torch.testing.assert_close(tensor, expected, rtol=2e-6, atol=1e-6)


def test_triangles_are_left_out_by_their_size():
    """On the axis at depth 3: in pixels, legs of f s / 3, an inradius of 0.29 and a reach of 0.75 legs."""
    legs = torch.tensor([0.01, 0.2, 1.0, 2.0])
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    front = Cameras(torch.eye(4)[None], camera().Ks, 64, 48)
    vertices = legs[:, None, None] * corners + torch.tensor([0.0, 0, 3])
    pixels = float(camera().Ks[0, 0, 0]) / 3 * legs
    for engine in ("cpu", "reference"):
        drawn, _ = on(
            engine,
            soup_activation,
            vertices,
            torch.zeros(4),
            torch.zeros(4),
            SoupNumbers(sigma_ceiling=1.0),
            front,
            smallest=1.0,
            largest=20.0,
        )
        assert (drawn > 0).tolist() == ((0.2929 * pixels > 1) & (0.7454 * pixels < 20)).tolist()
    assert (drawn > 0).tolist() == [False, True, True, False]


def test_each_draw_leaves_out_others():
    """The share that is asked for, of any draw; two have in common what chance gives them, and a row keeps its lot."""
    count, share = 20_000, 0.1
    none = torch.zeros(count)
    kept = [
        soup_activation(torch.zeros(count, 3, 3), none, none, SoupNumbers(dropout=share, draw=draw))[0] > 0
        for draw in (0.0, 1.0, 2.0, 12_345.0)
    ]
    for one in kept:
        assert float((~one).float().mean()) == pytest.approx(share, abs=0.01)
    for one, other in pairwise(kept):
        assert float((~one & ~other).float().mean()) == pytest.approx(share**2, abs=0.003)
    fewer = soup_activation(torch.zeros(50, 3, 3), none[:50], none[:50], SoupNumbers(dropout=share, draw=2.0))[0] > 0
    assert torch.equal(fewer, kept[2][:50])


def test_gradients_are_finite_differences(rng):
    """Of the reference, in float64, away from the ceiling."""
    vertices, logits, raw = (tensor[:20].double() for tensor in soup(rng))
    leaves = logits.requires_grad_(), raw.requires_grad_()
    seen = camera().to(dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda *p: soup_activation(vertices, *p, SoupNumbers(0.3, 0.45, 0.2, 5.0), seen, smallest=1.0), leaves
    )


def random_view(rng: torch.Generator) -> TriangleStatistics:
    weight, size = torch.rand((1, N), generator=rng), 30 * torch.rand((1, N), generator=rng)
    return TriangleStatistics(weight, size, 2 * torch.rand((1, N), generator=rng), weight > 0)


def test_statistics_on_a_device_are_those_of_pytorch(rng, cuda_device):
    """The same bits over epochs of three views, with some triangles born in between, and nothing where halted."""
    expected, on_device = (SoupStatistics.zeros(N, device) for device in ("cpu", cuda_device))
    going, halted = (torch.tensor(value, dtype=torch.int32, device=cuda_device) for value in (0, 1))
    for step in range(8):
        view, starts = random_view(rng), step % 3 == 0
        moved = TriangleStatistics(*(tensor.to(cuda_device) for tensor in vars(view).values()))
        flag = torch.tensor([float(starts)], device=cuda_device)
        expected.update(view, 3, epoch_starts=starts)
        more = TriangleStatistics(*(t + 5 for t in vars(moved).values()))
        with etsplat.engine("cuda"):
            on_device.update_on_device(moved, 3, flag, going)
            on_device.update_on_device(more, 3, flag, halted)
        if step == 4:
            born = torch.arange(N) % 5 == 0
            for statistics in (expected, on_device):
                statistics.restart(born.to(statistics.seen.device))
    assert 0 < int(expected.seen.max()) <= 3
    for name, tensor in expected.tensors().items():
        assert torch.equal(on_device.tensors()[name].cpu(), tensor), name
