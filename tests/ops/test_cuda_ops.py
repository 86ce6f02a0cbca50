"""Operations of the GPU engine against the CPU engine, by the shim and, where there is one, on a GPU."""

from contextlib import nullcontext

import pytest
import torch

import etsplat
from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.ops.adam import Adam
from etsplat.ops.antialias import rasterize_antialiased
from etsplat.ops.mesh_energies import mesh_energies
from etsplat.ops.photometric import photometric_loss
from etsplat.ops.rasterize_opaque import rasterize_opaque, render_opaque
from etsplat.ops.soup_colors import EndAtColors, soup_colors
from etsplat.ops.spherical_harmonics import spherical_harmonics
from etsplat.ops.weighted_sum import Term, weighted_sum
from helpers.engines import on
from helpers.simt.build import Simt

pytestmark = pytest.mark.sanitize


CPU = torch.device("cpu")


def same_bits(actual: torch.Tensor | tuple[torch.Tensor, ...], expected: torch.Tensor | tuple[torch.Tensor, ...]):
    torch.testing.assert_close(actual, expected, rtol=0, atol=0, check_device=False)


def on_cpu(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return tuple(tensor.cpu() for tensor in tensors)


@pytest.mark.parametrize("power", [1, 2])
def test_mesh_energies_are_those_of_the_cpu_engine(cuda_device, rng, power):
    """On a crumpled open mesh of several blocks the gradients are the same bits, the values to rounding."""
    vertices, faces = icosphere(3)
    vertices = vertices + 0.05 * torch.randn(vertices.shape, generator=rng)
    results = []
    for engine, device in (("cuda", cuda_device), ("cpu", CPU)):
        connectivity = MeshTopology.from_faces(faces[5:].to(device), len(vertices)).connectivity
        leaf = vertices.to(device, copy=True).requires_grad_()
        energies = on(engine, mesh_energies, leaf, connectivity, edge_power=power)
        (1.5 * energies.edge + 0.25 * energies.normal + 0.5 * energies.laplacian).backward()
        results.append((torch.stack(energies).detach().cpu(), leaf.grad))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=1e-6, atol=0)
    same_bits(results[0][1], results[1][1])


def test_l1_is_that_of_the_cpu_engine(cuda_device, rng):
    """Two views whose pixels do not fill the last block; the gradient is scaled by what comes from above."""
    color = torch.rand((2, 37, 41, 3), generator=rng)
    target, backgrounds = torch.rand((2, 37, 41, 4), generator=rng), torch.rand((2, 3), generator=rng)
    color[0, 0] = target[0, 0, :, :3] + (1 - target[0, 0, :, 3:]) * backgrounds[0]  # no difference, no gradient
    results = []
    for engine, device in (("cuda", cuda_device), ("cpu", CPU)):
        leaf = color.to(device, copy=True).requires_grad_()
        loss = on(engine, photometric_loss, leaf, target.to(device), 0.0, backgrounds=backgrounds.to(device))
        (4 * loss).backward()
        results.append((loss.detach().cpu(), leaf.grad.cpu()))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=1e-6, atol=0)
    same_bits(results[0][1], results[1][1])


@pytest.mark.parametrize("scale", [0.3, "tensor"])
@pytest.mark.parametrize("rounds", [1, 5])
def test_weighted_sum_is_that_of_pytorch(cuda_device, scale, rounds):
    """Value and gradients of all powers, with a scale as a number and in device memory; more than a launch takes."""
    results = []
    values, powers = (2.0, *(0.7, 1.4, 0.2) * rounds), (1, -1, -2) * rounds
    for engine, device in (("cuda", cuda_device), ("cpu", CPU)):
        leaves = [torch.tensor(value, device=device, requires_grad=True) for value in values]
        terms = [Term(0.5 + power, leaf, power) for leaf, power in zip(leaves[1:], powers, strict=True)]
        factor = torch.tensor(0.3, device=device) if scale == "tensor" else scale
        total = on(engine, weighted_sum, leaves[0], terms, factor)
        (3 * total).backward()
        results.append(torch.stack(on_cpu(total.detach(), *(leaf.grad for leaf in leaves))))
    torch.testing.assert_close(results[0], results[1], rtol=1e-6, atol=0)


def test_adam_takes_the_steps_of_the_cpu_engine(cuda_device, rng):
    """Ten parameters, one empty, one not contiguous, two with paces, three that decay, in both launches; rates that
    change: equal after five steps."""
    shapes = [(1200, 3), (), (0, 3), (7,), (1024,), (2, 2), (3,), (5, 1), (1025,), (40, 30)]
    start = {f"p{i}": torch.randn(shape, generator=rng) for i, shape in enumerate(shapes)}
    start["p9"] = start["p9"].T
    gradients = [{name: torch.randn(p.shape, generator=rng) for name, p in start.items()} for _ in range(5)]
    ends = []
    for engine, device in (("cuda", cuda_device), ("cpu", CPU)):
        parameters = {name: p.to(device, copy=True).requires_grad_() for name, p in start.items()}
        adam = Adam(parameters, {name: 0.01 * (i + 1) for i, name in enumerate(start)})
        adam.paces = {name: torch.linspace(0.1, 9.0, len(parameters[name])).to(device) for name in ("p0", "p9")}
        for step in gradients:
            for name, p in parameters.items():
                p.grad = step[name].to(device)
            adam.learning_rates["p0"] *= 0.5
            on(engine, adam.step, {"p0": 0.3, "p4": 1.7, "p9": 0.7})
        ends.append([*parameters.values(), *adam.first_moments.values(), *adam.second_moments.values()])
    for actual, expected in zip(*ends, strict=True):
        same_bits(actual.detach(), expected.detach())


def test_a_halted_adam_changes_nothing(cuda_device):
    """With the flag set, parameters and moments stay; without, they move, as the decay wants."""
    parameter = torch.ones(10, requires_grad=True, device=cuda_device)
    adam = Adam({"p": parameter}, {"p": 0.1})
    parameter.grad = torch.ones_like(parameter)
    rates = torch.tensor([0.1, 1.0], device=cuda_device)
    halted = torch.ones((), dtype=torch.int32, device=cuda_device)
    with etsplat.engine("cuda"):
        decays = torch.tensor([-3.0], device=cuda_device)
        adam.step_on_device(rates, halted, decays)
        assert bool((parameter == 1).all())
        assert not adam.second_moments["p"].any()
        adam.step_on_device(rates, halted.zero_(), decays)
        assert bool((parameter > 1).all())
        adam.step_on_device(rates, halted)
        torch.testing.assert_close(adam.first_moments["p"], torch.full_like(parameter, -0.9 * 0.2 + 0.1))


@pytest.mark.parametrize(("degree", "bases"), [(0, 0), (0, 15), (1, 3), (2, 15), (3, 15), (3, 20)])
@pytest.mark.parametrize("decays", [True, False])
def test_a_step_of_coefficients_is_that_of_their_gradient(cuda_device, rng, degree, bases, decays):
    """The same bits where gradients end at colours. Halted, nothing changes."""
    found, expected = (steps_of_colors(cuda_device, rng, degree, bases, ends, decays) for ends in (True, False))
    assert found[0] == [False] * 4  # coefficients have no gradient
    same_bits(found[1], expected[1])
    same_bits(found[2], expected[1])


@pytest.mark.parametrize("case", ["gradient", "paces", "strides"])
def test_coefficients_that_cannot_be_stepped_with_their_gradient_are_stepped_after_it(cuda_device, rng, case):
    """Another term gives them one, they have paces, or they do not lie in order: the same bits as always."""
    found, expected = (steps_of_colors(cuda_device, rng, 2, 8, ends, True, case) for ends in (True, False))
    assert found[0] == [True] * 4
    same_bits(found[1], expected[1])


def steps_of_colors(device, rng, degree, bases, ends, decays, case=""):
    """Four steps of two views that see two of three blocks, the last halted: whether coefficients had a gradient at the
    end of each; parameters and moments after the third, and after the fourth."""
    rng.manual_seed(3)
    start = {"vertices": torch.randn((150, 3, 3), generator=rng), "dc": torch.randn((150, 1, 3), generator=rng)}
    start["rest"] = 0.3 * torch.randn((150, bases, 3), generator=rng)
    centers, cotangents = 4 * torch.randn((2, 3), generator=rng), torch.randn((3, 2, 150, 3), generator=rng)
    cotangents[:, :, 64:128] = 0
    numbers = torch.tensor([0.1, 0.2, 0.3, 0.7, 0.0, 0.2, 1.3], device=device)
    parameters = {name: tensor.to(device, copy=True) for name, tensor in start.items()}
    if case == "strides":
        parameters["rest"] = parameters["rest"].transpose(1, 2).contiguous().transpose(1, 2)
    adam = Adam({name: tensor.requires_grad_() for name, tensor in parameters.items()}, dict.fromkeys(start, 0.1))
    if case == "paces":
        adam.paces = {"rest": torch.linspace(0.1, 9.0, 150).to(device)}
    had, states, halted = [], [], torch.zeros((), dtype=torch.int32, device=device)
    for step in range(4):
        adam.zero_grad()
        with etsplat.engine("cuda"):
            with EndAtColors(*parameters.values()) if ends else nullcontext() as ending:
                colors = soup_colors(*parameters.values(), centers.to(device), degree)
            loss = (colors * cotangents[step % 3].to(device)).sum()
            (loss + parameters["rest"].square().sum() if case == "gradient" else loss).backward()
            adam.step_on_device(numbers[:4], halted.fill_(step == 3), numbers[4:] if decays else None, ending)
        had.append(parameters["rest"].grad is not None)
        state = [*parameters.values(), *adam.first_moments.values(), *adam.second_moments.values()]
        states.append(torch.cat([tensor.detach().cpu().flatten() for tensor in state]))
    return had, *states[2:]


@pytest.mark.parametrize(("degree", "channels", "bases"), [(0, 3, 1), (1, 3, 16), (2, 5, 9), (3, 3, 16), (3, 4, 16)])
def test_spherical_harmonics_are_those_of_the_cpu_engine(cuda_device, rng, degree, channels, bases):
    """Through shared memory (up to 48 numbers a point) and without, two views, one direction of no length."""
    coefficients = torch.randn((150, bases, channels), generator=rng)
    directions = torch.randn((2, 150, 3), generator=rng)
    directions[1, 70] = 0
    cotangent = torch.randn((2, 150, channels), generator=rng)
    results = []
    for engine, device in (("cuda", cuda_device), ("cpu", CPU)):
        leaves = [tensor.to(device, copy=True).requires_grad_() for tensor in (coefficients, directions)]
        colors = on(engine, spherical_harmonics, *leaves, degree)
        results.append(on_cpu(colors.detach(), *torch.autograd.grad(colors, leaves, cotangent)))
    for actual, expected in zip(*results, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-6)


def moved(scene: dict[str, torch.Tensor], device: torch.device) -> dict[str, torch.Tensor]:
    return {name: tensor.to(device) for name, tensor in scene.items()}


def opaque_scene(rng: torch.Generator) -> dict[str, torch.Tensor]:
    """Two views of a sphere of small triangles within a soup of large ones, some of them behind the camera."""
    vertices, faces = icosphere(2)
    soup = 2 * torch.randn((40, 3), generator=rng)
    eyes = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.3, 3.0]])
    return {
        "vertices": torch.cat([vertices, soup]),
        "faces": torch.cat([faces, len(vertices) + torch.arange(39).view(-1, 3)]),
        "viewmats": look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])).float(),
        "Ks": intrinsics(40.0, 45, 37).float().expand(2, 3, 3),
    }


def test_opaque_rasterization_is_that_of_the_cpu_engine(cuda_device, rng, monkeypatch):
    """Triangles, barycentrics and depths are the same bits, whatever the height of a strip."""
    scene = opaque_scene(rng)
    expected = on("cpu", rasterize_opaque, width=45, height=37, **scene)
    for samples in (1 << 21, 45 * 10):
        monkeypatch.setattr("etsplat.engines.cuda.rasterize_opaque._STRIP_SAMPLES", samples)
        actual = on("cuda", rasterize_opaque, width=45, height=37, **moved(scene, cuda_device))
        for name in ("triangle", "barycentrics", "depth", "alpha"):
            same_bits(getattr(actual, name), getattr(expected, name))
    assert int(expected.triangle.max()) >= 320  # some of the soup is in front


@pytest.mark.parametrize(("colors", "channels", "cull"), [("face_colors", 3, False), ("vertex_colors", 5, True)])
def test_opaque_pictures_are_those_of_the_cpu_engine(cuda_device, rng, monkeypatch, colors, channels, cull):
    """Nine samples a pixel, drawn in several strips, both ways to colour: the same bits."""
    monkeypatch.setattr("etsplat.engines.cuda.rasterize_opaque._STRIP_SAMPLES", 135 * 40)
    scene = opaque_scene(rng)
    count = len(scene["faces"] if colors == "face_colors" else scene["vertices"])
    scene[colors] = torch.rand((count, channels), generator=rng)
    options = {"width": 45, "height": 37, "supersampling": 3, "cull_backfaces": cull}
    actual = on("cuda", render_opaque, **options, **moved(scene, cuda_device))
    same_bits(actual.rgba, on("cpu", render_opaque, **options, **scene).rgba)


def antialiased(kind: str, rng: torch.Generator, engine: str, device: torch.device) -> tuple[torch.Tensor, ...]:
    """Picture of a folded mesh in two views, and its gradients by vertices, colours and backgrounds."""
    vertices, faces = icosphere(2)
    vertices = vertices * (1 + 0.35 * torch.sin(5 * vertices[:, :1]) * torch.cos(4 * vertices[:, 1:2]))
    connectivity = MeshTopology.from_faces(faces.to(device), len(vertices)).connectivity
    scene = moved(opaque_scene(rng), device)
    colors = torch.rand((len(faces) if kind == "face_colors" else len(vertices), 3), generator=rng)
    backgrounds, cotangent = torch.rand((2, 3), generator=rng), torch.randn((2, 37, 45, 3), generator=rng)
    leaves = [tensor.to(device, copy=True).requires_grad_() for tensor in (vertices, colors, backgrounds)]
    shown = {kind: leaves[1], "backgrounds": leaves[2]}
    image = on(
        engine,
        rasterize_antialiased,
        leaves[0],
        connectivity=connectivity,
        cameras=Cameras(scene["viewmats"], scene["Ks"], 45, 37),
        **shown,
    ).color
    return on_cpu(image.detach(), *torch.autograd.grad(image, leaves, cotangent))


@pytest.mark.parametrize("kind", ["face_colors", "vertex_colors"])
def test_antialiased_pictures_are_those_of_the_cpu_engine(cuda_device, rng, kind):
    """The same picture to the bit, gradients to rounding."""
    actual = antialiased(kind, rng, "cuda", cuda_device)
    expected = antialiased(kind, rng.manual_seed(20261121), "cpu", CPU)
    same_bits(actual[0], expected[0])
    for gradient, exact in zip(actual[1:], expected[1:], strict=True):
        torch.testing.assert_close(gradient, exact, rtol=1e-4, atol=1e-5 * float(exact.abs().max()))


def test_scattered_gradients_do_not_depend_on_the_order_of_threads(simt: Simt, rng):
    """Fixed-point sums are the same bits in whatever order their terms come."""
    results = []
    for simt.order_seed in (0, 5):
        results.append(antialiased("vertex_colors", rng.manual_seed(1), "cuda", CPU))
    same_bits(*results)
