"""Rules of compositing, visibility and interpolation, each on a scene small enough to know the answer."""

import math

import pytest
import torch

from etsplat import Cutoffs
from helpers.scenes import (
    EVERYTHING,
    NO_CUTOFFS,
    accuracy,
    facing,
    gradients,
    mesh,
    render,
    soup,
    stacked,
)

COVER = [(-60.0, -60.0), (90.0, -60.0), (8.0, 90.0)]
TRIANGLE = [(3.0, 2.5), (13.0, 4.0), (6.5, 14.0)]


def colored(scene, color):
    return {**scene, "face_colors": torch.tensor([color])}


def test_nearer_triangle_covers_the_farther_whatever_the_order(engine):
    """C = a c_1 + (1 - a) a c_2 + (1 - a)^2 background."""
    red = colored(facing(COVER, z=2.0, opacity=0.6), [1.0, 0.0, 0.0])
    blue = colored(facing(COVER, z=3.0, opacity=0.5), [0.0, 0.0, 1.0])
    for order in ((red, blue), (blue, red)):
        scene = {**stacked(*order), "backgrounds": torch.tensor([[0.0, 1.0, 0.0]])}
        out = render(scene, engine, kernel="hard")
        assert out.color[0, 8, 8].tolist() == pytest.approx([0.6, 0.4 * 0.5, 0.4 * 0.5], abs=1e-6)


def test_equal_depths_are_drawn_by_index(engine):
    first, second = colored(facing(COVER), [1.0, 0.0, 0.0]), colored(facing(COVER), [0.0, 1.0, 0.0])
    pixel = render(stacked(first, second), engine, kernel="hard").color[0, 8, 8]
    assert pixel.tolist() == pytest.approx([0.9, 0.09, 0.0], abs=1e-6)


def test_two_coincident_copies_composite_to_one_where_the_kernel_is_one(engine, distance):
    """Copies with opacity 1 - sqrt(1 - o) give o inside a hard triangle."""
    single = render(facing(TRIANGLE, opacity=0.8), engine, kernel="hard", distance=distance)
    copy = facing(TRIANGLE, opacity=1 - math.sqrt(1 - 0.8))
    double = render(stacked(copy, copy), engine, kernel="hard", distance=distance)
    torch.testing.assert_close(double.color, single.color, rtol=0, atol=2e-6)
    torch.testing.assert_close(double.alpha, single.alpha, rtol=0, atol=2e-6)


def test_elastic_and_bilateral_images_coincide_at_one_half(engine, distance, rng):
    scene = {**soup(rng, 20), "sigma": torch.tensor(0.5)}
    elastic, bilateral = (render(scene, engine, kernel=k, distance=distance).color for k in ("elastic", "bilateral"))
    torch.testing.assert_close(elastic, bilateral, rtol=0, atol=accuracy(engine))


def test_pixel_dies_at_the_layer_it_cannot_afford(engine):
    """Two layers of 0.99 leave T = 1e-4; a third would leave 1e-6: it and everything behind are not drawn."""
    layers = [facing(COVER, z=2.0 + k, opacity=1.0) for k in range(2)]
    third, faint = facing(COVER, z=4.0, opacity=0.9), facing(COVER, z=5.0, opacity=0.005)
    scene = stacked(*layers, third, faint)
    out = render(scene, engine, kernel="hard", outputs=("statistics",))
    assert float(out.alpha[0, 8, 8, 0]) == pytest.approx(1 - 1e-4, abs=2e-7)
    assert out.statistics.max_weight[0, 2:].tolist() == [0.0, 0.0]
    assert out.statistics.visible.all()
    # The faint layer alone would have been affordable.
    affordable = render(stacked(*layers, faint), engine, kernel="hard", outputs=("statistics",))
    assert float(affordable.statistics.max_weight[0, 2]) > 0


def test_clamped_alpha_has_no_gradient(engine):
    """Where o G(x) exceeds 0.99 neither the opacity, the softness nor the vertices move the pixel."""
    scene = facing(COVER, opacity=1.0)
    cotangent = torch.zeros(1, 16, 16, 1)
    cotangent[0, 8, 8] = 1.0
    options = {"kernel": "elastic", "distance": "barycentric"}
    scene["sigma"] = torch.tensor(0.2)
    out, grads = gradients(scene, engine, {"alpha": cotangent}, **options)
    assert out.alpha[0, 8, 8].tolist() == pytest.approx([0.99], abs=1e-6)
    assert all((grads[name] == 0).all() for name in ("opacities", "sigma", "vertices"))


def test_faint_pixels_are_skipped(engine):
    """No pixel has an alpha between 0 and 1/255, and pixels beyond x = 2 are empty."""
    scene = {**facing([(6.0, 6.0), (10.0, 6.0), (8.0, 10.0)], size=16), "sigma": torch.tensor(1.4)}
    cut = render(scene, engine).alpha
    assert not ((cut > 0) & (cut < 1 / 255)).any()
    full = render(scene, engine, cutoffs=NO_CUTOFFS).alpha
    kept = cut > 0
    torch.testing.assert_close(cut[kept], full[kept], rtol=0, atol=accuracy(engine))
    assert (full[~kept] < 0.9 * 0.0231).all()
    wide = render(scene, engine, cutoffs=Cutoffs(x_max=3.0)).alpha
    assert (wide > 0).sum() > (cut > 0).sum()


def test_triangle_with_a_vertex_at_or_before_the_near_plane_is_dropped_whole(engine):
    scene = facing(COVER, z=2.0)
    assert render(scene, engine, near_plane=1.99).alpha.max() > 0
    assert render(scene, engine, near_plane=2.0).alpha.max() == 0
    behind = {**scene, "vertices": scene["vertices"].clone()}
    behind["vertices"][0, 0, 2] = -1.0
    out, grads = gradients(behind, engine, {"color": torch.ones(1, 16, 16, 3)}, outputs=("statistics",))
    assert not out.statistics.visible.any()
    assert all((value == 0).all() for value in grads.values())


INVISIBLE = {
    "behind the camera": {"vertices": -facing(TRIANGLE)["vertices"]},
    "out of the image": {"vertices": facing([(40.0, 2.0), (45.0, 4.0), (42.0, 9.0)])["vertices"]},
    "a line": {"vertices": facing([(2.0, 2.0), (14.0, 14.0), (8.0, 8.0)])["vertices"]},
    "a point": {"vertices": facing([(8.0, 8.0)] * 3)["vertices"]},
    "edge-on": {"vertices": torch.tensor([[[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.5, 3.0]]])},
    "too faint": {"opacities": torch.tensor([0.0039])},
    "NaN vertex": {"vertices": facing(TRIANGLE)["vertices"] * torch.tensor([[[1.0], [torch.nan], [1.0]]])},
    "infinite vertex": {"vertices": facing(TRIANGLE)["vertices"] * torch.tensor([[[1.0], [torch.inf], [1.0]]])},
    "NaN color": {"face_colors": torch.tensor([[0.1, torch.nan, 0.2]])},
    "NaN opacity": {"opacities": torch.tensor([torch.nan])},
    "infinite opacity": {"opacities": torch.tensor([torch.inf])},
    "NaN sigma": {"sigma": torch.tensor([torch.nan])},
    "zero sigma": {"sigma": torch.tensor([0.0])},
    "negative sigma": {"sigma": torch.tensor([-1.0])},
}


@pytest.mark.parametrize("case", INVISIBLE)
def test_invisible_triangle_changes_nothing_and_gets_zero_gradient(engine, case, distance):
    """The other triangle's image and gradients are the same as without it, to the bit."""
    good = {**facing(TRIANGLE), "sigma": torch.tensor([0.7])}
    bad = {**good, **INVISIBLE[case]}
    both = {**stacked(good, bad), "sigma": torch.cat([good["sigma"], bad["sigma"]])}
    cotangents = {name: torch.ones(1, 16, 16, 3 if name in ("color", "normal") else 1) for name in ("color", "depth")}
    options = {**EVERYTHING, "distance": distance, "validate": False}
    alone, alone_grads = gradients(good, engine, cotangents, **options)
    out, grads = gradients(both, engine, cotangents, **options)
    assert torch.equal(out.color, alone.color)
    assert out.statistics.visible.tolist() == [[True, False]]
    for values in (out.statistics.max_weight, out.statistics.screen_size, out.statistics.inradius):
        assert values[0, 0] > 0
        assert values[0, 1] == 0
    for name in ("vertices", "face_colors", "opacities", "sigma"):
        assert (grads[name][1] == 0).all()
        assert torch.equal(grads[name][:1], alone_grads[name])
    assert torch.equal(grads["viewmats"], alone_grads["viewmats"])


def test_camera_of_nan_shows_the_background_and_spoils_no_other(engine, rng):
    scene = soup(rng, 10)
    spoiled = {**scene, "viewmats": scene["viewmats"].clone()}
    spoiled["viewmats"][0, 0, 0] = torch.nan
    ones = {"color": torch.ones(2, scene["height"], scene["width"], 3)}
    clean, _ = gradients(scene, engine, ones)
    out, grads = gradients(spoiled, engine, ones, validate=False)
    assert torch.equal(out.color[1], clean.color[1])
    assert (out.color[0] == scene["backgrounds"][0].to(out.color.dtype)).all()
    assert all(value.isfinite().all() for value in grads.values())


def test_both_windings_are_drawn_alike(engine, distance):
    scene = facing(TRIANGLE)
    flipped = {**scene, "vertices": scene["vertices"].flip(1)}
    expected = render(scene, engine, distance=distance, outputs=("normal",))
    out = render(flipped, engine, distance=distance, outputs=("normal",))
    torch.testing.assert_close(out.alpha, expected.alpha, rtol=0, atol=accuracy(engine))
    torch.testing.assert_close(out.normal, expected.normal, rtol=0, atol=accuracy(engine))


def test_normal_faces_the_camera_and_is_weighted_by_alpha(engine):
    out = render(facing(COVER, opacity=0.5), engine, kernel="hard", outputs=("normal",))
    assert out.normal[0, 8, 8].tolist() == pytest.approx([0.0, 0.0, -0.5], abs=1e-6)


@pytest.mark.parametrize("mode", ["plane", "centroid"])
def test_depths_of_two_layers(engine, mode):
    """Expected depth is the weighted mean; the median is where T falls below one half."""
    scene = stacked(facing(COVER, z=2.0, opacity=0.4), facing(COVER, z=3.0, opacity=0.5))
    out = render(scene, engine, kernel="hard", outputs=("depth", "median_depth"), depth_of=mode)
    expected = (0.4 * 2 + 0.6 * 0.5 * 3) / 0.7
    assert float(out.depth[0, 8, 8, 0]) == pytest.approx(expected, abs=1e-5)
    assert float(out.median_depth[0, 8, 8, 0]) == pytest.approx(3.0, abs=1e-5)


def test_depths_are_zero_where_there_is_nothing_to_measure(engine):
    """Expected depth in empty pixels, median depth where T stays above one half."""
    out = render(facing(TRIANGLE, opacity=0.4), engine, kernel="hard", outputs=("depth", "median_depth"))
    empty = out.alpha == 0
    assert empty.any()
    assert (out.depth[empty] == 0).all()
    assert (out.depth[~empty] > 1.9).all()
    assert (out.median_depth == 0).all()


def slanted():
    """A large triangle in the plane z = 3 + 0.8 x - 0.5 y, and the depth of that plane along each pixel's ray."""
    scene = facing(COVER)
    corners = torch.tensor([[-6.0, -6.0], [8.0, -5.0], [1.0, 8.0]]) * 0.4
    z = 3 + 0.8 * corners[:, 0] - 0.5 * corners[:, 1]
    scene["vertices"] = torch.cat([corners, z[:, None]], dim=1)[None]
    ray = (torch.arange(16).double() + 0.5 - 8) / 16
    depth = 3 / (1 - 0.8 * ray[None, :] + 0.5 * ray[:, None])
    return scene, ray, depth


def test_plane_depth_is_perspective_correct(engine):
    scene, _, expected = slanted()
    out = render(scene, engine, kernel="hard", outputs=("depth",))
    inside = out.alpha[0, ..., 0] > 0
    assert inside.sum() > 50
    torch.testing.assert_close(out.depth[0, ..., 0][inside].double(), expected[inside], rtol=1e-5, atol=0)


def test_centroid_depth_is_constant(engine):
    scene, _, _ = slanted()
    out = render(scene, engine, kernel="hard", outputs=("depth",), depth_of="centroid")
    centroid = float(scene["vertices"][0, :, 2].mean())
    values = out.depth[out.alpha > 0]
    torch.testing.assert_close(values, torch.full_like(values, centroid), rtol=1e-5, atol=0)


def test_corner_colors_interpolate_perspective_correctly(engine):
    """World x and y given as corner colours come out as x and y of the point on the plane."""
    scene, ray, depth = slanted()
    del scene["face_colors"]
    scene["corner_colors"] = scene["vertices"][..., :2].clone()
    out = render(scene, engine, kernel="hard")
    inside = out.alpha[0, ..., 0] > 0
    color = (out.color[0] / out.alpha[0]).double()
    torch.testing.assert_close(color[..., 0][inside], (ray[None, :] * depth)[inside], rtol=0, atol=3e-5)
    torch.testing.assert_close(color[..., 1][inside], (ray[:, None] * depth)[inside], rtol=0, atol=3e-5)


def test_corner_colors_do_not_extrapolate(engine, rng):
    """Outside of the triangle a colour is a blend of its corners."""
    scene = facing([(6.0, 6.0), (10.0, 6.0), (8.0, 10.0)])
    del scene["face_colors"]
    scene["corner_colors"] = torch.rand(1, 3, 2, generator=rng)
    out = render({**scene, "sigma": torch.tensor(1.0)}, engine)
    color = (out.color / out.alpha)[0][out.alpha[0, ..., 0] > 0]
    low, high = scene["corner_colors"][0].amin(dim=0), scene["corner_colors"][0].amax(dim=0)
    assert ((color >= low - 1e-5) & (color <= high + 1e-5)).all()


def test_equal_corner_colors_are_a_triangle_color(engine, rng):
    scene = soup(rng, 15)
    corners = {**scene, "corner_colors": scene["face_colors"][:, None].expand(15, 3, 3).contiguous()}
    del corners["face_colors"]
    expected = render(scene, engine).color
    torch.testing.assert_close(render(corners, engine).color, expected, rtol=0, atol=accuracy(engine))


def test_vertex_colors_are_corner_colors_of_the_faces(engine, rng):
    scene = mesh(rng)
    del scene["face_colors"]
    shared = torch.rand(len(scene["vertices"]), 3, generator=rng)
    by_vertex = render({**scene, "vertex_colors": shared}, engine).color
    by_corner = render({**scene, "corner_colors": shared[scene["faces"]]}, engine).color
    assert torch.equal(by_vertex, by_corner)


def test_distortion_of_two_layers(engine):
    """w_1 w_2 (m_1 - m_2)^2 with m = 100 / 99.8 (1 - 0.2 / z)."""
    scene = stacked(facing(COVER, z=0.5, opacity=0.4), facing(COVER, z=3.0, opacity=0.5))
    out = render(scene, engine, kernel="hard", outputs=("distortion",))
    difference = 100 / 99.8 * (0.2 / 0.5 - 0.2 / 3.0)
    assert float(out.distortion[0, 8, 8, 0]) == pytest.approx(0.4 * 0.3 * difference**2, rel=1e-4)


def test_statistics_of_one_triangle(engine):
    """Greatest weight, distance from the mean to the farthest vertex, inradius, in pixels."""
    corners = [(2.0, 2.0), (14.0, 2.0), (2.0, 7.0)]  # sides 5, 12, 13: inradius 2
    out = render(facing(corners, opacity=0.9), engine, kernel="hard", outputs=("statistics",))
    assert float(out.statistics.max_weight) == pytest.approx(0.9, abs=1e-6)
    assert float(out.statistics.screen_size) == pytest.approx(math.hypot(8.0, 5 / 3), rel=1e-5)
    assert float(out.statistics.inradius) == pytest.approx(2.0, rel=1e-5)


def test_box_of_the_visible_support_decides_visibility(engine):
    """A triangle outside of the image is visible as soon as its soft rim can reach in."""

    def visible(left: float) -> bool:
        scene = facing([(left, 6.0), (left + 3.0, 6.0), (left, 9.0)], opacity=0.9)
        return bool(render({**scene, "sigma": torch.tensor(1.4)}, engine, outputs=("statistics",)).statistics.visible)

    # {x <= 2} reaches from the mean at left + 1 to left - 1.
    assert visible(16.9)
    assert not visible(17.1)
