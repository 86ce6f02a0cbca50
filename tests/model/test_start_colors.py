"""Colours that models start with are taken as people have them, and refused where they are no such numbers."""

import numpy as np
import pytest
import torch

from etsplat import TriangleMesh, TriangleSoup, icosphere

VERTICES, FACES = icosphere(1)
LOOK = {"opacity": 0.9, "sigma": 0.3}
ONE = (0.25, 0.5, 0.75)


def mesh(colors=0.5, **given):
    return TriangleMesh.from_mesh(given.pop("vertices", VERTICES), FACES, colors=colors, **{**LOOK, **given})


def soup(colors):
    return TriangleSoup.from_triangles(VERTICES[FACES], colors, **LOOK, sh_degree=1)


@pytest.mark.parametrize("one", [ONE, list(ONE), torch.tensor(ONE), torch.tensor([ONE] * 80)])
def test_three_numbers_are_the_colour_of_all(one):
    assert mesh(one).colors.detach().equal(torch.tensor([ONE] * 80))
    assert soup(one).sh_dc.detach().equal(soup(torch.tensor([ONE] * 80)).sh_dc)


@pytest.mark.parametrize("grey", [0.5, np.float32(0.5), np.float64(0.5), torch.tensor(0.5), np.array(0.5)])
def test_a_number_of_any_library_is_a_grey(grey):
    assert mesh(grey).colors.detach().equal(torch.full((80, 3), 0.5))
    assert soup(grey).sh_dc.detach().equal(torch.zeros(80, 1, 3))


@pytest.mark.parametrize("make", [mesh, soup])
@pytest.mark.parametrize(
    ("colors", "message"),
    [
        (torch.zeros(80, 3, dtype=torch.uint8), r"colors must be floats in \[0, 1\], got torch\.uint8: divide bytes"),
        (torch.full((80, 3), 200.0), r"colors must be in \[0, 1\], got 200 to 200"),
        (torch.full((80, 3), torch.nan), r"colors must be in \[0, 1\], got nan"),
        (255, "colors must be from 0 to 1, got 255"),
        (torch.zeros(79, 3), r"colors must have shape .*=80, got \(79, 3\)"),
        ("red", "colors must be a tensor of shape"),
        (None, "colors must be a tensor of shape"),
    ],
)
def test_what_are_no_colours_is_refused(make, colors, message):
    """Bytes were taken, and became colours of up to 255."""
    with pytest.raises(ValueError, match=message):
        make(colors)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"vertices": (VERTICES * 9).long()}, r"vertices must be of floating-point numbers, got torch\.int64"),
        ({"vertices": VERTICES * torch.inf}, "vertices must be finite, got"),
        ({"appearance": "bilateral"}, "appearance must be a MeshAppearance, got 'bilateral'"),
    ],
)
def test_meshes_are_made_of_what_can_be_drawn(given, message):
    with pytest.raises(ValueError, match=message):
        mesh(**given)
