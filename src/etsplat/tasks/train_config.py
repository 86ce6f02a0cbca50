"""Settings of novel-view synthesis: every choice that the result depends on, with presets and kinds of scenes."""

from dataclasses import dataclass, replace
from typing import Any, Literal

from etsplat.core.errors import InputError

Method = Literal["elastic", "bilateral", "single-sided"]
TrainPreset = Literal["paper", "quick", "demo", "tiny"]
SceneType = Literal["outdoor", "indoor", "object"]


@dataclass(frozen=True)
class TrainConfig:
    """Settings of `etsplat.train`; the defaults are preset "paper", scene type "outdoor".

    The iterations at which something happens are given for a run of `schedule_length` and scale with `iterations`.
    """

    preset: TrainPreset = "paper"
    """Where the other settings start from; in Python, begin with `train_settings(name)` instead.
    quick: minutes on four cores, the scene scaled to unit size;
    paper: Triangle Splatting's settings, in the scene's own units;
    demo, tiny: for `etsplat demo scene` and for tests."""
    scene_type: SceneType = "outdoor"
    """What is photographed, for learning rates and losses: outdoor, indoor, or an object."""
    method: Method = "elastic"
    """Kernel of the triangles: elastic (the paper's), bilateral (2DTS) or single-sided (Triangle Splatting)."""
    freeze_incentre: bool = True
    """With single-sided, hold the inradius constant in the backward pass, as Triangle Splatting does."""
    seed: int = 0
    """Of every random choice: start, order of views, backgrounds, densification."""
    device: Literal["cpu", "cuda"] | None = None
    """Where it runs: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    engine: Literal["cpu", "cuda", "reference"] | None = None
    """What computes: cpu, cuda, reference (plain PyTorch, slow), or None for the fastest on the device."""

    width: int | None = None
    """Wider images are scaled down to this width; None shrinks those wider than 1600 pixels to 1600."""
    normalize: bool = False
    """Train in the frame where the cameras are centred and the scene has extent 1. Results are in the scene's units."""
    background: Literal["black", "white", "random"] = "black"
    """Behind the scene."""
    near_plane: float = 0.2
    """Triangles with a vertex nearer than this to a camera are invisible to it."""
    cull_small: bool = True
    """Leave out triangles with an inradius below one pixel, as Triangle Splatting does."""
    cull_large: float | None = 1.0
    """Leave out triangles that reach farther than this from their middle, in units of the photo's longer side."""
    iterations: int = 30_000
    """Optimization steps; each sees one view."""
    max_epochs: int | None = None
    """A run ends earlier where it would see a photo more often than this; few photos are soon learnt by heart."""
    schedule_length: int = 30_000
    """What the iterations below refer to."""

    max_triangles: int = 4_000_000
    """Densification stops here."""
    sky_dome: bool = True
    """Start with 5 % more triangles, white, on a sphere around the scene."""
    sky_closed: bool = False
    """The dome is a closed sphere in the colours of the photos instead, which stays where no photo shows it."""
    start_points: int = 100_000
    """So many random triangles to start from where the capture has no points."""
    start_scale: float = 2.23
    """Size of a triangle at the start, relative to the distance to its neighbours."""
    start_limit: float | None = None
    """Triangles start no larger than this times their distance to the nearest camera; None for any size."""
    start_opacity: float = 0.28
    """Opacity of all triangles at the start."""
    start_sigma: float = 1.16
    """Softness at the start; small is sharp."""
    sh_degree: int = 3
    """Degree of the view-dependent colours."""
    sh_every: int = 1000
    """Iterations between steps of the degree, from 0."""

    lr_vertices: float = 0.0018
    """Adam learning rate of positions, in units of the frame."""
    lr_vertices_length: int | None = None
    """Length of the runs that this rate is for: it grows with the root of how many times shorter another run is.
    None for the same rate whatever the length."""
    lr_vertices_final: float = 0.01
    """Ratio of that rate's last value to its first; it falls exponentially."""
    lr_sh_dc: float = 0.0025
    """Adam learning rate of the constant band of the colours."""
    lr_sh_rest: float = 0.000125
    """Adam learning rate of the other bands."""
    lr_opacities: float = 0.014
    """Adam learning rate of opacities, before their sigmoid."""
    lr_sigma: float = 0.0008
    """Adam learning rate of softness, before its exponential."""
    lr_settle: int | None = None
    """From this iteration on the rates of colours, opacities and softness fall too, to a tenth at the last one;
    None keeps them."""

    lambda_dssim: float = 0.2
    """Share of 1 - SSIM in the photometric loss; the rest is L1."""
    lambda_opacity: float = 0.0055
    """Weight of the mean opacity."""
    lambda_size: float = 1e-8
    """Weight of the reciprocal of the mean area, until densification ends."""
    lambda_normal: float = 1e-4
    """Weight of the angle between the normals of triangles and those of the depth image."""
    lambda_distortion: float = 0.0
    """Weight of the spread of triangles along a line of sight."""
    regularize_from: int = 5000
    """After this iteration the last two weights apply."""

    densify_from: int = 500
    """No densification up to this iteration."""
    densify_until: int = 25_000
    """No densification from this iteration on; only pruning."""
    densify_every: int = 500
    """Iterations between densifications, and then between prunings."""
    growth: float = 1.3
    """Each multiplies the number of triangles by this, at most."""
    replace_dead: bool = True
    """Triangles that die count in the number that is multiplied, so that all of them are replaced.
    With an opaque finish they do in any case."""
    sample_by: Literal["alternate", "opacity", "sharpness"] = "alternate"
    """What makes a parent likely: its opacity, 1/sigma, or the one and the other in turn."""
    split_size: float = 24.0
    """Parents larger on screen than this, in pixels, are split into four; others are cloned."""
    clone_noise: float = 1.5
    """How far a clone is shifted, as a multiple of the triangle's extent."""
    prune_opacity: float = 0.014
    """Triangles with this opacity or less are removed."""
    prune_importance: float = 0.022
    """Triangles whose blend weight stays below this in every view are removed; with an opaque finish 0.005 at most."""
    prune_views: int = 2
    """Triangles larger than a pixel in fewer views than this are removed; 0 keeps small ones."""
    prune_screen_size: float | None = None
    """Triangles larger on some view's screen than this, in pixels, are removed; None keeps them."""

    finish: Literal["none", "opaque"] = "none"
    """opaque: triangles are made opaque, then sharp, for engines without transparency."""

    log_every: int = 50
    """Iterations between lines of history.jsonl."""
    evaluate_every: int = 1000
    """Iterations between evaluations for history.jsonl; 0 for one at the end only."""
    checkpoint_every: int = 1000
    """Iterations between checkpoints; 0 for one at the end only."""

    def __post_init__(self) -> None:
        for name, low, high in _RANGES:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                bound = f"at least {low}" if high == float("inf") else f"between {low} and {high}"
                raise InputError(f"{name}: is {value}; it must be {bound}")
        for name, choices in _CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise InputError(f"{name}: is {value!r}; choose one of {', '.join(str(choice) for choice in choices)}")
        if self.densify_from > self.densify_until:
            raise InputError("densify_from: is after densify_until; make it smaller")

    @property
    def kernel(self) -> str:
        """The rasterizer's name of the method."""
        return self.method.replace("-", "_")

    @property
    def distance(self) -> str:
        """The rasterizer's distance that belongs to the method."""
        return "sdf" if self.method == "single-sided" else "barycentric"

    @property
    def closed(self) -> bool:
        """Whether the scene is inside a closed sphere."""
        return self.sky_dome and self.sky_closed

    def at(self, step: int) -> int:
        """The iteration of this run that an iteration of the schedule falls on."""
        return max(1, round(step * self.iterations / self.schedule_length)) if step > 0 else 0


_INF = float("inf")
_RANGES = (
    *((name, 1, _INF) for name in ("width", "iterations", "schedule_length", "max_epochs", "lr_vertices_length")),
    *((name, 1, _INF) for name in ("max_triangles", "start_points")),
    *((name, 1, _INF) for name in ("log_every", "densify_every", "sh_every", "prune_screen_size")),
    *((name, 0, _INF) for name in ("evaluate_every", "checkpoint_every", "seed", "regularize_from")),
    *((name, 0, _INF) for name in ("densify_from", "densify_until", "split_size", "clone_noise", "prune_views")),
    *((name, 0, _INF) for name in ("lr_vertices", "lr_sh_dc", "lr_sh_rest", "lr_opacities", "lr_sigma", "lr_settle")),
    *((name, 0, _INF) for name in ("lambda_opacity", "lambda_size", "lambda_normal", "lambda_distortion")),
    *((name, 0, 1) for name in ("lambda_dssim", "prune_opacity", "prune_importance")),
    *((name, 1e-6, _INF) for name in ("near_plane", "cull_large", "start_scale", "lr_vertices_final")),
    ("start_opacity", 0.005, 0.999),
    ("start_sigma", 0.011, _INF),
    ("sh_degree", 0, 3),
    ("growth", 1, _INF),
)
_CHOICES = {
    "method": ("elastic", "bilateral", "single-sided"),
    "scene_type": ("outdoor", "indoor", "object"),
    "device": (None, "cpu", "cuda"),
    "engine": (None, "cpu", "cuda", "reference"),
    "background": ("black", "white", "random"),
    "sample_by": ("alternate", "opacity", "sharpness"),
    "finish": ("none", "opaque"),
}

_SCENE_TYPES: dict[str, dict[str, Any]] = {
    "outdoor": {},
    "indoor": {
        "lr_vertices": 0.0015,
        "lambda_dssim": 0.4,
        "lambda_normal": 4e-5,
        "lambda_distortion": 1.0,
        "lambda_size": 5e-8,
        "prune_importance": 0.025,
        "prune_screen_size": 1400.0,
    },
    "object": {
        "sky_dome": False,
        "max_triangles": 500_000,
        "lambda_opacity": 0.0044,
        "lambda_normal": 0.0028,
        "lambda_distortion": 0.014,
        "lambda_size": 0.0,
        "regularize_from": 25_000,
        "prune_importance": 0.027,
        "prune_screen_size": 1400.0,
    },
}
"""What Triangle Splatting's scripts set for each kind of scene; the defaults above are those of outdoor scenes."""

_QUICK: dict[str, Any] = {
    "width": 800,
    "normalize": True,
    "near_plane": 0.25,
    "cull_small": False,
    "iterations": 6000,
    "max_epochs": 100,
    "max_triangles": 100_000,
    "sky_closed": True,
    "start_limit": 0.4,
    "lr_vertices": 0.0015,
    "lr_vertices_length": 6000,
    "lr_sh_dc": 0.01,
    "lr_sh_rest": 0.0005,
    "lr_opacities": 0.05,
    "lr_sigma": 0.005,
    "lr_settle": 20_000,
    "prune_views": 0,
    "lambda_normal": 0.0,
    "lambda_distortion": 0.0,
    "lambda_size": 0.0,
    "evaluate_every": 500,
    "checkpoint_every": 500,
}

_QUICK_OBJECT: dict[str, Any] = {"lr_vertices": 0.0004}
"""An object is small in the frame that its cameras span: at the rate of rooms its triangles come to rest late."""

_PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    "quick": _QUICK,
    "demo": {**_QUICK, "iterations": 3000, "max_triangles": 40_000, "sky_closed": False},
    "tiny": {
        **_QUICK,
        "width": 64,
        "iterations": 200,
        "max_triangles": 2000,
        "sky_closed": False,
        "start_points": 1000,
        "sh_degree": 1,
        "log_every": 20,
        "evaluate_every": 100,
        "checkpoint_every": 50,
    },
}

PRESET_NAMES = tuple(_PRESETS)
SCENE_TYPE_NAMES = tuple(_SCENE_TYPES)


def train_settings(preset: str = "quick", scene_type: str = "outdoor") -> TrainConfig:
    """The settings of a preset for a kind of scene.

    Args:
        preset: paper, quick, demo or tiny.
        scene_type: outdoor, indoor or object.

    Raises:
        InputError: an unknown name.
    """
    for option, name, known in (("preset", preset, PRESET_NAMES), ("scene_type", scene_type, SCENE_TYPE_NAMES)):
        if name not in known:
            raise InputError(f"{option}: is {name!r}; choose one of {', '.join(known)}")
    chosen = {**_SCENE_TYPES[scene_type], **_PRESETS[preset], "preset": preset, "scene_type": scene_type}
    if preset != "paper" and scene_type == "object":
        chosen |= _QUICK_OBJECT
    return replace(TrainConfig(), **chosen)
