"""Native code of etsplat. This file is made by `make stubs`."""

import enum
from collections.abc import Sequence

import numpy
import numpy.typing
import torch

def num_threads() -> int: ...
def set_num_threads(count: int) -> None: ...
def parallel_seconds() -> float: ...
def reset_parallel_seconds() -> None: ...
def adam_step(
    *,
    parameters: Sequence[torch.Tensor],
    gradients: Sequence[torch.Tensor],
    firsts: Sequence[torch.Tensor],
    seconds: Sequence[torch.Tensor],
    paces: Sequence[torch.Tensor | None],
    learning_rates: Sequence[float],
    decays: Sequence[float],
    beta1: float,
    beta2: float,
    eps: float,
    step: int,
) -> None: ...

class AntialiasState:
    pass

class ColorsOf(enum.IntEnum):
    FACES = 0

    VERTICES = 1

    CORNERS = 2

    PIXELS = 3

class ShadedViews:
    def __init__(
        self,
        *,
        vertices: torch.Tensor,
        faces: torch.Tensor,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        triangle: torch.Tensor,
        barycentrics: torch.Tensor,
        colors: torch.Tensor,
        colors_of: ColorsOf,
        backgrounds: torch.Tensor | None,
    ) -> None: ...

class Silhouettes:
    def __init__(
        self, *, near_plane: float, pair_offsets: torch.Tensor, paired_faces: torch.Tensor, depth: torch.Tensor
    ) -> None: ...

def shade(*, views: ShadedViews, shaded: torch.Tensor) -> None: ...
def shade_backward(
    *,
    views: ShadedViews,
    grad_shaded: torch.Tensor,
    grad_vertices: torch.Tensor | None,
    grad_colors: torch.Tensor | None,
) -> None: ...
def texture_detail(*, views: ShadedViews, depth: torch.Tensor, width: int, height: int, lod: torch.Tensor) -> None: ...
def antialias_forward(
    *, views: ShadedViews, silhouettes: Silhouettes, shaded: torch.Tensor, color: torch.Tensor
) -> list[AntialiasState]: ...
def antialias_behind(
    *, views: ShadedViews, silhouettes: Silhouettes, shaded: torch.Tensor, color: torch.Tensor
) -> None: ...
def antialias_backward(
    *,
    states: Sequence[AntialiasState],
    views: ShadedViews,
    silhouettes: Silhouettes,
    grad_color: torch.Tensor,
    shaded: torch.Tensor,
    scratch: torch.Tensor,
    grad_vertices: torch.Tensor | None,
    grad_colors: torch.Tensor | None,
    grad_backgrounds: torch.Tensor | None,
) -> None: ...

class FloatScan:
    @property
    def unusable(self) -> int: ...
    @property
    def minimum(self) -> float: ...

def scan_floats(*, values: torch.Tensor, largest: float) -> FloatScan: ...
def indices_below(*, values: torch.Tensor, bound: int) -> bool: ...
def are_intrinsics(*, Ks: torch.Tensor) -> bool: ...
def sum_by_index(*, values: torch.Tensor, indices: torch.Tensor, sums: torch.Tensor) -> None: ...
def gather_rows(*, values: torch.Tensor, indices: torch.Tensor, rows: torch.Tensor) -> None: ...

TILE: int = 16

TRIANGLE_RECORD: int = 16

ATTRIBUTE_RECORD: int = 8

CAMERA_GRADIENTS: int = 16

MOST_GPU_CHANNELS: int = 16

MAX_SH_DEGREE: int = 3

OPAQUE_PARTS: int = 3

class DistortionDepth(enum.IntEnum):
    NONE = 0

    PLANE = 1

    CENTROID = 2

def slot_stride(*, flat_channels: int, corner_channels: int, distortion: DistortionDepth) -> int: ...
def select_edge_splits(
    *,
    order: torch.Tensor,
    longest_edge: torch.Tensor,
    edge_face_offsets: torch.Tensor,
    edge_faces: torch.Tensor,
    split_edge: torch.Tensor,
    max_new_faces: int,
) -> None: ...
def flip_edges(
    *,
    vertices: torch.Tensor,
    edges: torch.Tensor,
    edge_faces: torch.Tensor,
    face_edges: torch.Tensor,
    faces: torch.Tensor,
    valences: torch.Tensor,
    least_cosine: float,
    rounds: int,
) -> int: ...

class FaceTree:
    pass

def face_tree(*, vertices: torch.Tensor, faces: torch.Tensor) -> FaceTree: ...
def move_face_tree(*, tree: FaceTree, vertices: torch.Tensor, faces: torch.Tensor) -> None: ...
def closest_faces(
    *, tree: FaceTree, points: torch.Tensor, squared_distances: torch.Tensor, closest: torch.Tensor
) -> None: ...
def mark_intersecting_faces(*, tree: FaceTree, again: torch.Tensor | None, intersecting: torch.Tensor) -> None: ...
def overlapping_boxes(*, tree: FaceTree) -> numpy.typing.NDArray[numpy.int64]: ...
def count_crossings(
    *, points: torch.Tensor, own: torch.Tensor, vertices: torch.Tensor, faces: torch.Tensor, counts: torch.Tensor
) -> None: ...
def add_halving_sums(
    *,
    face: torch.Tensor,
    barycentrics: torch.Tensor,
    lacking: torch.Tensor,
    counted: torch.Tensor,
    longest: torch.Tensor,
    sums: torch.Tensor,
) -> None: ...
def halving_gains(*, sums: torch.Tensor, gains: torch.Tensor) -> None: ...
def mesh_energies(
    *,
    vertices: torch.Tensor,
    faces: torch.Tensor,
    neighbor_offsets: torch.Tensor,
    neighbor_indices: torch.Tensor,
    corner_offsets: torch.Tensor,
    corners: torch.Tensor,
    pair_offsets: torch.Tensor,
    paired_faces: torch.Tensor,
    edge_power: int,
    gradients: torch.Tensor,
) -> list[float]: ...
def combine_mesh_gradients(*, gradients: torch.Tensor, weights: Sequence[float], combined: torch.Tensor) -> None: ...
def normal_agreement(
    *,
    normals: torch.Tensor,
    depth: torch.Tensor,
    alpha: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    by_normals: torch.Tensor | None,
    by_depth: torch.Tensor | None,
) -> float: ...
def photo_agreement(
    *,
    pixels: Sequence[torch.Tensor],
    masks: Sequence[torch.Tensor],
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    centers: torch.Tensor,
    points: torch.Tensor,
    normals: torch.Tensor,
    seen: torch.Tensor,
    patch: int,
    asked: int,
    slant: float,
    flat: float,
    whole: float,
    fewest: int,
    pixel: float,
    result: torch.Tensor,
) -> None: ...
def add_differences(
    *,
    pixels: torch.Tensor,
    opaque: float,
    seen: torch.Tensor,
    shown: Sequence[torch.Tensor],
    colors: torch.Tensor,
    sums: torch.Tensor,
) -> None: ...
def propagate_beliefs(
    *, cost: torch.Tensor, edges: torch.Tensor, bend: float, tear: float, rounds: int, belief: torch.Tensor
) -> None: ...
def photometric(
    *,
    color: torch.Tensor,
    target: torch.Tensor,
    backgrounds: torch.Tensor | None,
    mask: torch.Tensor | None,
    gradient: torch.Tensor | None,
    squared: bool,
    dssim_weight: float,
) -> float: ...
def plane_sweep(
    *,
    grey: torch.Tensor,
    mean: torch.Tensor,
    variance: torch.Tensor,
    neighbours: Sequence[torch.Tensor],
    rays: torch.Tensor,
    starts: torch.Tensor,
    inverse: torch.Tensor,
    window: int,
    agreeing: int,
    beside: int,
    least_variance: float,
    least_depth: float,
    place: torch.Tensor,
    best: torch.Tensor,
    elsewhere: torch.Tensor,
) -> None: ...
def pool_idle_bytes() -> int: ...
def empty_floats(*, shape: Sequence[int]) -> torch.Tensor: ...
def zero_floats(*, shape: Sequence[int]) -> torch.Tensor: ...
def copied_indices(*, values: torch.Tensor) -> torch.Tensor: ...

class RasterState:
    @property
    def bytes(self) -> int: ...
    @property
    def num_pairs(self) -> int: ...
    @property
    def stage_seconds(self) -> dict[str, tuple[float, float]]: ...

class RasterBatch:
    def __init__(
        self,
        *,
        vertices: torch.Tensor,
        faces: torch.Tensor | None,
        flat_colors: torch.Tensor | None,
        corner_colors: torch.Tensor | None,
        opacities: torch.Tensor,
        sigmas: torch.Tensor,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        backgrounds: torch.Tensor | None,
        kernel_table: torch.Tensor | None,
        kernel: int,
        distance: int,
        freeze_inradius: bool,
        near_plane: float,
        alpha_min: float,
        alpha_max: float,
        x_max: float,
        transmittance_min: float,
        distortion_near: float,
        distortion_far: float,
        centroid_depth: bool,
        color: torch.Tensor,
        alpha: torch.Tensor,
        distortion: torch.Tensor | None,
        distortion_totals: torch.Tensor | None,
    ) -> None: ...

class RasterGradients:
    def __init__(
        self,
        *,
        grad_color: torch.Tensor,
        grad_alpha: torch.Tensor | None,
        grad_distortion: torch.Tensor | None,
        vertices: torch.Tensor | None,
        flat_colors: torch.Tensor | None,
        corner_colors: torch.Tensor | None,
        opacities: torch.Tensor | None,
        sigmas: torch.Tensor | None,
        viewmats: torch.Tensor | None,
        Ks: torch.Tensor | None,
        backgrounds: torch.Tensor | None,
    ) -> None: ...

def raster_forward(
    *,
    batch: RasterBatch,
    keep_for_backward: bool,
    median_triangle: torch.Tensor | None,
    max_weight: torch.Tensor | None,
    screen_size: torch.Tensor | None,
    inradius: torch.Tensor | None,
    visible: torch.Tensor | None,
) -> list[RasterState]: ...
def raster_backward(*, states: Sequence[RasterState], batch: RasterBatch, gradients: RasterGradients) -> None: ...
def available_instruction_sets() -> list[str]: ...
def instruction_set() -> str: ...
def set_instruction_set(name: str) -> None: ...
def kernel_names() -> list[str]: ...

class TileCounts:
    @property
    def pairs(self) -> int: ...
    @property
    def forward_vectors(self) -> int: ...
    @property
    def backward_vectors(self) -> int: ...
    @property
    def drawn(self) -> int: ...

class KernelNanoseconds:
    @property
    def value(self) -> float: ...
    @property
    def gradient(self) -> float: ...

def count_tiles(*, state: RasterState) -> TileCounts: ...
def time_kernel(*, kernel: int, sigma: float) -> KernelNanoseconds: ...
def rasterize_opaque(
    *,
    vertices: torch.Tensor,
    faces: torch.Tensor,
    viewmat: torch.Tensor,
    K: torch.Tensor,
    near_plane: float,
    triangle: torch.Tensor,
    barycentrics: torch.Tensor | None,
    depth: torch.Tensor,
) -> None: ...
def rasterize_behind(
    *,
    vertices: torch.Tensor,
    faces: torch.Tensor,
    viewmat: torch.Tensor,
    K: torch.Tensor,
    near_plane: float,
    triangle: torch.Tensor,
    barycentrics: torch.Tensor,
    depth: torch.Tensor,
) -> None: ...
def enter_and_leave(
    *,
    vertices: torch.Tensor,
    faces: torch.Tensor,
    viewmat: torch.Tensor,
    K: torch.Tensor,
    near_plane: float,
    turned: torch.Tensor,
    entered: torch.Tensor,
    left: torch.Tensor,
) -> None: ...
def render_opaque(
    *,
    vertices: torch.Tensor,
    faces: torch.Tensor,
    viewmat: torch.Tensor,
    K: torch.Tensor,
    near_plane: float,
    colors: torch.Tensor,
    per_face: bool,
    supersampling: int,
    cull_backfaces: bool,
    image: torch.Tensor,
) -> None: ...
def lowest_depths(
    *,
    distances: Sequence[torch.Tensor],
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    whole: torch.Tensor,
    points: torch.Tensor,
    own: torch.Tensor | None,
    grown: float,
    in_units: bool,
    depth: torch.Tensor,
    judges: torch.Tensor,
) -> None: ...
def exclusion_costs(
    *,
    distances: Sequence[torch.Tensor],
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    whole: torch.Tensor,
    points: torch.Tensor,
    most: torch.Tensor,
    cost: torch.Tensor,
) -> None: ...
def soup_activate(
    *,
    vertices: torch.Tensor,
    logits: torch.Tensor,
    raw: torch.Tensor,
    viewmats: torch.Tensor | None,
    Ks: torch.Tensor | None,
    smallest: float,
    largest: float,
    numbers: Sequence[float],
    opacities: torch.Tensor,
    sigma: torch.Tensor,
) -> None: ...
def soup_activate_backward(
    *,
    logits: torch.Tensor,
    raw: torch.Tensor,
    opacities: torch.Tensor,
    numbers: Sequence[float],
    grad_opacities: torch.Tensor | None,
    grad_sigma: torch.Tensor | None,
    grad_logits: torch.Tensor,
    grad_raw: torch.Tensor,
) -> None: ...
def soup_colors(
    *,
    corners: torch.Tensor,
    dc: torch.Tensor,
    rest: torch.Tensor,
    centers: torch.Tensor,
    degree: int,
    colors: torch.Tensor,
) -> None: ...
def soup_colors_backward(
    *,
    corners: torch.Tensor,
    dc: torch.Tensor,
    rest: torch.Tensor,
    centers: torch.Tensor,
    degree: int,
    colors: torch.Tensor,
    grad_colors: torch.Tensor,
    grad_corners: torch.Tensor,
    grad_dc: torch.Tensor,
    grad_rest: torch.Tensor,
) -> None: ...
def spherical_harmonics(
    *, coefficients: torch.Tensor, directions: torch.Tensor, degree: int, colors: torch.Tensor
) -> None: ...
def spherical_harmonics_backward(
    *,
    coefficients: torch.Tensor,
    directions: torch.Tensor,
    degree: int,
    colors: torch.Tensor,
    grad_colors: torch.Tensor,
    grad_coefficients: torch.Tensor,
    grad_directions: torch.Tensor,
) -> None: ...
def texture_levels(*, texture: torch.Tensor, levels: int, coarser: torch.Tensor) -> None: ...

class SampledTexture:
    def __init__(
        self,
        *,
        texture: torch.Tensor,
        coarser: torch.Tensor | None,
        levels: int,
        uv: torch.Tensor,
        lod: torch.Tensor | None,
    ) -> None: ...

def sample_texture(*, sampled: SampledTexture, values: torch.Tensor) -> None: ...
def sample_texture_backward(
    *,
    sampled: SampledTexture,
    grad_values: torch.Tensor,
    grad_texture: torch.Tensor | None,
    grad_coarser: torch.Tensor | None,
    grad_uv: torch.Tensor | None,
) -> None: ...
def mean_area(*, vertices: torch.Tensor, gradient: torch.Tensor) -> float: ...
def triangle_channels(
    *, corners: torch.Tensor, viewmats: torch.Tensor, depth: bool, normals: bool, channels: torch.Tensor
) -> None: ...
def triangle_channels_backward(
    *,
    corners: torch.Tensor,
    viewmats: torch.Tensor,
    depth: bool,
    normals: bool,
    grad_channels: torch.Tensor,
    grad_corners: torch.Tensor,
) -> None: ...
