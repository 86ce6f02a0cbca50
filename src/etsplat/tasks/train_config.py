"""Settings of novel-view synthesis: every choice that the result depends on, with presets and kinds of scenes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, get_args

from etsplat.tasks.settings import Device, OneOf, Only, Range, Rare, Settings, kernel_methods, training_engines

Preset = Literal["paper", "quick", "demo", "tiny"]
SceneType = Literal["outdoor", "indoor", "object"]
SCENE_TYPES: tuple[SceneType, ...] = get_args(SceneType)

_TRANSPARENT = Only("with finish none", lambda config: config.finish == "none")
_SINGLE_SIDED = Only("with method single-sided", lambda config: config.method == "single-sided")
_HARMONICS = Only("with view-dependent colours", lambda config: config.drawing.sh_degree > 0)
_REGULAR = Only(
    "with lambda_depth_normal or lambda_distortion",
    lambda config: config.loss.lambda_depth_normal > 0 or config.loss.lambda_distortion > 0,
)
_DEPTH = Only("with loss.depth", lambda config: config.loss.depth != "off")


@dataclass(frozen=True)
class Drawing:
    """How triangles become a picture."""

    near_plane: Annotated[float, Range(1e-6, 1e6)] = 0.25
    """Triangles with a vertex nearer than this to a camera are invisible to it."""
    cull_small: bool = False
    """Leave out triangles with an inradius below one pixel, as Triangle Splatting does."""
    cull_large: Annotated[float | None, Range(1e-6)] = 1.0
    """Leave out triangles that reach farther than this from their middle, in units of the photo's longer side."""
    sh_degree: Annotated[int, Range(0, 3)] = 3
    """Degree of the view-dependent colours."""
    dropout: Annotated[float, Range(0, 100), _TRANSPARENT] = 4.5
    """Each step leaves out a random share of the triangles: the square of this over the number of photos to train on;
    a tenth at most. So what one photo asked for, hidden from the others behind other triangles, is seen by them too."""
    freeze_inradius: Annotated[bool, _SINGLE_SIDED] = True
    """With single-sided, hold the inradius constant in the backward pass, as Triangle Splatting does."""


@dataclass(frozen=True)
class Start:
    """The triangles that the optimization starts from: one at each point of the capture."""

    points: Annotated[int, Range(1, 10**8)] = 100_000
    """So many random triangles to start from where the capture has no points and its photos agree on too little;
    as many as there may be, if these are fewer."""
    dense: bool = True
    """Triangles start at places that photos agree on, too, where photos agree on many places:
    in a third of the start or more, which is half of the triangles that there may be or as many as there are points;
    in all of it where the capture has no points. Not for triangles that become opaque (finish, asset)."""
    nearest: Annotated[float, Range(0, 1)] = 0.75
    """Points before everything else that photos see in different colours are left out, for veils grow from them.
    Before everything: nearer to a photo than this times where all points but a hundredth begin; 0 keeps all."""
    scale: Annotated[float, Range(1e-6)] = 2.23
    """Size of a triangle at the start, relative to the distance to its neighbours."""
    limit: Annotated[float | None, Range(0)] = 0.4
    """Triangles start no larger than this times their distance to the nearest camera; None for any size."""
    opacity: Annotated[float, Range(0.005, 0.999)] = 0.28
    """Opacity of all triangles at the start."""
    sigma: Annotated[float, Range(0.011)] = 1.16
    """Softness at the start; small is sharp."""


@dataclass(frozen=True)
class Schedule:
    """When things happen: iterations are those of a run of `length`, and scale with `iterations`."""

    length: Annotated[int, Range(1)] = 30_000
    """What the iterations of this and the next groups refer to, but for those of `output`."""
    max_epochs: Annotated[int | None, Range(1)] = 100
    """A run ends earlier where it would see a photo more often than this; few photos are soon learnt by heart."""
    doubtful_epochs: Annotated[int | None, Range(1)] = 20
    """The same where start.dense finds that photos hardly agree on depths: by poor poses more is learnt by heart."""
    sh_every: Annotated[int, Range(1), _HARMONICS] = 1000
    """Iterations between steps of the colours' degree, from 0."""


@dataclass(frozen=True)
class Optimizer:
    """How vertices, colours, opacities and softness move."""

    lr_vertices: Annotated[float, Range(0)] = 0.0006
    """Adam learning rate of positions, for a triangle of median size."""
    lr_vertices_unit: Literal["view", "frame"] = "view"
    """What that is a fraction of.
    view: the longer side of what photos show at the capture's points, as fast on screen in every capture;
    frame: the unit of the frame, the extent of the cameras, as also where no photo shows a point."""
    lr_vertices_length: Annotated[int | None, Range(1)] = 6000
    """Length of the runs that this rate is for: it grows with the root of how many times shorter another run is.
    None for the same rate whatever the length."""
    lr_vertices_final: Annotated[float, Range(1e-6)] = 0.01
    """Ratio of that rate's last value to its first; it falls exponentially."""
    lr_vertices_by_size: Annotated[float, Range(0, 1)] = 1.0
    """The power of its size, relative to the median of all, by which a triangle's rate is faster.
    1: a step is as large a part of every triangle; 0: as long for all, small ones and large ones."""
    lr_sh_dc: Annotated[float, Range(0)] = 0.01
    """Adam learning rate of the constant band of the colours."""
    lr_sh_rest: Annotated[float, Range(0), _HARMONICS] = 0.0005
    """Adam learning rate of the other bands."""
    lr_opacities: Annotated[float, Range(0)] = 0.05
    """Adam learning rate of opacities, before their sigmoid."""
    lr_sigma: Annotated[float, Range(0)] = 0.005
    """Adam learning rate of softness, before its exponential."""
    lr_settle: Annotated[int | None, Range(0)] = 20_000
    """From this iteration on the rates of colours, opacities and softness fall too, to a tenth at the last one;
    None keeps them."""


@dataclass(frozen=True)
class Loss:
    """What is minimised."""

    lambda_dssim: Annotated[float, Range(0, 1)] = 0.2
    """Share of 1 - SSIM in the photometric loss; the rest is L1."""
    lambda_opacity: Annotated[float, Range(0), _TRANSPARENT] = 0.0055
    """Weight of the mean opacity."""
    lambda_harmonics: Annotated[float, Range(0), _HARMONICS] = 2.0
    """Weight of how much colours depend on the direction, divided by the number of photos to train on.
    Without it few photos are each fitted by it, and other views have streaks and patches."""
    lambda_size: Annotated[float, Range(0)] = 0.0
    """Weight of the reciprocal of the mean area, until densification ends."""
    lambda_depth_normal: Annotated[float, Range(0)] = 0.0
    """Weight of the angle between the normals of triangles and those of the depth image."""
    lambda_distortion: Annotated[float, Range(0)] = 0.0
    """Weight of the spread of triangles along a line of sight."""
    regularize_from: Annotated[int, Range(0), _REGULAR] = 5000
    """After this iteration the last two weights apply."""
    depth: Literal["auto", "l1", "pearson", "off"] = "auto"
    """What depth maps are taken for, where the capture has them and they do not contradict its photos.
    l1: depths in the capture's units; pearson: depths, or inverse ones, of unknown scale and shift;
    auto: the first of these that agrees with the capture's points, or with what the photos have shaped."""
    lambda_depth: Annotated[float, Range(0), _DEPTH] = 0.02
    """Weight of the distance from depth maps in the first half of the run: relative (l1), or 1 minus the correlation.
    More puts triangles nearer to the maps, and costs quality of the pictures."""
    depth_from: Annotated[int, Range(1), _DEPTH] = 6000
    """After this iteration depth maps are compared with the soup, and used if they agree;
    only where neither the capture's points nor other maps speak for them before the run."""


@dataclass(frozen=True)
class Densification:
    """How triangles multiply."""

    begin: Annotated[int, Range(0)] = 500
    """No densification up to this iteration."""
    end: Annotated[int, Range(0)] = 25_000
    """No densification from this iteration on; only pruning."""
    every: Annotated[int, Range(1)] = 500
    """Iterations between densifications, and then between prunings."""
    growth: Annotated[float, Range(1)] = 1.3
    """Each multiplies the number of triangles by this, at most."""
    replace_dead: Annotated[bool, _TRANSPARENT] = True
    """Triangles that die count in the number that is multiplied, so that all of them are replaced."""
    sample_by: Literal["alternate", "opacity", "sharpness"] = "alternate"
    """What makes a parent likely: its opacity, 1/sigma, or the one and the other in turn."""
    split_size: Annotated[float, Range(0)] = 24.0
    """Parents larger on screen than this, in pixels, are split into four; others are cloned."""
    clone_noise: Annotated[float, Range(0)] = 1.5
    """How far a clone is shifted, as a multiple of the triangle's extent."""


@dataclass(frozen=True)
class Pruning:
    """Which triangles are removed."""

    opacity: Annotated[float, Range(0, 1)] = 0.014
    """Triangles with this opacity or less are removed."""
    importance: Annotated[float, Range(0, 1)] = 0.022
    """Triangles whose blend weight stays below this in every view are removed; with an opaque finish 0.005 at most."""
    views: Annotated[int, Range(0)] = 0
    """Triangles larger than a pixel in fewer views than this are removed; 0 keeps small ones."""
    screen_size: Annotated[float | None, Range(1)] = None
    """Triangles larger on some view's screen than this, in pixels, are removed; None keeps them."""


@dataclass(frozen=True)
class Output:
    """What is written and measured, and when."""

    log_every: Annotated[int, Range(1)] = 50
    """Iterations between lines of history.jsonl."""
    evaluate_every: Annotated[int, Range(0)] = 500
    """Iterations between evaluations for history.jsonl; 0 for one at the end only."""
    checkpoint_every: Annotated[int, Range(0)] = 500
    """Iterations between checkpoints; 0 for one at the end only."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(Settings):
    """Settings of `etsplat.train`; the defaults are preset "quick" for outdoor scenes.

    Raises InputError where a setting is out of its range, is none of its choices, or would have no effect.

    Example:
        >>> etsplat.TrainConfig.of("quick", "indoor").changed({"max_triangles": 50_000}).scene_type
        'indoor'
    """

    TASK: ClassVar[str] = "train"
    LABELS: ClassVar[tuple[str, ...]] = ("preset", "scene_type")

    preset: Preset = "quick"
    """Where the other settings start from; in Python, begin with `TrainConfig.quick()` and the like.
    quick: minutes on four cores, the scene scaled to unit size;
    paper: Triangle Splatting's settings, in the scene's own units;
    demo, tiny: for `etsplat demo scene` and for tests."""
    scene_type: SceneType = "outdoor"
    """What is photographed, for learning rates and losses: outdoor, indoor, or an object."""
    method: Annotated[str, OneOf(kernel_methods)] = "elastic"
    """Kernel of the triangles: elastic (the paper's), bilateral (2DTS) or single-sided (Triangle Splatting);
    or the name of one of your own, with --kernel-file."""
    iterations: Annotated[int, Range(1)] = 6000
    """Optimization steps."""
    width: Annotated[int | None, Range(1, 16384)] = 800
    """Wider images are scaled down to this width; None shrinks those wider than 1600 pixels to 1600."""
    max_triangles: Annotated[int, Range(1, 10**8)] = 100_000
    """Densification stops here, or earlier where photos are few or small.
    A capture's points may be more: each of them becomes a triangle."""
    pixels_per_triangle: Annotated[float | None, Range(0.01), Rare] = 45.0
    """Densification stops where there is a triangle for so many pixels of the training photos.
    More learn the photos by heart, and other views fall apart; None for `max_triangles` whatever the photos.
    Opaque triangles are fewer, a triangle for 5/3 as many; of the opaque mesh more where photos agree on them."""
    normalize: Annotated[bool, Rare] = True
    """Train in the frame where the cameras are centred and the scene has extent 1. Results are in the scene's units."""
    background: Annotated[Literal["black", "white", "random"], Rare] = "black"
    """Behind the scene."""
    sky: Annotated[Literal["none", "dome", "sphere"], Rare] = "sphere"
    """Around the scene: nothing; a dome of 5 % more triangles, white, at the start;
    or a closed sphere in the colours of the photos, which stays where no photo shows it."""
    finish: Literal["none", "opaque"] = "none"
    """opaque: triangles are made opaque, then sharp, for engines without transparency."""
    asset: bool = True
    """Make an opaque mesh of the scene beside the soup, which looks right in every mesh viewer and game engine.
    It takes a third to two thirds as long again as the soup; with finish opaque less."""
    watch: Annotated[int | None, Range(0), Rare] = None
    """One in so many training photos is kept from training, to watch the run by; 0 keeps none.
    None keeps one in 16 where there are at least 24.
    Where a run gets worse by them towards its end, its best state is the result."""
    exposure: Literal["auto", "on", "off"] = "auto"
    """Whether photos were exposed unlike each other, or with other white balances:
    then a gain and a colour matrix of each are learned, which are not part of the result.
    auto: if an early measurement says that they were."""
    refine_cameras: Annotated[Literal["off", "poses", "all"], Rare] = "off"
    """Correct the cameras of training photos beside the model: their poses, or focal lengths and centres too (all).
    Photos that are kept from training judge whether that does good; if not, cameras stay as given.
    cameras.json has what was found. The steps in which that is judged are made twice."""
    batch: Annotated[int, Range(1, 1024), Rare] = 1
    """Views that each step sees; the paper's method sees one.
    All learning rates are multiplied by its square root."""
    seed: Annotated[int, Range(0, 2**63 - 1), Rare] = 0
    """Of every random choice: start, order of views, backgrounds, densification."""
    device: Device | None = None
    """Where it runs: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    engine: Annotated[str | None, OneOf(training_engines), Rare] = None
    """What computes: cpu, cuda, reference (plain PyTorch, slow), or None for the fastest on the device."""

    drawing: Drawing = Drawing()
    start: Start = Start()
    schedule: Schedule = Schedule()
    optimizer: Optimizer = Optimizer()
    loss: Loss = Loss()
    densification: Densification = Densification()
    pruning: Pruning = Pruning()
    output: Output = Output()

    @classmethod
    def quick(cls, scene: SceneType = "outdoor") -> "TrainConfig":
        """Minutes on four cores, the scene scaled to unit size."""
        return cls.of("quick", scene)

    @classmethod
    def paper(cls, scene: SceneType = "outdoor") -> "TrainConfig":
        """Triangle Splatting's settings, in the scene's own units."""
        return cls.of("paper", scene)

    @classmethod
    def demo(cls, scene: SceneType = "outdoor") -> "TrainConfig":
        """For `etsplat demo scene`."""
        return cls.of("demo", scene)

    @classmethod
    def tiny(cls, scene: SceneType = "outdoor") -> "TrainConfig":
        """For tests."""
        return cls.of("tiny", scene)

    @property
    def kernel(self) -> str:
        """The rasterizer's name of the method."""
        return self.method.replace("-", "_")

    @property
    def distance(self) -> str:
        """The rasterizer's distance that belongs to the method."""
        return "sdf" if self.method == "single-sided" else "barycentric"

    def at(self, step: int) -> int:
        """The iteration of this run that an iteration of the schedule falls on."""
        return max(1, round(step * self.iterations / self.schedule.length)) if step > 0 else 0

    @classmethod
    def implied_by(cls, *labels: str) -> Mapping[str, Any]:
        """What the preset and the kind of scene set."""
        preset, scene = labels
        own = _PAPER_SCENES if preset == "paper" else {}
        return {**_PRESETS.get(preset, {}), **_SCENES.get(scene, {}), **own.get(scene, {})}

    def contradiction(self) -> str | None:
        """What is wrong with settings that are right one by one."""
        if self.watch == 1:
            return "watch: 1 would keep all photos from training; choose 0 or at least 2"
        if self.densification.begin > self.densification.end:
            return "densification.begin: is after densification.end; make it smaller"
        return None


_PAPER: dict[str, Any] = {
    "asset": False,
    "watch": 0,
    "exposure": "off",
    "iterations": 30_000,
    "width": None,
    "max_triangles": 4_000_000,
    "normalize": False,
    "sky": "dome",
    "drawing.near_plane": 0.2,
    "drawing.cull_small": True,
    "drawing.dropout": 0.0,
    "start.dense": False,
    "start.nearest": 0.0,
    "start.limit": None,
    "schedule.max_epochs": None,
    "schedule.doubtful_epochs": None,
    "optimizer.lr_vertices": 0.0018,
    "optimizer.lr_vertices_unit": "frame",
    "optimizer.lr_vertices_length": None,
    "optimizer.lr_vertices_by_size": 0.0,
    "optimizer.lr_sh_dc": 0.0025,
    "optimizer.lr_sh_rest": 0.000125,
    "optimizer.lr_opacities": 0.014,
    "optimizer.lr_sigma": 0.0008,
    "optimizer.lr_settle": None,
    "loss.lambda_harmonics": 0.0,
    "loss.lambda_size": 1e-8,
    "loss.lambda_depth_normal": 1e-4,
    "loss.depth": "off",
    "pixels_per_triangle": None,
    "pruning.views": 2,
    "output.evaluate_every": 1000,
    "output.checkpoint_every": 1000,
}
_DEMO: dict[str, Any] = {"iterations": 3000, "max_triangles": 40_000, "sky": "dome"}
_TINY: dict[str, Any] = {
    "asset": False,
    "iterations": 200,
    "width": 64,
    "max_triangles": 2000,
    "sky": "dome",
    "drawing.dropout": 0.0,
    "drawing.sh_degree": 1,
    "start.dense": False,
    "start.nearest": 0.0,
    "start.points": 1000,
    "output.log_every": 20,
    "output.evaluate_every": 100,
    "output.checkpoint_every": 50,
}
_PRESETS: dict[str, dict[str, Any]] = {"paper": _PAPER, "quick": {}, "demo": _DEMO, "tiny": _TINY}
"""What each changes of the defaults, by name; `TrainConfig.preset` says what each is for."""

_SCENES: dict[str, dict[str, Any]] = {
    "outdoor": {},
    "indoor": {"loss.lambda_dssim": 0.4, "pruning.importance": 0.025, "pruning.screen_size": 1400.0},
    "object": {
        "sky": "none",
        "loss.lambda_opacity": 0.0044,
        "loss.regularize_from": 25_000,
        "pruning.importance": 0.027,
        "pruning.screen_size": 1400.0,
    },
}
"""What Triangle Splatting's scripts set for each kind of scene, which every preset takes over."""

_PAPER_SCENES: dict[str, dict[str, Any]] = {
    "indoor": {
        "optimizer.lr_vertices": 0.0015,
        "loss.lambda_size": 5e-8,
        "loss.lambda_depth_normal": 4e-5,
        "loss.lambda_distortion": 1.0,
    },
    "object": {
        "max_triangles": 500_000,
        "loss.lambda_size": 0.0,
        "loss.lambda_depth_normal": 0.0028,
        "loss.lambda_distortion": 0.014,
    },
}
"""What else they set, which is for preset "paper" alone."""
