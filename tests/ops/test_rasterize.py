"""The public call: what comes out, and one clear error for every bad argument."""

import numpy as np
import pytest
import torch

import etsplat
from etsplat import Cutoffs, rasterize
from etsplat.core.cameras import Cameras
from etsplat.engines.choice import engine_for
from helpers.engines import device_of, dtype_of, looking, moved, on
from helpers.scenes import EVERYTHING, IMAGES, accuracy, mesh, prepare, render, soup


@pytest.fixture
def scene(rng):
    return soup(rng, 5, width=9, height=7)


def test_images_are_channels_last_in_the_dtype_of_the_vertices(engine, scene):
    out = render(scene, engine, **EVERYTHING)
    shapes = {name: tuple(getattr(out, name).shape) for name in IMAGES}
    assert shapes.pop("color") == shapes.pop("normal") == (2, 7, 9, 3)
    assert set(shapes.values()) == {(2, 7, 9, 1)}
    assert all(getattr(out, name).dtype == dtype_of(engine) for name in IMAGES)
    assert {tuple(value.shape) for value in vars(out.statistics).values()} == {(2, 5)}
    assert out.statistics.visible.dtype == torch.bool
    assert not any(value.requires_grad for value in vars(out.statistics).values())


def test_what_was_not_asked_for_is_none(engine, scene):
    out = render(scene, engine)
    assert [getattr(out, name) for name in (*IMAGES[2:], "statistics")] == [None] * 5


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 17])
def test_any_number_of_channels(engine, channels, rng):
    """Each channel is what it would be alone."""
    scene = soup(rng, 20, channels=channels)
    out = render(scene, engine)
    last = {**scene, "face_colors": scene["face_colors"][:, -1:], "backgrounds": scene["backgrounds"][:, -1:]}
    assert out.color.shape[-1] == channels
    torch.testing.assert_close(out.color[..., -1:], render(last, engine).color, rtol=0, atol=accuracy(engine))


def test_faces_and_soup_of_the_same_triangles_give_the_same_images(engine, rng):
    scene = mesh(rng)
    unshared = {**scene, "vertices": scene["vertices"][scene["faces"]], "faces": None}
    wide = {**scene, "faces": scene["faces"].int()}
    expected = render(scene, engine)
    assert torch.equal(render(unshared, engine).color, expected.color)
    assert torch.equal(render(wide, engine).color, expected.color)


def test_colors_per_view_and_one_sigma_for_all_are_the_same_as_spelled_out(engine, scene):
    shared = {**scene, "sigma": torch.tensor(0.5)}
    spelled = {
        **scene,
        "sigma": torch.full((5,), 0.5),
        "face_colors": scene["face_colors"].expand(2, 5, 3).contiguous(),
    }
    expected = render(shared, engine).color
    assert torch.equal(render(spelled, engine).color, expected)
    assert torch.equal(render({**scene, "sigma": 0.5}, engine).color, expected)


def test_views_of_a_batch_do_not_see_each_other(engine, scene):
    both = render(scene, engine, **EVERYTHING)
    for view in range(2):
        chosen = {name: scene[name][view : view + 1] for name in ("viewmats", "Ks", "backgrounds")}
        alone = render({**scene, **chosen}, engine, **EVERYTHING)
        for name in IMAGES:
            assert torch.equal(getattr(alone, name)[0], getattr(both, name)[view])


def test_no_triangles_show_the_background(engine, scene):
    empty = {name: scene[name][:0] for name in ("vertices", "face_colors", "opacities", "sigma")}
    out = render({**scene, **empty}, engine, **EVERYTHING)
    assert torch.equal(out.color, scene["backgrounds"].to(out.color.dtype)[:, None, None].expand_as(out.color))
    assert all((getattr(out, name) == 0).all() for name in IMAGES[1:])
    assert out.statistics.visible.shape == (2, 0)


def test_non_contiguous_tensors_are_understood(engine, scene):
    expected = render(scene, engine).color
    prepared = prepare(scene, engine)
    for name in ("vertices", "face_colors", "viewmats", "Ks", "backgrounds"):
        prepared[name] = prepared[name].transpose(-1, -2).contiguous().transpose(-1, -2)
    prepared["opacities"] = torch.stack([prepared["opacities"]] * 2, dim=1)[:, 0]
    assert torch.equal(on(engine, rasterize, **prepared).color, expected)


def test_default_engine_follows_dtype():
    assert engine_for(torch.zeros(1)).name == "cpu"
    assert engine_for(torch.zeros(1, dtype=torch.float64)).name == "reference"


ONE_CAMERA = Cameras(torch.eye(4)[None], torch.eye(3)[None], 4, 4)
BAD_ARGUMENTS = {
    "vertices without faces": (
        {"vertices": torch.zeros(5, 3)},
        r"vertices must have shape \(N, 3, 3\) where faces is None, got \(5, 3\): pass faces= too",
    ),
    "vertices with faces": ({"faces": torch.zeros(5, 3, dtype=torch.int64)}, r"vertices must have shape \(V, 3\)"),
    "number of colors": ({"face_colors": torch.zeros(4, 3)}, r"colors must have shape .* with B=2, N=5, got \(4, 3\)"),
    "views of colors": ({"face_colors": torch.zeros(3, 5, 3)}, "colors must have shape"),
    "no channels": ({"face_colors": torch.zeros(5, 0), "backgrounds": None}, "colors must have at least one channel"),
    "opacities": ({"opacities": torch.zeros(5, 1)}, r"opacities must have shape \(N,\)"),
    "sigma": ({"sigma": torch.ones(4)}, r"sigma must have shape \(\) or \(N,\)"),
    "viewmats": ({"viewmats": torch.eye(4)}, "viewmats must have shape"),
    "no cameras": ({"viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3), "backgrounds": None}, "viewmats"),
    "Ks": ({"Ks": torch.eye(3)[None]}, r"Ks must have shape \(B, 3, 3\) with B=2"),
    "backgrounds": ({"backgrounds": torch.zeros(4)}, r"backgrounds must have shape \(C,\) or \(B, C\)"),
    "both colors": ({"corner_colors": torch.zeros(5, 3, 3)}, "exactly one of .* got face_colors and corner_colors"),
    "no colors": (
        {"face_colors": None},
        "exactly one of face_colors, vertex_colors, corner_colors must be given, got none",
    ),
    "list": ({"opacities": [1.0] * 5}, r"opacities must be a tensor .* got list: pass torch.tensor\(opacities\)"),
    "dtype": ({"opacities": torch.ones(5, dtype=torch.float16)}, "opacities must be torch.float.* like vertices"),
    "device": ({"opacities": torch.ones(5, device="meta")}, "opacities must be"),
    "kernel": ({"kernel": "gaussian"}, "kernel must be one of 'single_sided'"),
    "distance": ({"distance": "euclid"}, "distance must be one of 'barycentric', 'sdf'"),
    "depth_of": ({"depth_of": "surface"}, "depth_of must be one of 'plane', 'centroid', got 'surface'"),
    "outputs": ({"outputs": ("color", "depths")}, "outputs must be one of 'color', 'alpha', 'depth', .* got 'depths'"),
    "vertex colors": ({"face_colors": None, "vertex_colors": torch.ones(15, 3)}, "vertex_colors need faces"),
    "numpy": ({"vertices": np.zeros((5, 3, 3))}, r"vertices must be .* got ndarray: pass torch.from_numpy\(vertices\)"),
    "sigma list": ({"sigma": [0.5] * 5}, r"sigma must be .* got list: pass torch.tensor\(sigma\)"),
    "cameras by hand": (
        {"cameras": (np.eye(4), np.eye(3)), "viewmats": None, "Ks": None, "width": None, "height": None},
        r"cameras must be Cameras, got tuple: make them by etsplat\.Cameras\(viewmats, Ks, width, height\)",
    ),
    "whole numbers": ({"vertices": torch.zeros(5, 3, 3, dtype=torch.int32)}, "vertices must be of floating-point"),
    "two kinds of cameras": ({"cameras": ONE_CAMERA}, "either cameras, or all of viewmats, Ks, width and height"),
    "cameras missing": ({"viewmats": None}, "either cameras, or all of viewmats, Ks, width and height must be given"),
    "width": ({"width": 0}, "width must be an integer from 1 to 67108864, got 0"),
    "height": ({"height": 7.0}, r"height must be an integer from 1 to 67108864, got 7\.0"),
    "too wide": ({"width": 2**31}, "width must be an integer from 1 to 67108864, got 2147483648"),
    "near plane": ({"near_plane": 0.0}, "near_plane must be positive and finite, got 0.0"),
    "near plane of a word": ({"near_plane": "a"}, "near_plane must be a number, got 'a'"),
    "no cutoffs": ({"cutoffs": None}, r"cutoffs must be Cutoffs, got None: pass etsplat\.Cutoffs\(\)"),
    "cutoffs by hand": ({"cutoffs": (0.0, 0.99, 2.0)}, "cutoffs must be Cutoffs, got tuple"),
    "no outputs": ({"outputs": None}, r"outputs must be names, such as \('depth',\), got None"),
    "outputs in a list": ({"outputs": [["depth"]]}, r"outputs must be names, such as \('depth',\), got list"),
    "cutoffs": ({"cutoffs": Cutoffs(alpha_min=0.5, alpha_max=0.4)}, "cutoffs must satisfy"),
    "sigma range": ({"sigma": torch.zeros(5)}, "sigma must be positive, got 0.0"),
    "transposed cameras": (
        {
            "viewmats": (torch.eye(4) + torch.nn.functional.one_hot(torch.tensor(14), 16).view(4, 4) * 2.0).repeat(
                2, 1, 1
            )
        },
        r"viewmats must have the last row \[0, 0, 0, 1\], got one that begins with 0, 0, 2: .* pass viewmats\.mT$",
    ),
    "skew": ({"Ks": torch.ones(2, 3, 3)}, "Ks must have the form"),
    "NaN vertices": ({"vertices": torch.full((5, 3, 3), torch.nan)}, "vertices must be finite, got 45 NaN"),
    "infinite colors": ({"face_colors": torch.full((5, 3), torch.inf)}, "colors must be finite"),
    "NaN cameras": ({"viewmats": torch.full((2, 4, 4), torch.nan)}, "viewmats must be finite"),
    "NaN backgrounds": ({"backgrounds": torch.full((2, 3), torch.nan)}, "backgrounds must be finite"),
}


@pytest.mark.parametrize("case", BAD_ARGUMENTS)
def test_bad_arguments_are_refused_by_name(engine, case, scene):
    bad, message = BAD_ARGUMENTS[case]
    converted = {
        name: value.to(dtype_of(engine)) if isinstance(value, torch.Tensor) and value.dtype == torch.float32 else value
        for name, value in bad.items()
    }
    if case != "device":
        converted = moved(converted, device_of(engine))
    with etsplat.engine(engine), pytest.raises(ValueError, match=message):
        rasterize(**{**prepare(scene, engine), **converted, **looking(engine)})


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (torch.full((5, 3), 15), "faces must be indices from 0 to 14, got indices from 15 to 15"),
        (torch.full((5, 3), -1), "faces must be indices from 0 to 14, got indices from -1 to -1"),
    ],
)
def test_bad_faces_are_refused_even_without_validation(engine, faces, message, scene):
    """An index out of range would crash the native engine; that of GPUs leaves the triangle out."""
    prepared = prepare(scene, engine)
    prepared["vertices"] = prepared["vertices"].reshape(15, 3)
    with pytest.raises(ValueError, match=message):
        on(engine, rasterize, **prepared, faces=faces, **{"validate": False, **looking(engine)})


def test_faces_of_another_type_are_refused_wherever_they_are(engine, scene):
    """Kernels would take their bits for integers."""
    prepared = prepare(scene, engine)
    prepared["vertices"] = prepared["vertices"].reshape(15, 3)
    with pytest.raises(ValueError, match=r"faces must be int32 or int64, got torch\.float32"):
        on(engine, rasterize, **prepared, faces=torch.zeros(5, 3), validate=False)


def test_engines_refuse_what_they_cannot_compute(scene):
    with pytest.raises(ValueError, match=r"engine cpu computes in float32, got torch\.float64"):
        on("cpu", rasterize, **prepare(scene, "reference"))
    with pytest.raises(ValueError, match=r"vertices must be float32 or float64, got torch\.float16"):
        rasterize(**prepare(scene, "reference", torch.float16))


def test_cameras_in_one_or_one_by_one_are_the_same(engine, scene):
    """So are the two spellings of a kernel."""
    views = {name: scene[name] for name in ("viewmats", "Ks", "width", "height")}
    rest = {name: value for name, value in scene.items() if name not in views}
    dtype = dtype_of(engine)
    cameras = Cameras(scene["viewmats"].to(dtype), scene["Ks"].to(dtype), scene["width"], scene["height"])
    expected = render(scene, engine, kernel="single_sided").color
    assert torch.equal(
        on(engine, rasterize, **prepare(rest, engine), cameras=cameras, kernel="single-sided").color, expected.cpu()
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sigma": True}, "sigma must be a tensor of shape"),
        ({"opacities": 0.5}, r"opacities must be a tensor of shape \(N,\), got float: pass torch\.full\(shape, 0\.5\)"),
    ],
)
def test_numbers_in_the_place_of_tensors_are_named(changes, message):
    look = {"opacities": torch.ones(1), "sigma": 0.5, "face_colors": torch.ones(1, 3)}
    with pytest.raises(ValueError, match=message):
        etsplat.rasterize(torch.eye(3)[None], **{**look, **changes}, cameras=etsplat.orbit_cameras(8, 8, azimuths=1))


@pytest.mark.parametrize(("name", "value"), [("x_max", "1"), ("alpha_min", None), ("alpha_max", True)])
def test_a_cutoff_that_is_no_number_is_named(name, value, rng):
    with pytest.raises(ValueError, match=rf"cutoffs\.{name} must be a number, got {value!r}"):
        rasterize(**soup(rng, 5), cutoffs=Cutoffs(**{name: value}))
