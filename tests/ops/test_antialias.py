"""The antialiased z-buffer rasterizer: values, gradients, determinism."""

import math

import pytest
import torch
from torch import Tensor

from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.ops.antialias import rasterize_antialiased
from etsplat.ops.antialias_nvdiffrast import rasterize_nvdiffrast
from etsplat.ops.mesh_energies import MeshConnectivity
from etsplat.ops.rasterize_opaque import render_opaque
from helpers.engines import on
from helpers.meshes import TETRAHEDRON, bumpy_sphere
from helpers.tolerances import assert_close_to_scale

FLAT = torch.eye(4)[None], torch.eye(3)[None]
"""Projects (x, y, 1) to the pixel position (x, y)."""


def connect(faces: Tensor, vertices: Tensor) -> MeshConnectivity:
    return MeshTopology.from_faces(faces, len(vertices)).connectivity


def views(width: int, height: int) -> tuple[Tensor, Tensor]:
    eyes = torch.tensor([[1.0, 2.0, 3.0], [-2.0, 0.3, 2.5]])
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])).float()
    return viewmats, intrinsics(40.0, width, height).float().expand(2, 3, 3)


def dented(rng: torch.Generator, level: int = 2) -> tuple[Tensor, Tensor]:
    """A closed mesh with folds: silhouettes also inside its outline."""
    vertices, faces = icosphere(level)
    return vertices * (1 + 0.35 * torch.sin(5 * vertices[:, :1]) * torch.cos(4 * vertices[:, 1:2])), faces


def colors_of(kind: str, vertices: Tensor, faces: Tensor, rng: torch.Generator) -> Tensor:
    return torch.rand(len(faces) if kind == "face_colors" else len(vertices), 3, generator=rng)


KINDS = pytest.mark.parametrize("kind", ["face_colors", "vertex_colors"])


@pytest.mark.sanitize
@KINDS
def test_native_agrees_with_the_reference(kind, rng):
    """Image and gradients of a folded mesh in two views equal those of the float64 reference."""
    vertices, faces = dented(rng)
    connectivity, colors = connect(faces, vertices), colors_of(kind, vertices, faces, rng)
    backgrounds, cotangent = torch.rand(2, 3, generator=rng), torch.randn(2, 31, 45, 3, generator=rng)
    results = []
    for dtype in (torch.float32, torch.float64):
        leaves = [t.detach().to(dtype).requires_grad_(True) for t in (vertices, colors, backgrounds)]
        cameras = [t.to(dtype) for t in views(45, 31)]
        image = rasterize_antialiased(
            leaves[0],
            connectivity=connectivity,
            cameras=Cameras(*cameras, 45, 31),
            backgrounds=leaves[2],
            **{kind: leaves[1]},
        ).color
        (image * cotangent.to(dtype)).sum().backward()
        results.append([image.detach(), *(leaf.grad for leaf in leaves)])
    for name, native, exact in zip(("image", "vertices", "colors", "backgrounds"), *results, strict=True):
        assert_close_to_scale(native, exact, 2e-5, name=name)


@KINDS
def test_gradients_are_those_of_finite_differences(kind, rng):
    """Away from the moments at which a pixel changes hands, the image's derivative is the gradient."""
    vertices, faces = dented(rng, level=1)
    connectivity = connect(faces, vertices)
    viewmats, Ks = (t[:1].double() for t in views(24, 20))
    vertices, colors = vertices.double(), colors_of(kind, vertices, faces, rng).double()
    cotangent = torch.randn(1, 20, 24, 3, generator=rng, dtype=torch.float64)

    def loss(points: Tensor) -> Tensor:
        return (
            rasterize_antialiased(
                points, connectivity=connectivity, cameras=Cameras(viewmats, Ks, 24, 20), **{kind: colors}
            ).color
            * cotangent
        ).sum()

    leaf = vertices.clone().requires_grad_(True)
    loss(leaf).backward()
    assert leaf.grad is not None
    step, differences = 1e-6, leaf.grad.clone()
    for index in range(0, vertices.numel(), 4):
        moved = [vertices.clone(), vertices.clone()]
        moved[0].view(-1)[index] += step
        moved[1].view(-1)[index] -= step
        differences.view(-1)[index] = (loss(moved[0]) - loss(moved[1])) / (2 * step)
    assert float(leaf.grad.abs().max()) > 1
    torch.testing.assert_close(leaf.grad, differences, rtol=1e-4, atol=1e-5)


@KINDS
def test_reference_passes_gradcheck(kind, rng):
    """autograd's own check, for vertices, colours and background."""
    vertices, faces = dented(rng, level=0)
    connectivity = connect(faces, vertices)
    viewmats, Ks = (t[:1].double() for t in views(10, 8))

    def image(points: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        return rasterize_antialiased(
            points,
            connectivity=connectivity,
            cameras=Cameras(viewmats, Ks, 10, 8),
            backgrounds=background,
            **{kind: colors},
        ).color

    leaves = [vertices, colors_of(kind, vertices, faces, rng), torch.rand(1, 3, generator=rng)]
    assert torch.autograd.gradcheck(
        image, [leaf.double().requires_grad_(True) for leaf in leaves], eps=1e-7, atol=1e-5, fast_mode=True
    )


def test_a_half_plane_covers_its_pixels_exactly(engine):
    """A steep edge at x = 8.3 leaves 30 % of its pixel column covered, whichever side the triangle is on."""
    for edge, expected in ((8.3, 0.3), (8.7, 0.7)):
        corners = torch.tensor([[-90.0, -90.0, 1.0], [edge, -90.0, 1.0], [edge, 99.0, 1.0], [-90.0, 99.0, 1.0]])
        connectivity = connect(torch.tensor([[0, 1, 2], [0, 2, 3]]), corners)
        image = on(
            engine,
            rasterize_antialiased,
            corners,
            connectivity=connectivity,
            cameras=Cameras(*FLAT, 16, 4),
            vertex_colors=torch.ones(4, 1),
        ).color[0, :, :, 0]
        torch.testing.assert_close(image[:, :8], torch.ones(4, 8))
        torch.testing.assert_close(image[:, 8], torch.full((4,), expected))
        torch.testing.assert_close(image[:, 9:], torch.zeros(4, 7))


def test_the_image_is_close_to_a_supersampled_one(engine):
    """Where no face is seen edge on, silhouettes are four times closer to their supersampled mean than without."""
    vertices, faces = TETRAHEDRON
    viewmats, Ks = views(64, 64)
    ones = torch.ones(len(faces), 1)
    scene = (0.6 * vertices, viewmats, Ks, 64, 64)
    image = on(
        engine,
        rasterize_antialiased,
        scene[0],
        connectivity=connect(faces, vertices),
        cameras=Cameras(*scene[1:]),
        face_colors=ones,
    ).color
    exact, plain = (
        render_opaque(scene[0], cameras=Cameras(*scene[1:]), faces=faces, face_colors=ones, supersampling=samples).alpha
        for samples in (8, 1)
    )
    assert float((image - exact).abs().mean()) < 0.25 * float((plain - exact).abs().mean())


def test_edges_within_a_welded_surface_get_no_gradient(engine):
    """Face colours of a flat patch: only the vertices on its outline are pulled; unwelded, all of them are."""
    axis = torch.arange(4) * 6.0 + 3.3
    grid = torch.stack([*torch.meshgrid(axis, axis, indexing="xy"), torch.ones(4, 4)], dim=-1).reshape(-1, 3)
    cell = torch.tensor([[0, 1, 5], [0, 5, 4]])
    faces = torch.cat([cell + 4 * row + column for row in range(3) for column in range(3)])
    inner = torch.tensor([5, 6, 9, 10])
    colors = torch.linspace(0, 1, len(faces))[:, None]

    def pulled(points: Tensor, triangles: Tensor) -> Tensor:
        leaf = points.clone().requires_grad_(True)
        image = on(
            engine,
            rasterize_antialiased,
            leaf,
            connectivity=connect(triangles, points),
            cameras=Cameras(*FLAT, 24, 24),
            face_colors=colors,
        ).color
        (image * torch.linspace(0, 1, 24)[:, None]).sum().backward()
        assert leaf.grad is not None
        return leaf.grad.abs().sum(dim=1)

    welded = pulled(grid, faces)
    assert float(welded[inner].max()) == 0
    assert float(welded.max()) > 0
    unwelded = pulled(grid[faces].reshape(-1, 3), torch.arange(faces.numel()).view(-1, 3))
    at_inner = torch.isin(faces.reshape(-1), inner)
    assert float(unwelded[at_inner].max()) > 0


@pytest.mark.sanitize
def test_same_bits_for_any_number_of_threads(rng):
    """Image and gradients do not depend on the thread count."""
    vertices, faces = bumpy_sphere(4, seed=3)
    connectivity, cotangent = connect(faces, vertices), torch.randn(2, 150, 130, 3, generator=rng)
    before, results = num_threads(), []
    for count in (1, 2, 5):
        set_num_threads(count)
        leaf = vertices.clone().requires_grad_(True)
        colors = torch.linspace(0, 1, 3 * len(vertices)).view(-1, 3).requires_grad_(True)
        image = rasterize_antialiased(
            leaf, connectivity=connectivity, cameras=Cameras(*views(130, 150), 130, 150), vertex_colors=colors
        ).color
        (image * cotangent).sum().backward()
        results.append((image.detach(), leaf.grad, colors.grad))
    set_num_threads(before)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


@pytest.mark.sanitize
def test_unusable_vertices_harm_nothing(engine):
    """NaN, infinite and behind the camera: their faces are gone, everything else keeps finite gradients."""
    vertices, faces = icosphere(1)
    vertices = vertices.clone()
    for index, value in enumerate((math.nan, math.inf, 1e30)):
        vertices[index, index] = value
    leaf = vertices.requires_grad_(True)
    image = on(
        engine,
        rasterize_antialiased,
        leaf,
        connectivity=connect(faces, vertices),
        cameras=Cameras(*views(20, 20), 20, 20),
        face_colors=torch.ones(len(faces), 3),
    ).color
    assert bool(image.isfinite().all())
    image.square().sum().backward()
    assert leaf.grad is not None
    assert bool(leaf.grad[3:].isfinite().all())


@KINDS
def test_nvdiffrast_agrees(kind, rng):
    """Where nvdiffrast is there: the same image and vertex gradients, but for pixels that only one of them blends."""
    pytest.importorskip("nvdiffrast.torch")
    if not torch.cuda.is_available():
        pytest.skip("nvdiffrast needs a CUDA device")
    vertices, faces = dented(rng)
    connectivity, colors = connect(faces, vertices), colors_of(kind, vertices, faces, rng)
    results = []
    for draw in (rasterize_antialiased, rasterize_nvdiffrast):
        leaf = vertices.clone().requires_grad_(True)
        image = draw(leaf, connectivity, *views(256, 256), 256, 256, **{kind: colors})
        image.square().sum().backward()
        results.append((image.detach(), leaf.grad))
    for name, ours, theirs in zip(("image", "vertices"), *results, strict=True):
        assert_close_to_scale(ours, theirs, 1e-3, outliers=0.02, outlier_tolerance=1.0, name=name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": torch.zeros(3, 3)}, "vertices"),
        ({"face_colors": torch.zeros(3, 3)}, "face_colors"),
        ({"vertex_colors": torch.zeros(12, 3)}, "exactly one"),
        ({"backgrounds": torch.zeros(1, 2)}, "backgrounds"),
        ({"viewmats": torch.eye(4)}, "viewmats"),
        ({"viewmats": "elastic"}, "viewmats must be a tensor"),
        ({"Ks": torch.eye(3).double()[None]}, "Ks"),
        ({"Ks": "elastic"}, "Ks must be a tensor"),
        ({"width": 0}, "width"),
        (
            {"connectivity": MeshTopology.from_faces(icosphere(0)[1], 12)},
            r"connectivity must be a MeshConnectivity",
        ),
    ],
)
def test_wrong_arguments_are_named(change, message):
    """Each wrong argument is a ValueError that names it."""
    vertices, faces = icosphere(0)
    arguments = {
        "vertices": vertices,
        "connectivity": connect(faces, vertices),
        "viewmats": FLAT[0],
        "Ks": FLAT[1],
        "width": 4,
        "height": 4,
        "face_colors": torch.zeros(len(faces), 3),
    }
    with pytest.raises(ValueError, match=message):
        rasterize_antialiased(**{**arguments, **change})


@KINDS
def test_gradients_to_cameras_are_those_of_finite_differences(kind, rng):
    """They were None, without a word: a pose that was fitted to an opaque picture stayed where it was."""
    vertices, faces = dented(rng, level=1)
    connectivity, vertices = connect(faces, vertices), vertices.double()
    colors, cotangent = (
        colors_of(kind, vertices, faces, rng).double(),
        torch.randn(2, 20, 24, 3, generator=rng).double(),
    )
    viewmats, Ks = (t.double() for t in views(24, 20))

    def value(viewmats: Tensor, Ks: Tensor) -> Tensor:
        cameras = Cameras(viewmats, Ks, 24, 20)
        return (
            rasterize_antialiased(vertices, connectivity=connectivity, cameras=cameras, **{kind: colors}).color
            * cotangent
        ).sum()

    leaves = [viewmats.clone().requires_grad_(), Ks.clone().requires_grad_()]
    seen = value(*leaves)
    assert seen.item() == pytest.approx(value(viewmats, Ks).item(), abs=1e-9)
    gradients = torch.autograd.grad(seen, leaves)
    step = 1e-6
    for which, places in enumerate([[(0, 0, 3), (1, 2, 3), (1, 0, 1)], [(0, 0, 0), (0, 1, 2), (1, 1, 1)]]):
        for place in places:
            changed = [[t.clone() for t in (viewmats, Ks)] for _ in range(2)]
            for sign, pair in zip((1, -1), changed, strict=True):
                pair[which][place] += sign * step
            difference = (value(*changed[0]) - value(*changed[1])) / (2 * step)
            assert float(gradients[which][place]) == pytest.approx(float(difference), rel=1e-3, abs=1e-4)


def test_a_pose_is_found_by_an_opaque_picture(engine, rng):
    """Of a textured mesh, in a step of Adam that leads nearer."""
    vertices, faces = dented(rng)
    look = {
        "connectivity": connect(faces, vertices),
        "texture": torch.rand(8, 8, 3, generator=rng),
        "face_uvs": torch.rand(len(faces), 3, 2, generator=rng),
        "cameras": None,
    }
    viewmats, Ks = views(24, 20)
    shift = torch.tensor([0.05, -0.03, 0.0], requires_grad=True)

    def picture(shift: Tensor) -> Tensor:
        moved = torch.cat([viewmats[..., :3], (viewmats[..., 3] + torch.cat([shift, torch.zeros(1)]))[..., None]], -1)
        return on(engine, rasterize_antialiased, vertices, **{**look, "cameras": Cameras(moved, Ks, 24, 20)}).color

    target, adam = picture(torch.zeros(3)).detach(), torch.optim.Adam([shift], lr=3e-3)
    losses = []
    for _ in range(25):
        loss = (picture(shift) - target).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
    assert losses[-1] < 0.3 * losses[0]
