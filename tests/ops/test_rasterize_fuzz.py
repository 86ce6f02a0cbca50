"""Whatever comes in, nothing crashes and nothing finite turns into NaN."""

import math
import random

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from etsplat import Cutoffs, rasterize
from etsplat.core.cameras import Cameras
from etsplat.core.kernels import DISTANCES, KERNELS
from etsplat.core.rasterization import OUTPUTS
from helpers.engines import device_of, dtype_of, on
from helpers.scenes import EVERYTHING, IMAGES, NO_CUTOFFS, facing, gradients

SIZE = 12
FUZZ = settings(
    max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)

SPECIAL = [0.0, -0.0, 1e-45, -1e-40, 1e-20, 1e-7, 0.01, 1.0, -1.0, 2.0, 1e4, -1e9, 1e15, 1e20, 3e38, -3e38]
BROKEN = [math.nan, math.inf, -math.inf]
coordinates = st.one_of(st.floats(-4, 4, width=32), st.sampled_from(SPECIAL + BROKEN))
triangles = st.lists(st.lists(coordinates, min_size=9, max_size=9), min_size=0, max_size=5)
opacities = st.sampled_from([0.0, 1e-45, 0.0039, 0.004, 0.5, 0.99, 1.0, 1.5, 1e30, -0.5, *BROKEN])
sigmas = st.sampled_from([1e-45, 1e-38, 1e-6, 1e-3, 0.5, 1.0, 5.0, 1e3, 1e30, 0.0, -1.0, *BROKEN])
colors = st.sampled_from([0.0, 0.5, 1.0, -3.0, 1e-45, 1e5, *BROKEN])
CUTOFFS = [Cutoffs(), NO_CUTOFFS, Cutoffs(alpha_min=0.0), Cutoffs(x_max=1e30, transmittance_min=0.0)]
OPTIONS = st.fixed_dictionaries(
    {
        "kernel": st.sampled_from(list(KERNELS)),
        "distance": st.sampled_from(DISTANCES),
        "cutoffs": st.sampled_from(CUTOFFS),
        "depth_of": st.sampled_from(["plane", "centroid"]),
        "outputs": st.sets(st.sampled_from(OUTPUTS[2:6])),
        "freeze_inradius": st.booleans(),
    }
)
GOOD = facing([(1.0, 2.0), (11.0, 3.0), (5.0, 10.0)], size=SIZE)


def programs(count):
    """Each kernel, distance, cutoff and output, with several of the others."""
    rng, kernels = random.Random(0), list(KERNELS)
    return [
        {
            "kernel": kernels[index % len(kernels)],
            "distance": DISTANCES[index // len(kernels) % len(DISTANCES)],
            "cutoffs": rng.choice(CUTOFFS),
            "depth_of": rng.choice(["plane", "centroid"]),
            "outputs": {name for name in OUTPUTS[2:6] if rng.random() < 0.5},
            "freeze_inradius": rng.random() < 0.5,
        }
        for index in range(count)
    ]


PROGRAMS = programs(12)


def with_good(vertices, opacity, sigma, color):
    """The fuzzed triangles before and behind a good one."""
    fuzzed = torch.tensor(vertices).reshape(-1, 3, 3)
    count = len(fuzzed) + 1
    scene = dict(GOOD)
    scene["vertices"] = torch.cat([fuzzed, GOOD["vertices"]])
    scene["opacities"] = torch.full((count,), 0.9)
    scene["sigma"] = torch.full((count,), 0.7)
    scene["face_colors"] = torch.full((count, 3), 0.5)
    for name, value in (("opacities", opacity), ("sigma", sigma), ("face_colors", color)):
        scene[name][:-1] = value
    scene["backgrounds"] = torch.ones(1, 3)
    return scene


def options_for(engine):
    """Any on the CPU; those of a few programs on a GPU, whose engine compiles one for each choice."""
    return st.sampled_from(PROGRAMS) if device_of(engine) == "cuda" else OPTIONS


def cotangents_for(options):
    wanted = {"color": 3, "alpha": 1, "depth": 1, "median_depth": 1, "normal": 3, "distortion": 1}
    return {
        name: torch.ones(1, SIZE, SIZE, width)
        for name, width in wanted.items()
        if name in {"color", "alpha", *options["outputs"]}
    }


@pytest.mark.sanitize
@FUZZ
@given(vertices=triangles, opacity=opacities, sigma=sigmas, color=colors, data=st.data())
def test_any_triangles(engine, vertices, opacity, sigma, color, data):
    """Images and all gradients stay finite: what is not finite is invisible, and invisible things have gradient 0."""
    options = data.draw(options_for(engine))
    scene = with_good(vertices, opacity, sigma, color)
    cotangents = cotangents_for(options)
    for dtype in {torch.float32, dtype_of(engine)}:
        out, grads = gradients(
            scene,
            engine,
            cotangents,
            dtype,
            validate=False,
            **{**options, "outputs": {*options["outputs"], "statistics"}},
        )
        for name in cotangents:
            assert getattr(out, name).isfinite().all(), name
        for name, gradient in grads.items():
            assert not gradient.isnan().any(), name
            if gradient.shape[:1] == (len(scene["vertices"]),):
                assert gradient[-1].isfinite().all(), name
        statistics = out.statistics
        assert all(value.isfinite().all() for value in vars(statistics).values())
        invisible = ~statistics.visible[0]
        assert (statistics.max_weight[0, invisible] == 0).all()
        for name in ("vertices", "opacities", "face_colors"):
            assert (grads[name][invisible] == 0).all(), name


@pytest.mark.sanitize
@FUZZ
@given(
    viewmat=st.lists(coordinates, min_size=12, max_size=12),
    focal=st.sampled_from([0.0, -5.0, 1e-30, 12.0, 1e30, *BROKEN]),
    middle=st.sampled_from([0.0, -1e9, 6.0, 1e30, *BROKEN]),
    data=st.data(),
)
def test_any_camera(engine, viewmat, focal, middle, data):
    """A camera of nonsense renders something finite, without validation."""
    options = data.draw(options_for(engine))
    scene = {**with_good([], 1.0, 1.0, 1.0), "viewmats": torch.eye(4)[None].clone(), "Ks": GOOD["Ks"].clone()}
    scene["viewmats"][0, :3] = torch.tensor(viewmat).reshape(3, 4)
    scene["Ks"][0, 0, 0] = focal
    scene["Ks"][0, 0, 2] = middle
    cotangents = cotangents_for(options)
    out, grads = gradients(scene, engine, cotangents, validate=False, **options)
    assert all(getattr(out, name).isfinite().all() for name in cotangents)
    assert not any(gradient.isnan().any() for gradient in grads.values())


@pytest.mark.sanitize
@FUZZ
@given(count=st.integers(0, 3), width=st.integers(1, 70), height=st.integers(1, 70), channels=st.integers(1, 6))
def test_any_size(engine, count, width, height, channels):
    """Images of any size, with any number of triangles and channels."""
    scene = {**GOOD, "width": width, "height": height, "vertices": GOOD["vertices"].expand(count, 3, 3)}
    scene |= {"face_colors": torch.rand(count, channels), "opacities": torch.rand(count), "sigma": torch.tensor(0.5)}
    cotangents = {"color": torch.ones(1, height, width, channels)}
    out, grads = gradients(scene, engine, cotangents, **EVERYTHING)
    assert out.color.shape == (1, height, width, channels)
    assert all(getattr(out, name).isfinite().all() for name in IMAGES)
    assert all(gradient.isfinite().all() for gradient in grads.values())


@pytest.mark.sanitize
@given(faces=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=3, max_size=12))
@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_faces(engine, faces):
    """Indices out of range are refused, or on a GPU make a triangle invisible; repeated ones make one without area."""
    indices = torch.tensor(faces[: len(faces) // 3 * 3]).reshape(-1, 3)
    for tensor in (indices, indices % 4):
        bad = bool(((tensor < 0) | (tensor >= 4)).any())
        dtype = dtype_of(engine)
        arguments = {
            "vertices": torch.tensor([[0, 0, 2], [1, 0, 2], [0, 1, 2], [1, 1, 3]], dtype=dtype),
            "face_colors": torch.ones(len(tensor), 1, dtype=dtype),
            "opacities": torch.ones(len(tensor), dtype=dtype),
            "sigma": 0.5,
            "cameras": Cameras(torch.eye(4, dtype=dtype)[None], GOOD["Ks"].to(dtype), SIZE, SIZE),
        }
        if bad and device_of(engine) == "cuda":
            seen = on(engine, rasterize, **arguments, faces=tensor, outputs=("statistics",)).statistics.visible[0]
            assert not seen[((tensor < 0) | (tensor >= 4)).any(dim=1)].any()
        elif bad:
            with pytest.raises(ValueError, match="faces must be indices from 0 to 3"):
                on(engine, rasterize, **arguments, faces=tensor, validate=False)
        else:
            assert on(engine, rasterize, **arguments, faces=tensor).color.isfinite().all()
