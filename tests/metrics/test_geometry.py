import math

import numpy as np
import pytest
import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.metrics.geometry import (
    chamfer,
    chamfer_exact,
    chamfer_floor,
    exact_squared_distances,
    f_score,
    geometry_metrics,
    sample_pair,
)
from helpers.meshes import TETRAHEDRON, bumpy_sphere, read_obj, vertex_normals

SPHERE = icosphere(5)
SHIFT = torch.tensor([30.0, -4.0, 1.0])


def test_identical_surfaces_land_on_the_floor():
    """The sampled Chamfer distance of a mesh to itself is 2A/(pi N), the exact one is 0, the F-score 1."""
    result = geometry_metrics(*SPHERE, *SPHERE, samples=50_000)
    assert result.chamfer_floor == pytest.approx(2 * 4 * math.pi / (math.pi * 50_000), rel=1e-3)
    assert result.chamfer == pytest.approx(result.chamfer_floor, rel=0.02)
    assert result.chamfer_exact < 1e-28
    assert result.f_score == 1
    assert (result.degenerate_faces, result.self_intersections) == (0, 0)


def test_units_of_the_input_do_not_matter():
    """Moving and scaling both meshes together changes no score, except by rounding."""
    vertices, faces = bumpy_sphere(3, 0)
    truth, true_faces = icosphere(3)
    here = geometry_metrics(vertices.double(), faces, truth.double(), true_faces, samples=2000)
    there = geometry_metrics(
        1e3 * vertices.double() + SHIFT, faces, 1e3 * truth.double() + SHIFT, true_faces, samples=2000
    )
    for name in ("chamfer", "chamfer_floor", "chamfer_exact", "f_score"):
        assert getattr(there, name) == pytest.approx(getattr(here, name), rel=1e-6)


def test_normalisation_is_the_true_mesh_s():
    """A reconstruction that is 1 % too large is scored as such: it is not normalised by itself."""
    vertices, faces = SPHERE
    surface, truth = sample_pair(SHIFT + 7.07 * vertices, faces, SHIFT + 7 * vertices, faces, 20_000)
    distances = exact_squared_distances(surface, truth)
    assert chamfer_exact(*distances) == pytest.approx(2 * 0.01**2, rel=0.02)
    assert chamfer(surface, truth) > chamfer_floor(truth) + 1e-4
    assert f_score(*distances) == 0
    assert f_score(*distances, distance=0.011) == 1


def test_missing_half_costs_recall():
    """With one of two equal objects missing, precision is 1, recall 1/2, and the F-score 2/3."""
    vertices, faces = icosphere(3)
    both = torch.cat([vertices, vertices + 5]), torch.cat([faces, faces + len(vertices)])
    surface, truth = sample_pair(vertices, faces, *both, 20_000)
    assert f_score(*exact_squared_distances(surface, truth)) == pytest.approx(2 / 3, abs=0.01)


def test_f_score_of_nothing_near_is_zero():
    """No sample within the distance on either side gives 0, not a division by zero."""
    assert f_score(np.ones(3), np.ones(3)) == 0


def test_seed_fixes_the_scores():
    """The same seed gives the same scores to the bit, another one others."""
    pairs = [sample_pair(*TETRAHEDRON, *TETRAHEDRON, 1000, seed) for seed in (3, 3, 4)]
    scores = [chamfer(*pair) for pair in pairs]
    assert scores[0] == scores[1] != scores[2]


def test_surface_without_area_is_refused():
    """A collapsed reconstruction raises instead of scoring."""
    vertices, faces = SPHERE
    with pytest.raises(ValueError, match="zero area"):
        geometry_metrics(0 * vertices, faces, vertices, faces)


def test_inflated_bunny_has_the_published_values(shared_data):
    """Chamfer of bunny_hr inflated by d along its normals: 0.034, 0.046, 0.084, 0.233 times 1e-3, as documented."""
    vertices, faces = read_obj(shared_data / "famous" / "bunny_hr.obj")
    normals = vertex_normals(vertices, faces)
    for d, expected in [(0.0, 0.0336), (0.0025, 0.046), (0.005, 0.084), (0.01, 0.233)]:
        surface, truth = sample_pair(vertices + d * normals, faces, vertices, faces)
        assert 1e3 * chamfer(surface, truth) == pytest.approx(expected, rel=0.01)
        assert chamfer_exact(*exact_squared_distances(surface, truth)) == pytest.approx(2 * d * d, rel=0.02, abs=1e-20)
    assert 1e3 * chamfer_floor(truth) == pytest.approx(0.0337, abs=5e-5)


@pytest.mark.parametrize(
    ("odd", "text"),
    [
        ({"samples": 0}, "samples must be an integer from 1 to 100000000, got 0"),
        ({"samples": 2**40}, "samples must be an integer from 1"),
        ({"samples": 0.5}, "samples must be an integer from 1"),
        ({"seed": -1}, "seed must be an integer of at least 0, got -1"),
        ({"seed": None}, "seed must be an integer"),
        ({"faces": torch.tensor([[0, 1, 12]])}, "faces must be indices from 0 to 11"),
        ({"true_faces": torch.tensor([[0, 1, -1]])}, "true_faces must be indices from 0 to 11"),
        ({"faces": torch.tensor([[0.0, 1.0, 2.0]])}, "faces must be int32 or int64"),
        ({"true_vertices": torch.zeros(0, 3)}, "true_vertices must have at least one row"),
    ],
)
def test_arguments_out_of_range_are_refused_by_name(odd, text):
    points, faces = icosphere(0)
    both = {"vertices": points, "faces": faces, "true_vertices": points, "true_faces": faces, "samples": 20}
    with pytest.raises(ValueError, match=text):
        geometry_metrics(**{**both, **odd})


def test_a_true_surface_of_an_earlier_pair_is_not_sampled_again() -> None:
    vertices, faces = icosphere(2)
    first, truth = sample_pair(vertices, faces, 1.1 * vertices, faces, 500)
    again, same = sample_pair(0.9 * vertices, faces, 1.1 * vertices, faces, 500, truth=truth)
    alone = sample_pair(0.9 * vertices, faces, 1.1 * vertices, faces, 500)
    assert same is truth
    assert not torch.equal(first.points, again.points)
    assert chamfer(again, same) == chamfer(*alone)
