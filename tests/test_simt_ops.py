"""The GPU engine's operations, run by the shim: values and gradients against the other engines."""

import pytest
import torch

from etsplat.core.cameras import intrinsics, look_at
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.ops.adam import Adam
from etsplat.ops.antialias import rasterize_antialiased
from etsplat.ops.mesh_energies import mesh_energies
from etsplat.ops.photometric import l1_over_background
from etsplat.ops.rasterize_hard import rasterize_hard, render_opaque
from etsplat.ops.soup_colors import soup_colors
from etsplat.ops.spherical_harmonics import spherical_harmonics
from etsplat.ops.ssim import photometric_loss
from simt.build import Simt

pytestmark = pytest.mark.sanitize


def same_bits(actual: torch.Tensor | tuple[torch.Tensor, ...], expected: torch.Tensor | tuple[torch.Tensor, ...]):
    torch.testing.assert_close(actual, expected, rtol=0, atol=0)


@pytest.mark.parametrize("power", [1, 2])
def test_mesh_energies_are_those_of_the_cpu_engine(simt: Simt, rng, power):
    """On a crumpled open mesh of several blocks the gradients are the same bits, the values to rounding."""
    vertices, faces = icosphere(3)
    vertices = vertices + 0.05 * torch.randn(vertices.shape, generator=rng)
    connectivity = MeshTopology.from_faces(faces[5:], len(vertices)).connectivity
    results = []
    for engine in ("cuda", "cpu"):
        leaf = vertices.clone().requires_grad_()
        energies = mesh_energies(leaf, connectivity, edge_power=power, engine=engine)
        (1.5 * energies.edge + 0.25 * energies.normal + 0.5 * energies.laplacian).backward()
        results.append((torch.stack(energies).detach(), leaf.grad))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=1e-6, atol=0)
    same_bits(results[0][1], results[1][1])
    assert simt.launches == ["mesh_elements", "mesh_pairs", "mesh_gather", "mesh_combine"]


def test_l1_is_that_of_the_cpu_engine(simt: Simt, rng):
    """Two views whose pixels do not fill the last block; the gradient is scaled by what comes from above."""
    color = torch.rand((2, 37, 41, 3), generator=rng)
    target, backgrounds = torch.rand((2, 37, 41, 4), generator=rng), torch.rand((2, 3), generator=rng)
    color[0, 0] = target[0, 0, :, :3] + (1 - target[0, 0, :, 3:]) * backgrounds[0]  # no difference, no gradient
    results = []
    for engine in ("cuda", "cpu"):
        leaf = color.clone().requires_grad_()
        loss = l1_over_background(leaf, target, backgrounds, engine=engine)
        (4 * loss).backward()
        results.append((loss.detach(), leaf.grad))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=1e-6, atol=0)
    same_bits(results[0][1], results[1][1])


@pytest.mark.parametrize(
    ("channels", "as_bytes", "masked", "pixel", "weight"),
    [
        (3, True, False, "l1", 0.2),
        (4, False, True, "l1", 0.3),
        (4, True, True, "l2", 1.0),
        (3, False, False, "l2", 0.0),
    ],
)
def test_ssim_is_that_of_the_cpu_engine(simt: Simt, rng, channels, as_bytes, masked, pixel, weight):
    """Bytes and floats, with and without alpha and mask, absolute and squared, over tiles cut by the border."""
    color, target = torch.rand((2, 21, 35, 3), generator=rng), torch.rand((2, 21, 35, channels), generator=rng)
    target = (255 * target).to(torch.uint8) if as_bytes else target
    mask = torch.rand((2, 21, 35), generator=rng) if masked else None
    backgrounds = torch.rand((2, 3), generator=rng) if channels == 4 else None
    results = []
    for engine in ("cuda", "cpu"):
        leaf = color.clone().requires_grad_()
        loss = photometric_loss(leaf, target, weight, mask, backgrounds=backgrounds, pixel=pixel, engine=engine)
        (0.5 * loss).backward()
        results.append((loss.detach(), leaf.grad))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=1e-6, atol=0)
    torch.testing.assert_close(results[0][1], results[1][1], rtol=1e-5, atol=1e-9)


def test_adam_takes_the_steps_of_the_cpu_engine(simt: Simt, rng):
    """Ten parameters, one empty, one not contiguous, rates that change: the same bits after five steps."""
    shapes = [(1200, 3), (), (0, 3), (7,), (1024,), (2, 2), (3,), (5, 1), (1025,), (40, 30)]
    start = {f"p{i}": torch.randn(shape, generator=rng) for i, shape in enumerate(shapes)}
    start["p9"] = start["p9"].T
    gradients = [{name: torch.randn(p.shape, generator=rng) for name, p in start.items()} for _ in range(5)]
    ends = []
    for engine in ("cuda", "cpu"):
        parameters = {name: p.clone().requires_grad_() for name, p in start.items()}
        adam = Adam(parameters, {name: 0.01 * (i + 1) for i, name in enumerate(start)}, engine=engine)
        for step in gradients:
            for name, p in parameters.items():
                p.grad = step[name]
            adam.learning_rates["p0"] *= 0.5
            adam.step()
        ends.append([*parameters.values(), *adam.first_moments.values(), *adam.second_moments.values()])
    for on_device, on_cpu in zip(*ends, strict=True):
        same_bits(on_device.detach(), on_cpu.detach())
    assert simt.launches == ["adam_step"] * 10


def test_a_halted_adam_changes_nothing(simt: Simt):
    """With the flag set, parameters and moments stay; without, they move."""
    parameter = torch.ones(10, requires_grad=True)
    adam = Adam({"p": parameter}, {"p": 0.1}, engine="cuda")
    parameter.grad = torch.ones(10)
    rates, halted = torch.tensor([0.1, 1.0]), torch.ones((), dtype=torch.int32)
    adam.step_on_device(rates, halted)
    assert bool((parameter == 1).all())
    assert not adam.second_moments["p"].any()
    adam.step_on_device(rates, halted.zero_())
    assert bool((parameter < 1).all())


@pytest.mark.parametrize(("degree", "channels", "bases"), [(0, 3, 1), (1, 3, 16), (2, 5, 9), (3, 3, 16), (3, 4, 16)])
def test_spherical_harmonics_are_those_of_the_cpu_engine(simt: Simt, rng, degree, channels, bases):
    """Through shared memory (up to 48 numbers a point) and without, two views, one direction of no length."""
    coefficients = torch.randn((150, bases, channels), generator=rng)
    directions = torch.randn((2, 150, 3), generator=rng)
    directions[1, 70] = 0
    cotangent = torch.randn((2, 150, channels), generator=rng)
    results = []
    for engine in ("cuda", "cpu"):
        leaves = coefficients.clone().requires_grad_(), directions.clone().requires_grad_()
        colors = spherical_harmonics(*leaves, degree, engine=engine)
        results.append((colors.detach(), *torch.autograd.grad(colors, leaves, cotangent)))
    for on_device, on_cpu in zip(*results, strict=True):
        torch.testing.assert_close(on_device, on_cpu, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_soup_colors_are_those_of_the_cpu_engine(simt: Simt, rng, degree):
    """Colours and gradients, with a whole block of triangles that no view sees, and more bases than any degree has."""
    shapes = (150, 3, 3), (150, 1, 3), (150, 17, 3)
    inputs = [torch.randn(shape, generator=rng) for shape in shapes]
    centers, cotangent = torch.randn((2, 3), generator=rng), torch.randn((2, 150, 3), generator=rng)
    cotangent[:, :64] = 0
    results = []
    for engine in ("cuda", "cpu"):
        leaves = [tensor.clone().requires_grad_() for tensor in inputs]
        colors = soup_colors(*leaves, centers, degree, engine=engine)
        results.append((colors.detach(), *torch.autograd.grad(colors, leaves, cotangent)))
    for on_device, on_cpu in zip(*results, strict=True):
        torch.testing.assert_close(on_device, on_cpu, rtol=1e-5, atol=1e-6)


def hard_scene(rng: torch.Generator) -> dict[str, torch.Tensor]:
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


def test_hard_rasterization_is_that_of_the_cpu_engine(simt: Simt, rng, monkeypatch):
    """Triangles, barycentrics and depths are the same bits, whatever the height of a strip."""
    scene = hard_scene(rng)
    expected = rasterize_hard(width=45, height=37, engine="cpu", **scene)
    for samples in (1 << 21, 45 * 10):
        monkeypatch.setattr("etsplat.ops._rasterize_hard_cuda._STRIP_SAMPLES", samples)
        on_device = rasterize_hard(width=45, height=37, engine="cuda", **scene)
        for name, image in vars(expected).items():
            same_bits(getattr(on_device, name), image)
    assert int(expected.triangle.max()) >= 320  # some of the soup is in front


@pytest.mark.parametrize(("colors", "channels", "cull"), [("face_colors", 3, False), ("vertex_colors", 5, True)])
def test_opaque_pictures_are_those_of_the_cpu_engine(simt: Simt, rng, monkeypatch, colors, channels, cull):
    """Nine samples a pixel, drawn in several strips, both ways to colour: the same bits."""
    monkeypatch.setattr("etsplat.ops._rasterize_hard_cuda._STRIP_SAMPLES", 135 * 40)
    scene = hard_scene(rng)
    count = len(scene["faces"] if colors == "face_colors" else scene["vertices"])
    scene[colors] = torch.rand((count, channels), generator=rng)
    options = {"width": 45, "height": 37, "supersampling": 3, "cull_backfaces": cull}
    same_bits(render_opaque(engine="cuda", **options, **scene), render_opaque(engine="cpu", **options, **scene))
    assert simt.launches.count("hard_draw") == 6


@pytest.mark.parametrize("kind", ["face_colors", "vertex_colors"])
def test_antialiased_pictures_are_those_of_the_cpu_engine(simt: Simt, rng, kind):
    """A folded mesh in two views: the same picture to the bit, gradients by vertices, colours and backgrounds to
    rounding, and these the same bits in whatever order the threads run."""
    vertices, faces = icosphere(2)
    vertices = vertices * (1 + 0.35 * torch.sin(5 * vertices[:, :1]) * torch.cos(4 * vertices[:, 1:2]))
    connectivity = MeshTopology.from_faces(faces, len(vertices)).connectivity
    scene = hard_scene(rng)
    colors = torch.rand((len(faces) if kind == "face_colors" else len(vertices), 3), generator=rng)
    backgrounds, cotangent = torch.rand((2, 3), generator=rng), torch.randn((2, 37, 45, 3), generator=rng)
    results = []
    for engine, seed in (("cuda", 0), ("cpu", 0), ("cuda", 5)):
        simt.order_seed = seed
        leaves = [tensor.clone().requires_grad_() for tensor in (vertices, colors, backgrounds)]
        cameras = (scene["viewmats"], scene["Ks"], 45, 37)
        shown = {kind: leaves[1], "backgrounds": leaves[2], "engine": engine}
        image = rasterize_antialiased(leaves[0], connectivity, *cameras, **shown)
        results.append((image.detach(), *torch.autograd.grad(image, leaves, cotangent)))
    same_bits(results[0], results[2])
    same_bits(results[0][0], results[1][0])
    for on_device, on_cpu in zip(results[0][1:], results[1][1:], strict=True):
        torch.testing.assert_close(on_device, on_cpu, rtol=1e-4, atol=1e-5 * float(on_cpu.abs().max()))
