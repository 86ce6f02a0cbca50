"""Distortion of other programs' cameras: read as what their formulas mean, refused in training, removed once."""

import math

import numpy as np
import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.frames import Wanted
from etsplat.data.load import format_of, load_dataset
from etsplat.data.undistortion import undistort_scene
from helpers import foreign_captures as foreign

K1, K2, K3, P1, P2 = -0.11, 0.03, -0.007, 0.004, -0.009


def bundler(x, y):
    """Section VI of its manual; p has y up."""
    r2 = x * x + y * y
    return x * (1 + K1 * r2 + K2 * r2 * r2), y * (1 + K1 * r2 + K2 * r2 * r2)


def radial(x, y):
    r2 = x * x + y * y
    grown = 1 + K1 * r2 + K2 * r2**2 + K3 * r2**3
    return x * grown, y * grown


def openmvg_brown(x, y):
    """Of t1, t2 = P1, P2: t2 goes with r^2 + 2 x^2."""
    r2, (u, v) = x * x + y * y, radial(x, y)
    return u + P2 * (r2 + 2 * x * x) + 2 * P1 * x * y, v + P1 * (r2 + 2 * y * y) + 2 * P2 * x * y


def metashape(x, y):
    """The appendix of its manual: p1 goes with r^2 + 2 x^2."""
    r2, (u, v) = x * x + y * y, radial(x, y)
    return u + P1 * (r2 + 2 * x * x) + 2 * P2 * x * y, v + P2 * (r2 + 2 * y * y) + 2 * P1 * x * y


def by_angle(x, y):
    """Fisheye: theta (1 + k1 theta^2 + ...), as OpenMVG and AliceVision have it."""
    r = math.hypot(x, y)
    angle = math.atan(r)
    grown = angle * (1 + K1 * angle**2 + K2 * angle**4 + K3 * angle**6 + 0.001 * angle**8) / r
    return x * grown, y * grown


def metashape_fisheye(x, y):
    """Its manual turns x and y by the angle first, and then multiplies by a polynomial of the new radius."""
    r = math.hypot(x, y)
    u, v = x * math.atan(r) / r, y * math.atan(r) / r
    r2 = u * u + v * v
    grown = 1 + K1 * r2 + K2 * r2**2 + K3 * r2**3 + 0.001 * r2**4
    return u * grown, v * grown


def opensfm_fisheye(x, y):
    """Theta (1 + k1 theta^2 + k2 theta^4), by its documentation."""
    r = math.hypot(x, y)
    angle = math.atan(r)
    grown = angle * (1 + K1 * angle**2 + K2 * angle**4) / r
    return x * grown, y * grown


def numbers(**values):
    return "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())


FISHEYE = [K1, K2, K3, 0.001]
RADIAL = {"k1": K1, "k2": K2, "k3": K3}

CASES = {
    "bundler": (foreign.write_bundler, {"k": (K1, K2)}, bundler),
    "openmvg k3": (
        foreign.write_openmvg,
        {"kind": "pinhole_radial_k3", "disto": ("disto_k3", [K1, K2, K3])},
        radial,
    ),
    "openmvg brown": (
        foreign.write_openmvg,
        {"kind": "pinhole_brown_t2", "disto": ("disto_t2", [K1, K2, K3, P1, P2])},
        openmvg_brown,
    ),
    "openmvg fisheye": (foreign.write_openmvg, {"kind": "fisheye", "disto": ("fisheye", FISHEYE)}, by_angle),
    "meshroom radial3": (foreign.write_meshroom, {"params": [K1, K2, K3]}, radial),
    "meshroom radialk3": (
        foreign.write_meshroom,
        {"kind": "pinhole", "distortion": "radialk3", "params": [K1, K2, K3]},
        radial,
    ),
    "meshroom brown": (foreign.write_meshroom, {"kind": "brown", "params": [K1, K2, K3, P1, P2]}, openmvg_brown),
    "meshroom fisheye": (foreign.write_meshroom, {"kind": "fisheye4", "params": FISHEYE}, by_angle),
    "metashape": (foreign.write_metashape, {"numbers": numbers(**RADIAL, p1=P1, p2=P2)}, metashape),
    "metashape fisheye": (
        foreign.write_metashape,
        {"kind": "fisheye", "numbers": numbers(**RADIAL, k4=0.001)},
        metashape_fisheye,
    ),
    "opensfm perspective": (
        foreign.write_opensfm,
        {"kind": "perspective", "coefficients": {"k1": K1, "k2": K2}},
        bundler,
    ),
    "opensfm brown": (foreign.write_opensfm, {"coefficients": {**RADIAL, "p1": P1, "p2": P2}}, openmvg_brown),
    "opensfm fisheye": (
        foreign.write_opensfm,
        {"kind": "fisheye", "coefficients": {"k1": K1, "k2": K2}},
        opensfm_fisheye,
    ),
    "opensfm fisheye_opencv": (
        foreign.write_opensfm,
        {"kind": "fisheye_opencv", "coefficients": {**RADIAL, "k4": 0.001}},
        by_angle,
    ),
    # Its template for OpenCV writes t2, t1 where OpenCV has p1, p2: t1 goes with r^2 + 2 x^2.
    "reality capture csv": (foreign.write_reality_capture_csv, {"coefficients": (K1, K2, K3, 0, P1, P2)}, metashape),
    "reality capture xmp": (
        foreign.write_reality_capture_xmp,
        {"coefficients": (K1, K2, K3, 0, P1, P2), "model": "brown3t2"},
        metashape,
    ),
}


def opencv(lens, x, y):
    """OpenCV's documented models, by COLMAP's names and order of the coefficients."""
    r2 = x * x + y * y
    if lens.model == "OPENCV_FISHEYE":
        k1, k2, k3, k4 = lens.coefficients
        angle = math.atan(math.sqrt(r2))
        grown = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8) / math.sqrt(r2)
        return x * grown, y * grown
    k1, k2, p1, p2, k3, *rational = (*lens.coefficients, 0.0, 0.0)[: 8 if lens.model == "FULL_OPENCV" else 5]
    assert not any(rational)
    grown = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return x * grown + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * grown + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


@pytest.mark.parametrize("case", CASES)
def test_points_are_seen_where_the_programs_formula_puts_them(tmp_path, case):
    """And training on the photos as they are is refused with the remedy."""
    write, settings, formula = CASES[case]
    write(tmp_path, foreign.truth(centered=True), **settings)
    frame = format_of(tmp_path).list_frames(tmp_path, Wanted()).frames[1]
    assert frame.lens is not None
    for x, y in ((0.31, -0.22), (-0.4, 0.15), (0.05, 0.35)):
        assert opencv(frame.lens, x, y) == pytest.approx(formula(x, y), abs=1e-12)
    with pytest.raises(InputError, match="etsplat data undistort"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("case", ["bundler", "openmvg fisheye", "metashape", "reality capture xmp", "opensfm brown"])
def test_undistort_takes_every_layout(tmp_path, case):
    """A dot that the lens saw is afterwards where a camera without lens sees it; cameras keep their places."""
    pytest.importorskip("pycolmap")
    write, settings, formula = CASES[case]
    capture = foreign.truth(3, centered=True)
    sizes = [(160, 120)] * 3
    K = torch.tensor([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]], dtype=torch.float64)
    ray = (0.3, -0.2)
    u, v = formula(*ray)
    rows, columns = np.mgrid[:120, :160] + 0.5
    squares = (columns - (150 * u + 80)) ** 2 + (rows - (150 * v + 60)) ** 2
    dot = np.repeat((255 * np.exp(-squares / 8)).astype(np.uint8)[..., None], 3, axis=2)
    capture = foreign.Truth(
        capture.names, sizes, capture.viewmats, K.expand(3, 3, 3), [dot] * 3, capture.points, capture.colors
    )
    write(tmp_path / "scene", capture, **settings)
    undistort_scene(tmp_path / "scene", tmp_path / "new")
    found = load_dataset(tmp_path / "new")
    weight = found.images[1][..., 0].double()
    x = (weight.sum(dim=0) * (torch.arange(weight.shape[1]) + 0.5)).sum() / weight.sum()
    y = (weight.sum(dim=1) * (torch.arange(weight.shape[0]) + 0.5)).sum() / weight.sum()
    expected = (found.Ks[1] @ torch.tensor([*ray, 1.0], dtype=torch.float64))[:2]
    torch.testing.assert_close(torch.stack([x, y]), expected, atol=0.3, rtol=0)
    torch.testing.assert_close(found.viewmats, capture.viewmats, atol=1e-6, rtol=0)
    assert found.exact_points is not None
    assert len(found.exact_points) == len(capture.points)
