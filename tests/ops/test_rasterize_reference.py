"""The reference engine is right: gradcheck, a brute-force oracle, and closed forms of single triangles."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from etsplat import Cutoffs, intrinsics, look_at, rasterize
from etsplat.core.cameras import Cameras
from helpers.brute_force import brute_force
from helpers.engines import on
from helpers.scenes import DIFFERENTIABLE, EVERYTHING, IMAGES, NO_CUTOFFS, facing, prepare, render, soup

TRIANGLE = [(3.0, 2.5), (13.0, 4.0), (6.5, 14.0)]


def small_scene(rng: torch.Generator, colors: str) -> dict:
    scene = soup(rng, 4, width=6, height=5, channels=2, size=0.7)
    if colors == "per_view":
        scene["face_colors"] = torch.rand(2, 4, 2, generator=rng)
    elif colors != "per_triangle":
        del scene["face_colors"]
        scene["corner_colors"] = torch.rand(4, 3, 2, generator=rng)
    if colors == "per_vertex":
        scene["faces"] = torch.tensor([[0, 1, 2], [2, 1, 3], [3, 4, 5], [5, 0, 4]])
        scene["vertices"] = torch.randn(6, 3, generator=rng)
        del scene["corner_colors"]
        scene["vertex_colors"] = torch.rand(6, 2, generator=rng)
    return scene


@pytest.mark.parametrize("colors", ["per_triangle", "per_view", "per_corner", "per_vertex"])
def test_gradients_are_derivatives(kernel, distance, colors, rng):
    """gradcheck of every image, cut-offs off, to vertices, colours, opacities, sigma, backgrounds, viewmats and Ks."""
    scene = prepare(small_scene(rng, colors), "reference", requires_grad=True)
    names = [name for name in DIFFERENTIABLE if name in scene]
    Ks, free = scene["Ks"].detach().clone(), torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])

    def images(*tensors: Tensor) -> tuple[Tensor, ...]:
        arguments = {**scene, **dict(zip(names, tensors, strict=True))}
        arguments["Ks"] = Ks + free * (arguments["Ks"] - Ks)  # other entries are no parameters of a camera
        out = rasterize(**arguments, kernel=kernel, distance=distance, cutoffs=NO_CUTOFFS, **EVERYTHING)
        # The quotient of two tiny sums far from all triangles is too badly conditioned for finite differences.
        assert out.depth is not None
        weighted_depth = out.depth * out.alpha
        return out.color, out.alpha, weighted_depth, out.median_depth, out.normal, out.distortion  # type: ignore[return-value]

    assert torch.autograd.gradcheck(images, [scene[name] for name in names], fast_mode=True)


def test_gradient_of_the_expected_depth(distance, rng):
    """gradcheck of the quotient itself, where triangles cover every pixel."""
    scene = prepare(soup(rng, 3, width=4, height=3, size=2.0), "reference", requires_grad=True)

    def depth(vertices: Tensor, opacities: Tensor) -> Tensor:
        arguments = {**scene, "vertices": vertices, "opacities": opacities, "sigma": scene["sigma"] + 1}
        out = rasterize(
            **arguments, distance=distance, cutoffs=NO_CUTOFFS, outputs=("depth",), depth_of="centroid"
        ).depth
        assert out is not None
        return out

    assert torch.autograd.gradcheck(depth, [scene["vertices"], scene["opacities"]])


@pytest.mark.parametrize("depth", ["plane", "centroid"])
@pytest.mark.parametrize("cutoffs", [Cutoffs(), NO_CUTOFFS], ids=["cutoffs", "no_cutoffs"])
def test_every_image_equals_a_brute_force_loop(kernel, distance, depth, cutoffs, rng):
    """Compositing, depths, normals and the pairwise double sum of the distortion, one pixel at a time."""
    scene = soup(rng, 6, width=7, height=6, size=0.6, views=1)
    expected = brute_force(scene, kernel, distance, depth, cutoffs)
    out = render(scene, "reference", kernel=kernel, distance=distance, cutoffs=cutoffs, **EVERYTHING, depth_of=depth)
    for name in IMAGES:
        np.testing.assert_allclose(getattr(out, name)[0].numpy(), expected[name], atol=1e-10, rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("distance", ["barycentric", "sdf"])
@pytest.mark.parametrize("factor", [0.5, 1.3, 2.0])
def test_level_sets_are_scaled_triangles(distance, factor):
    """{x <= X}, read off an elastic image, is the hard image of the triangle scaled by X about its centre."""
    scene = facing(TRIANGLE)
    alpha = render(scene, "reference", distance=distance, cutoffs=NO_CUTOFFS).alpha
    sigma, opacity = 0.7, 0.9
    x = (-(alpha / opacity).log() / sigma) ** (sigma / 2)
    corners = torch.tensor(TRIANGLE).double()
    sides = torch.stack([(corners[(k + 1) % 3] - corners[(k + 2) % 3]).norm() for k in range(3)])
    centre = corners.mean(dim=0) if distance == "barycentric" else (sides[:, None] * corners).sum(dim=0) / sides.sum()
    scaled = facing([tuple(p) for p in (centre + factor * (corners - centre)).tolist()])
    inside = render(scaled, "reference", kernel="hard", distance=distance, cutoffs=NO_CUTOFFS).alpha > 0
    away = (x - factor).abs() > 1e-6
    assert torch.equal((x <= factor)[away], inside[away])


def test_distance_is_homogeneous_about_the_mean():
    """Along a ray from the mean of the projected vertices, x grows in proportion to the distance."""
    corners = [(8.5 - 3, 8.5 - 4), (8.5 + 6, 8.5 - 1), (8.5 - 3, 8.5 + 5)]  # mean on the pixel centre (8, 8)
    alpha = render(facing(corners), "reference", cutoffs=NO_CUTOFFS).alpha[0, ..., 0]
    x = (-(alpha / 0.9).log() / 0.7) ** 0.35
    assert float(x[8, 12] / x[8, 10]) == pytest.approx(2.0, rel=1e-5)
    assert float(x[14, 11] / x[12, 10]) == pytest.approx(1.5, rel=1e-5)


def test_shifting_the_principal_point_shifts_the_image(kernel, distance, rng):
    """Blocks of pixels leave no trace: a shift by whole pixels moves every image with it."""
    scene = soup(rng, 30, width=70, height=50, views=1)
    moved = {**scene, "Ks": scene["Ks"].clone()}
    moved["Ks"][:, :2, 2] += torch.tensor([5.0, 11.0])
    before = render(scene, "reference", kernel=kernel, distance=distance, **EVERYTHING)
    after = render(moved, "reference", kernel=kernel, distance=distance, **EVERYTHING)
    for name in IMAGES:
        torch.testing.assert_close(
            getattr(after, name)[:, 11:, 5:], getattr(before, name)[:, :-11, :-5], rtol=0, atol=1e-9
        )


def test_gradient_of_x_follows_the_barycentric_identity():
    """dx/dv_j = 3 a_j grad_p a_min: the three projected vertices share one direction."""
    scene = prepare(facing(TRIANGLE), "reference", requires_grad=True)
    out = rasterize(**scene, cutoffs=NO_CUTOFFS)
    row, column = 9, 11
    alpha = out.alpha[0, row, column, 0]
    alpha.backward()
    sigma, opacity = 0.7, 0.9
    x = float((-(alpha.detach() / opacity).log() / sigma) ** (sigma / 2))
    slope = opacity * -2 * x ** (2 / sigma - 1) * math.exp(-sigma * x ** (2 / sigma))
    corners = torch.tensor(TRIANGLE).double()
    inverse = torch.linalg.inv(torch.cat([corners.T, torch.ones(1, 3)]).double())
    a = inverse @ torch.tensor([column + 0.5, row + 0.5, 1.0]).double()
    expected = slope * 3 * a[:, None] * inverse[a.argmin(), :2] * 16 / 2  # focal / z
    torch.testing.assert_close(scene["vertices"].grad[0, :, :2], expected)


def test_freezing_the_incentre_drops_only_its_share_of_the_gradient():
    """The frozen gradient is the finite difference with the inradius held, and the image does not change."""
    scene = prepare(facing(TRIANGLE), "reference", requires_grad=True)
    frozen = rasterize(**scene, distance="sdf", freeze_inradius=True, cutoffs=NO_CUTOFFS)
    free = render(facing(TRIANGLE), "reference", distance="sdf", cutoffs=NO_CUTOFFS)
    torch.testing.assert_close(frozen.alpha, free.alpha, rtol=0, atol=0)
    frozen.alpha[0, 5, 6, 0].backward()

    def inradius(corners: Tensor) -> Tensor:
        sides = torch.stack([(corners[(k + 1) % 3] - corners[(k + 2) % 3]).norm() for k in range(3)])
        return torch.linalg.det(torch.cat([corners.T, torch.ones(1, 3).double()])).abs() / sides.sum()

    corners = torch.tensor(TRIANGLE).double().requires_grad_()
    radius = inradius(corners.detach())
    pixel = torch.tensor([6.5, 5.5]).double()
    signed = []
    for k in range(3):
        start, end, opposite = corners[(k + 1) % 3], corners[(k + 2) % 3], corners[k]
        along = (end - start) / (end - start).norm()
        normal = torch.stack([along[1], -along[0]])
        normal = normal * -torch.sign(normal @ (opposite - start)).detach()
        signed.append(normal @ (pixel - start))
    x = 1 + torch.stack(signed).max() / radius
    (0.9 * torch.exp(-0.7 * x ** (2 / 0.7))).backward()
    assert corners.grad is not None
    torch.testing.assert_close(scene["vertices"].grad[0, :, :2], corners.grad * 8, rtol=1e-6, atol=1e-12)


def test_floored_slopes_reach_the_vertices():
    """At a pixel within 1e-6 of the edge the single-sided slope is the one at 1 - x = 1e-4, not an unbounded one."""
    edge = 8.5 + 1e-6
    scene = facing([(edge, -10.0), (edge, 30.0), (-20.0, 8.5)])
    scene["sigma"] = torch.tensor(0.3)
    prepared = prepare(scene, "reference", requires_grad=True)
    prepared["vertices"] = facing([(edge, -10.0), (edge, 30.0), (-20.0, 8.5)])["vertices"].double()
    prepared["vertices"][0, :2, 0] = (edge - 8) / 8
    prepared["vertices"].requires_grad_()
    rasterize(**prepared, kernel="single_sided", cutoffs=NO_CUTOFFS).alpha[0, 8, 8, 0].backward()
    slope = 0.9 * 0.3 * 1e-4**-0.7
    height = edge + 20.0
    expected = slope * 3 / height * 8  # |dx/dv| summed over the two vertices of the edge is 3 (a_1 + a_2) / height
    assert float(prepared["vertices"].grad[0, :2, 0].sum()) == pytest.approx(expected, rel=1e-3)


def test_backward_needs_the_memory_of_a_block_only(rng):
    """2,000 triangles at 256 x 256 go through: the tape holds no full image of pairs."""
    scene = prepare(soup(rng, 2000, width=256, height=256, size=0.05, views=1), "reference", requires_grad=True)
    rasterize(**scene).color.sum().backward()
    assert scene["vertices"].grad.isfinite().all()


def test_intrinsics_and_look_at_agree_with_the_rasterizer():
    """A small triangle at the target of the camera is drawn in the middle of the image."""
    viewmats = look_at(torch.tensor([[1.0, 2.0, 3.0]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    K, vertices = intrinsics(40, 21, 21)[None], 0.05 * torch.eye(3)[None]
    out = on(
        "reference",
        rasterize,
        vertices,
        face_colors=torch.ones(1, 1),
        opacities=torch.ones(1),
        sigma=0.3,
        cameras=Cameras(viewmats, K, 21, 21),
    )
    assert divmod(int(out.alpha.argmax()), 21) == (10, 10)
