"""The CPU engine agrees with the float64 reference, in values and gradients, on random soups and on a mesh.

In float32 the reference itself is compared on all kernels and distances alone: it is the same code.
"""

import pytest
import torch

from etsplat import _native, num_threads, rasterize, set_num_threads
from etsplat.core.cameras import Cameras
from etsplat.geometry.icosphere import icosphere
from helpers.agreement import IMAGE_TOLERANCE, compare, gradient_tolerance
from helpers.scenes import EVERYTHING, IMAGES, colored, gradients, mesh, soup
from helpers.tolerances import assert_close_to_scale


@pytest.fixture(params=["cpu", "cuda"])
def native(request, engine_of) -> str:
    """The engines of native code."""
    return engine_of(request.param)


def test_soup(engine, kernel, distance, rng):
    compare(soup(rng, 150), engine, rng, kernel=kernel, distance=distance, **EVERYTHING)


def test_mesh(engine, kernel, distance, rng):
    compare(mesh(rng), engine, rng, kernel=kernel, distance=distance, **EVERYTHING)


def test_colors_alone(native, kernel, distance, rng):
    """The path that shape reconstruction takes: no image but the colour."""
    compare(mesh(rng), native, rng, images=("color",), kernel=kernel, distance=distance)


def with_interpolated_colors(scene, rng):
    """Colours at the vertices, or at the corners of separate triangles, instead of constant ones."""
    shape = (*scene["vertices"].shape[:-1], 3)
    return {name: value for name, value in scene.items() if name != "face_colors"} | {
        ("vertex_colors" if "faces" in scene else "corner_colors"): torch.rand(shape, generator=rng)
    }


@pytest.mark.parametrize("layout", ["per_corner", "per_vertex"])
def test_interpolated_colors_alone(native, kernel, distance, layout, rng):
    """The same with interpolated colours, which have a path of their own."""
    scene = with_interpolated_colors(mesh(rng) if layout == "per_vertex" else soup(rng, 150), rng)
    compare(scene, native, rng, images=("color",), kernel=kernel, distance=distance, outputs=("statistics",))


@pytest.mark.parametrize("case", ["frozen incentre", "tiny", "huge", "saturated"])
def test_interpolated_colors_at_the_extremes(native, kernel, case, rng):
    """Triangles of a tenth of a pixel, some larger than the image, pixels that stop; the incentre held."""
    scene = with_interpolated_colors(soup(rng, 80, size={"tiny": 0.01, "huge": 3.0}.get(case, 1.5)), rng)
    if case == "saturated":
        scene["opacities"] = torch.ones(80)
    options = {"distance": "sdf", "freeze_inradius": True} if case == "frozen incentre" else {}
    compare(scene, native, rng, IMAGES[:1], 10.0 if case == "tiny" else 1.0, kernel=kernel, **options)


@pytest.mark.parametrize("image", IMAGES)
def test_each_image_alone(native, image, rng):
    """Also when an image is asked for that no cotangent reaches."""
    options = {**EVERYTHING, "depth_of": "centroid"} if image != "color" else EVERYTHING
    compare(soup(rng, 80), native, rng, images=(image,), **options)


@pytest.mark.parametrize("channels", [1, 4, 5, 9])
def test_channels(native, channels, rng):
    compare(soup(rng, 60, channels=channels), native, rng, images=("color", "alpha"))


@pytest.mark.parametrize("layout", ["per_view", "per_corner", "per_vertex"])
def test_color_layouts(native, layout, rng):
    compare(colored(layout, rng), native, rng, **EVERYTHING)


@pytest.mark.parametrize("depth", ["plane", "centroid"])
def test_depth_modes(native, depth, distance, rng):
    compare(soup(rng, 80), native, rng, distance=distance, **EVERYTHING, depth_of=depth)


def test_frozen_inradius(native, kernel, rng):
    compare(soup(rng, 80), native, rng, kernel=kernel, distance="sdf", freeze_inradius=True, images=("color",))


@pytest.mark.parametrize("sigma", [0.02, 0.1, 2.5])
def test_softness_from_sharp_to_flat(native, kernel, sigma, rng):
    scene = {**soup(rng, 80), "sigma": torch.tensor(sigma)}
    # Sharp, x is raised to the power of 100 with its rounding.
    compare(scene, native, rng, kernel=kernel, images=("color", "alpha"), looseness=max(1.0, 0.3 / sigma))


@pytest.mark.parametrize("size", [0.01, 3.0])
def test_triangles_smaller_than_a_pixel_and_larger_than_the_image(native, kernel, distance, size, rng):
    # The corners of a triangle of a tenth of a pixel are known to 1e-5 of its size.
    looseness = 10.0 if size < 0.1 else 1.0
    options = {"kernel": kernel, "distance": distance, "images": ("color", "alpha"), "looseness": looseness}
    compare(soup(rng, 60, size=size), native, rng, **options)


def test_opaque_stack_saturates(native, kernel, rng):
    """Pixels that stop: clamped layers of opacity 1."""
    scene = soup(rng, 120, size=1.5)
    scene["opacities"] = torch.ones(120)
    compare(scene, native, rng, kernel=kernel, **EVERYTHING)


def test_shifting_the_principal_point_shifts_the_image(engine, kernel, distance, rng):
    """Tiles leave no trace: a shift by whole pixels moves colours and gradients with it."""
    scene = soup(rng, 60, width=83, height=75, views=1)
    moved = {**scene, "Ks": scene["Ks"].clone()}
    moved["Ks"][:, :2, 2] += torch.tensor([5.0, 11.0])
    cotangent = torch.zeros(1, 75, 83, 3)
    cotangent[:, 20:50, 20:60] = torch.randn(1, 30, 40, 3, generator=rng)
    options = {"kernel": kernel, "distance": distance}
    before, before_grads = gradients(scene, engine, {"color": cotangent}, **options)
    after, after_grads = gradients(moved, engine, {"color": cotangent.roll((11, 5), dims=(1, 2))}, **options)
    assert_close_to_scale(after.color[:, 11:, 5:], before.color[:, :-11, :-5], **IMAGE_TOLERANCE)
    for name in ("vertices", "face_colors", "opacities", "sigma"):
        assert_close_to_scale(
            after_grads[name], before_grads[name], **gradient_tolerance(name, before_grads[name]), name=name
        )


def test_images_and_gradients_do_not_depend_on_the_number_of_threads(kernel, rng):
    """To the bit."""
    scene = soup(rng, 150, width=100, height=90)
    cotangents = {"color": torch.randn(2, 90, 100, 3, generator=rng), "distortion": torch.ones(2, 90, 100, 1)}
    before = num_threads()
    try:
        results = []
        for threads in (1, 2, 3, 7):
            set_num_threads(threads)
            results.append(gradients(scene, "cpu", cotangents, kernel=kernel, **EVERYTHING))
    finally:
        set_num_threads(before)
    first, first_grads = results[0]
    for out, grads in results[1:]:
        assert all(torch.equal(getattr(out, name), getattr(first, name)) for name in IMAGES)
        assert all(torch.equal(grads[name], first_grads[name]) for name in grads)


def test_chunks_of_triangles_do_not_depend_on_the_number_of_threads():
    """To the bit, with enough triangles for several chunks of projection, sorting and reduction.

    Shared vertices are added up by the one thread, by few while they reduce, or by many in ranges of vertices.
    """
    vertices, faces = icosphere(5)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.0
    K = torch.tensor([[200.0, 0.0, 70.0], [0.0, 200.0, 60.0], [0.0, 0.0, 1.0]])
    before = num_threads()
    results = []
    try:
        for threads in (1, 3, 8):
            set_num_threads(threads)
            leaves = [vertices, torch.rand(len(faces), 3, generator=torch.Generator().manual_seed(0)), viewmat[None]]
            leaves = [leaf.clone().requires_grad_() for leaf in leaves]
            opacities, sigma = torch.full((len(faces),), 0.7), torch.tensor(0.5, requires_grad=True)
            out = rasterize(
                leaves[0],
                face_colors=leaves[1],
                opacities=opacities,
                sigma=sigma,
                cameras=Cameras(leaves[2], K[None], 130, 120),
                faces=faces,
            )
            grads = torch.autograd.grad(out.color.square().sum(), [*leaves, sigma])
            results.append([out.color.detach(), *grads])
    finally:
        set_num_threads(before)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


@pytest.mark.parametrize("instruction_set", _native.available_instruction_sets())
def test_every_instruction_set(instruction_set, kernel, distance, rng):
    before = _native.instruction_set()
    try:
        _native.set_instruction_set(instruction_set)
        compare(soup(rng, 80), "cpu", rng, kernel=kernel, distance=distance, **EVERYTHING)
    finally:
        _native.set_instruction_set(before)
