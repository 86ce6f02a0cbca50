"""Settings of shape reconstruction: every choice that the result depends on, with its presets."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from etsplat.core.errors import InputError

if TYPE_CHECKING:
    from etsplat.model.mesh_rendering import MeshAppearance

Method = Literal["elastic", "bilateral", "single-sided", "raster-face", "raster-vertex"]
METHODS: tuple[Method, ...] = get_args(Method)
Preset = Literal["best", "paper", "study", "quick", "demo", "tiny"]


@dataclass(frozen=True)
class ReconstructConfig:
    """Settings of `etsplat.reconstruct`; the defaults are preset "paper"."""

    preset: Preset = "paper"
    """Where the other settings start from; in Python, begin with `PRESETS[name]` instead.
    best: the closest to the truth that we know, a quarter of an hour on four cores;
    quick: the same in a minute;
    paper: the paper's method at its budget;
    study: the paper's method in two minutes, for comparisons;
    demo, tiny: for `etsplat demo` and for tests."""
    method: Method = "elastic"
    """Kernel of soft triangles: elastic (the paper's), bilateral (2DTS) or single-sided (Triangle Splatting).
    Opaque triangles with antialiased silhouettes: raster-face or raster-vertex (a colour per face or per vertex)."""
    colors: Literal["face", "vertex"] = "face"
    """Colours of soft triangles: one for each face, or one for each vertex, interpolated between."""
    backend: Literal["etsplat", "nvdiffrast"] = "etsplat"
    """Whose rasterizer the raster methods use; nvdiffrast must be installed and wants a CUDA device."""
    distance: Literal["barycentric", "sdf"] = "barycentric"
    """How far a pixel is from a triangle: by barycentric coordinates or by signed distance."""
    seed: int = 0
    """Of the order of views and the backgrounds. (Metrics always sample with the same seed.)"""
    device: Literal["cpu", "cuda"] | None = None
    """Where it runs: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    engine: Literal["cpu", "cuda", "reference"] | None = None
    """What computes: cpu, cuda, reference (plain PyTorch, slow), or None for the fastest on the device."""

    resolution: int = 1024
    """Side of the pictures taken of a mesh, in pixels; wider images of a scene are scaled down to this width."""
    supersampling: int = 4
    """Pictures of a mesh average this many samples squared per pixel."""
    iterations: int = 30_000
    """Optimization steps; each sees one view."""

    start_level: int = 4
    """The start is a sphere of 20 * 4^level faces."""
    start_radius: float = 1.05
    """Radius of that sphere, as a multiple of the radius of a sphere around the object."""
    start_color: float = 0.5
    """Grey of all faces at the start."""
    start_opacity: float = 0.98
    """Opacity of all faces at the start."""
    start_sigma: float = 0.25
    """Softness at the start; small is sharp."""

    views_per_step: int = 1
    """Views that each step sees; the paper's method sees one."""
    coarse_levels: int = 0
    """How many times the pictures are halved at first; the resolution doubles in equal steps."""
    coarse_until: float = 0.5
    """When full resolution begins, as a fraction of the iterations."""

    vertex_update: Literal["adam", "uniform", "large-steps"] = "adam"
    """Adam's; Adam's with one scale for all vertices; or that, smoothed by the mesh's Laplacian."""
    large_steps_weight: float = 10.0
    """How far large-steps smooths: the weight of the Laplacian beside the identity."""
    lr_vertices: float = 2e-3
    """Adam learning rate of positions, in units of the object's radius."""
    lr_vertices_final: float = 0.02
    """Ratio of that rate's last value to its first; it falls exponentially."""
    lr_colors: float = 1e-2
    """Adam learning rate of colours."""
    lr_opacities: float = 1e-3
    """Adam learning rate of opacities, before their sigmoid."""
    lr_sigma: float = 1e-4
    """Adam learning rate of the logarithm of sigma."""

    lambda_edge: float = 1.5
    """Weight of the mean edge length."""
    lambda_normal: float = 0.01
    """Weight of the angle between neighbouring faces."""
    lambda_laplacian: float = 0.5
    """Weight of the distance of vertices from the mean of their neighbours."""
    lambda_sigma: float = 1e-4
    """Weight of sigma^-2; the paper uses 1e-3 and 1e-4."""
    sigma_final: float = 0.0
    """Softness at the end: sigma then falls exponentially from start_sigma and is not learned; 0 to learn it."""
    edge_power: Literal[1, 2] = 1
    """1: mean edge length, as the paper prints it; 2: mean squared length."""
    gamma_hold: int = 500
    """The weights above are multiplied by a cosine that falls from 1 at this iteration to gamma_final at the last."""
    gamma_final: float = 0.0
    """Where that cosine ends; the paper's ends at 0."""

    max_faces: int = 100_000
    """Subdivision stops here."""
    subdivide_from: float = 0.1
    """First subdivision, as a fraction of the iterations."""
    subdivide_until: float = 0.6
    """Last subdivision, as a fraction of the iterations."""
    subdivide_steps: int = 30
    """Number of subdivisions between these two; each adds the same fraction of faces, up to `max_faces`."""

    untangle_steps: int = 0
    """How often faces that cut through others are smoothed away, from the last subdivision to the last step."""

    log_every: int = 50
    """Iterations between lines of history.jsonl."""
    evaluate_every: int = 1000
    """Iterations between evaluations for history.jsonl; 0 for one at the end only."""
    checkpoint_every: int = 1000
    """Iterations between checkpoints; 0 for one at the end only."""
    chamfer_samples: int = 100_000
    """Points per surface for the Chamfer distance."""
    lpips_weights: Path | None = None
    """Weights file for LPIPS; "download" fetches it; None uses the one in torch's cache or goes without."""

    def __post_init__(self) -> None:
        _check_choice(self, "method", METHODS)
        _check_choice(self, "colors", ("face", "vertex"))
        _check_choice(self, "backend", ("etsplat", "nvdiffrast"))
        if self.backend == "nvdiffrast" and self.splats:
            raise InputError("backend: nvdiffrast draws opaque triangles; choose --method raster-face or raster-vertex")
        _check_choice(self, "distance", ("barycentric", "sdf"))
        _check_choice(self, "device", (None, "cpu", "cuda"))
        _check_choice(self, "engine", (None, "cpu", "cuda", "reference"))
        _check_choice(self, "edge_power", (1, 2))
        _check_choice(self, "vertex_update", ("adam", "uniform", "large-steps"))
        for name in ("resolution", "supersampling", "iterations", "log_every", "chamfer_samples", "max_faces"):
            _check_range(self, name, 1)
        _check_range(self, "views_per_step", 1)
        for name in ("coarse_levels", "untangle_steps", "large_steps_weight", "sigma_final"):
            _check_range(self, name, 0)
        for name in ("start_level", "gamma_hold", "subdivide_steps", "evaluate_every", "checkpoint_every", "seed"):
            _check_range(self, name, 0)
        for name in ("lr_vertices", "lr_colors", "lr_opacities", "lr_sigma"):
            _check_range(self, name, 0.0)
        for name in ("lambda_edge", "lambda_normal", "lambda_laplacian", "lambda_sigma"):
            _check_range(self, name, 0.0)
        for name in ("subdivide_from", "subdivide_until", "start_color", "coarse_until", "gamma_final"):
            _check_range(self, name, 0.0, 1.0)
        for name in ("start_radius", "start_sigma", "lr_vertices_final"):
            _check_range(self, name, 1e-6)
        _check_range(self, "start_opacity", 0.01, 0.999)
        if self.subdivide_from > self.subdivide_until:
            raise InputError("subdivide_from: is after subdivide_until; make it smaller")

    @property
    def splats(self) -> bool:
        """Whether triangles are soft."""
        return not self.method.startswith("raster")

    @property
    def vertex_colored(self) -> bool:
        """Whether colours belong to vertices."""
        return self.colors == "vertex" if self.splats else self.method == "raster-vertex"

    @property
    def appearance(self) -> "MeshAppearance":
        """How the mesh is drawn."""
        from etsplat.model.mesh_rendering import MeshAppearance  # imports torch

        kernel = self.method.replace("-", "_") if self.splats else None
        return MeshAppearance(kernel, self.distance, self.backend, self.engine)


def _check_choice(config: ReconstructConfig, name: str, choices: tuple[object, ...]) -> None:
    value = getattr(config, name)
    if value not in choices:
        raise InputError(f"{name}: is {value!r}; choose one of {', '.join(str(choice) for choice in choices)}")


def _check_range(config: ReconstructConfig, name: str, low: float, high: float = float("inf")) -> None:
    value = getattr(config, name)
    if not low <= value <= high or value == float("inf"):
        bound = f"at least {low}" if high == float("inf") else f"between {low} and {high}"
        raise InputError(f"{name}: is {value}; it must be {bound}")


_PAPER = ReconstructConfig()
# What measurements support beyond the paper (research/ablations.md): closer to the truth, no face cuts through another.
_BEST: dict[str, Any] = {"coarse_levels": 2, "coarse_until": 0.1, "gamma_final": 0.03, "untangle_steps": 6}
# The paper's method at about a fifth of its budget.
_SHORT = replace(
    _PAPER,
    preset="quick",
    resolution=448,
    iterations=5000,
    gamma_hold=50,
    max_faces=25_000,
    lr_vertices=1e-2,
    lr_sigma=3e-4,
    subdivide_steps=10,
    evaluate_every=250,
    checkpoint_every=500,
)

_QUICK = replace(_SHORT, **_BEST)

PRESETS: dict[str, ReconstructConfig] = {
    "best": replace(_PAPER, preset="best", **_BEST),
    "paper": _PAPER,
    "study": replace(
        _SHORT,
        preset="study",
        resolution=640,
        iterations=6000,
        gamma_hold=100,
        max_faces=40_000,
        lr_vertices=8e-3,
        subdivide_steps=15,
        checkpoint_every=1000,
    ),
    "quick": _QUICK,
    "demo": replace(_QUICK, preset="demo"),
    "tiny": replace(
        _SHORT,
        preset="tiny",
        resolution=64,
        supersampling=2,
        iterations=300,
        start_level=2,
        start_opacity=0.9,
        start_sigma=0.5,
        gamma_hold=20,
        edge_power=2,
        max_faces=2000,
        lr_vertices=2e-2,
        lr_vertices_final=0.05,
        lr_colors=2e-2,
        lr_opacities=2e-2,
        lr_sigma=1e-2,
        subdivide_steps=5,
        log_every=20,
        evaluate_every=100,
        checkpoint_every=50,
        chamfer_samples=20_000,
    ),
}
"""By name; `ReconstructConfig.preset` says what each is for."""
