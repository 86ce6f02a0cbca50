"""How far a reconstructed surface is from the true one.

Convention: both meshes are moved and scaled by the true mesh's normalisation (centre of the bounding box to the origin,
farthest vertex to distance 1), so that the numbers do not depend on the units of the input. Distances are Euclidean,
Chamfer distances squared and summed over both directions; multiply by 1000 to compare with the paper's tables.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from etsplat.core.validation import check_count, check_indices, check_shape, dense
from etsplat.geometry.distance import closest_points
from etsplat.geometry.intersections import count_degenerate_faces, count_self_intersections
from etsplat.geometry.measures import bounding_ball, face_areas
from etsplat.geometry.sampling import sample_surface

SAMPLES = 100_000
MAX_SAMPLES = 100_000_000
F_SCORE_DISTANCE = 0.005


@dataclass(frozen=True)
class GeometryMetrics:
    """Scores of a reconstructed mesh (module docstring: convention and units).

    Attributes:
        chamfer: squared two-sided sum between samples of both surfaces, as the paper's; never much below the floor.
        chamfer_floor: what `chamfer` comes to for a perfect reconstruction.
        chamfer_exact: squared two-sided sum from the samples to the other surface; 0 for a perfect reconstruction.
        f_score: harmonic mean of the two fractions of samples nearer than 0.005 to the other surface, in [0, 1].
        degenerate_faces: faces without a usable shape (`count_degenerate_faces`).
        self_intersections: faces that cut through others (`count_self_intersections`).

    Example:
        >>> owl = etsplat.demo_object()
        >>> etsplat.geometry_metrics(owl.vertices, owl.faces, owl.vertices, owl.faces, samples=1000).f_score
        1.0
    """

    chamfer: float
    chamfer_floor: float
    chamfer_exact: float
    f_score: float
    degenerate_faces: int
    self_intersections: int


@dataclass(frozen=True)
class Surface:
    """A mesh in the frame of the true one, with samples drawn from it.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3).
        points: (N, 3) float64, independent and uniform in area.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    points: Float[Tensor, "N 3"]

    @cached_property
    def tree(self) -> KDTree:
        """Of the points."""
        return KDTree(self.points.numpy())


def sample_pair(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    true_vertices: Float[Tensor, "Vt 3"],
    true_faces: Int[Tensor, "Ft 3"],
    samples: int = SAMPLES,
    seed: int = 0,
    truth: Surface | None = None,
) -> tuple[Surface, Surface]:
    """Both surfaces, reconstructed and true, in the true one's normalisation, with independent samples.

    Args:
        vertices: (V, 3) reconstructed.
        faces: (F, 3).
        true_vertices: (Vt, 3).
        true_faces: (Ft, 3).
        samples: points drawn from each surface.
        seed: of the samples.
        truth: the true surface of an earlier pair with all else alike, which is then not sampled again.

    Raises:
        ValueError: a mesh has no area or is not finite, or an argument has a wrong shape, dtype or range.
    """
    meshes = {"vertices": vertices, "faces": faces, "true_vertices": true_vertices, "true_faces": true_faces}
    for name, given in meshes.items():
        check_shape(name, given, ("N", 3))
        if len(given) == 0:
            raise ValueError(f"{name} must have at least one row, got none")
    check_indices("faces", faces, len(vertices))
    check_indices("true_faces", true_faces, len(true_vertices))
    samples = check_count("samples", samples, most=MAX_SAMPLES)
    seed = check_count("seed", seed, least=0)
    center, radius = bounding_ball(true_vertices)

    def sampled(points: Tensor, triangles: Tensor, side: int) -> Surface:
        normalized, triangles = (points.detach().cpu().double() - center.cpu()) / radius, dense(triangles).cpu()
        return Surface(normalized, triangles, sample_surface(normalized, triangles, samples, (seed, side))[0])

    return sampled(vertices, faces, 0), truth or sampled(true_vertices, true_faces, 1)


def chamfer(surface: Surface, truth: Surface, queries: int | None = None) -> float:
    """Mean squared distance to the nearest sample of the other surface, summed over both directions.

    Args:
        surface: the reconstructed one.
        truth: the true one.
        queries: look from this many samples of each side only (still at all of the other side): an estimate of the
            same number in less time, which matters for surfaces that are far apart, where a k-d tree prunes little.
    """
    to_truth, _ = truth.tree.query(surface.points[:queries].numpy(), workers=-1)
    to_surface, _ = surface.tree.query(truth.points[:queries].numpy(), workers=-1)
    return float(np.mean(to_truth**2) + np.mean(to_surface**2))


def chamfer_floor(truth: Surface) -> float:
    """What `chamfer` comes to between two independent sample sets of the same surface: 2 A / (pi N).

    With N points per area A, the squared distance to the nearest has mean A / (pi N), once for each direction.
    """
    area = float(face_areas(truth.vertices, truth.faces).sum())
    return 2 * area / (math.pi * len(truth.points))


def exact_squared_distances(surface: Surface, truth: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances (N,) from each surface's samples to the other surface itself, not to its samples."""
    to_truth, _ = closest_points(surface.points, truth.vertices, truth.faces)
    to_surface, _ = closest_points(truth.points, surface.vertices, surface.faces)
    return to_truth.numpy(), to_surface.numpy()


def chamfer_exact(to_truth: np.ndarray, to_surface: np.ndarray) -> float:
    """Mean squared distance to the other surface, summed over both directions (`exact_squared_distances`)."""
    return float(np.mean(to_truth) + np.mean(to_surface))


def f_score(to_truth: np.ndarray, to_surface: np.ndarray, distance: float = F_SCORE_DISTANCE) -> float:
    """Harmonic mean of precision and recall: the fractions of squared distances that are below distance^2."""
    precision, recall = (float(np.mean(squared < distance**2)) for squared in (to_truth, to_surface))
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def geometry_metrics(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    true_vertices: Float[Tensor, "Vt 3"],
    true_faces: Int[Tensor, "Ft 3"],
    *,
    samples: int = SAMPLES,
    seed: int = 0,
) -> GeometryMetrics:
    """Every score of a reconstructed mesh against the true one, both given in the same units.

    Args:
        vertices: (V, 3) reconstructed.
        faces: (F, 3).
        true_vertices: (Vt, 3).
        true_faces: (Ft, 3).
        samples: points drawn from each surface, 1 to 100 million. The floor of `chamfer` falls with it.
        seed: of the samples.

    Raises:
        ValueError: a mesh has no area or is not finite, or an argument has a wrong shape, dtype or range.

    Example:
        >>> (coarse, coarse_faces), (fine, fine_faces) = etsplat.icosphere(2), etsplat.icosphere(4)
        >>> scores = etsplat.geometry_metrics(coarse, coarse_faces, fine, fine_faces, samples=5000)
        >>> 0 < scores.chamfer < 0.01
        True
    """
    surface, truth = sample_pair(vertices, faces, true_vertices, true_faces, samples, seed)
    distances = exact_squared_distances(surface, truth)
    return GeometryMetrics(
        chamfer=chamfer(surface, truth),
        chamfer_floor=chamfer_floor(truth),
        chamfer_exact=chamfer_exact(*distances),
        f_score=f_score(*distances),
        degenerate_faces=count_degenerate_faces(surface.vertices, surface.faces),
        self_intersections=count_self_intersections(surface.vertices, surface.faces),
    )
