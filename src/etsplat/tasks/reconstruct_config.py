"""Settings of shape reconstruction: every choice that the result depends on, with its presets."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

from etsplat.core.spelling import option
from etsplat.tasks.export_config import LIGHT_FACES, TEXELS, texture_problem
from etsplat.tasks.settings import (
    Device,
    OneOf,
    Only,
    Range,
    Rare,
    Settings,
    SoftMethod,
    kernel_methods,
    training_engines,
)

RasterMethod = Literal["raster-face", "raster-vertex"]
Method = Literal[SoftMethod, RasterMethod]
METHODS: tuple[Method, ...] = get_args(Method)
Preset = Literal["best", "paper", "study", "quick", "demo", "tiny"]

_DEPTH = Only("with regularization.depth", lambda config: config.soft and config.regularization.depth != "off")
_SOFT = Only("with soft triangles (elastic, bilateral, single-sided)", lambda config: config.soft)
_COARSE = Only("with coarse levels", lambda config: config.pictures.coarse_levels > 0)
_HULL = Only("with start.shape hull or auto", lambda config: config.start.shape != "sphere")
_SPHERE = Only("with start.shape sphere or auto", lambda config: config.start.shape != "hull")
_LARGE = Only("with vertex_update large-steps", lambda config: config.optimizer.vertex_update == "large-steps")
_LEARNED = Only("where softness is learned", lambda config: config.soft and not config.optimizer.sigma_final)
_EDGES = Only("with lambda_edge", lambda config: config.regularization.lambda_edge > 0)
_FACE_COLORED = Only("with soft triangles that have a colour for each face", lambda config: config.face_colored)
_OPAQUE = Only(
    "with drawing.opaque_from below 1 and soft triangles",
    lambda config: config.soft and config.drawing.opaque_from < 1,
)
_OUTLINED = Only(
    "with drawing.opaque_from below 1, soft triangles and refine_cameras off",
    lambda config: _OPAQUE.holds(config) and config.refine_cameras == "off",
)
_HARMONICS = Only("with harmonics", lambda config: config.face_colored and config.drawing.harmonics != 0)
_UNTANGLED = Only("with untanglings", lambda config: config.refinement.untanglings > 0)
_SUBDIVIDED = Only("with subdivisions", lambda config: config.refinement.subdivisions > 0)
_TEXTURED = Only("with a texture", lambda config: config.texture is not None)


@dataclass(frozen=True)
class Pictures:
    """The pictures that the mesh is fitted to."""

    supersampling: Annotated[int, Range(1, 16)] = 4
    """Pictures of a mesh average this many samples squared per pixel."""
    coarse_levels: Annotated[int, Range(0, 12)] = 2
    """How many times the pictures are halved at first; the resolution doubles in equal steps."""
    coarse_until: Annotated[float, Range(0, 1), _COARSE] = 0.1
    """When full resolution begins, as a fraction of the iterations."""


@dataclass(frozen=True)
class Drawing:
    """How triangles become a picture."""

    colors: Annotated[Literal["face", "vertex"], _SOFT] = "face"
    """Colours of soft triangles: one for each face, or one for each vertex, interpolated between."""
    distance: Annotated[Literal["barycentric", "sdf"], _SOFT] = "barycentric"
    """How far a pixel is from a soft triangle: by barycentric coordinates or by signed distance."""
    harmonics: Annotated[int | None, Range(0, 3), _FACE_COLORED] = None
    """Degree of the harmonics by which colours of faces depend on the direction while triangles are soft.
    0 for none: then the shape is bent to explain gloss, or light that moves with the camera.
    None for 2 where photos show the start in colours that follow the direction, else 0.
    Meshes that are written carry each face's mean over the directions in front of it."""
    opaque_from: Annotated[float, Range(0, 1), _SOFT] = 0.9
    """From this fraction of a run on soft triangles are drawn as a viewer draws a mesh; 1 for never.
    Opaque, in one colour from all sides, and antialiased: outlines come nearer to those of the photos.
    Where the hull that a run starts from is near the surface all over, from 0.8 on if that is less."""
    backend: Literal["etsplat", "nvdiffrast"] = "etsplat"
    """Whose rasterizer the raster methods use; nvdiffrast must be installed and wants a CUDA device."""


@dataclass(frozen=True)
class Start:
    """What the optimization starts from, unless that is a mesh of one's own."""

    shape: Literal["auto", "sphere", "hull"] = "auto"
    """A sphere around the object; or the visual hull of its masks, which has the holes and parts that they show.
    auto: the hull where photos show the object as a whole, as those of a mesh do, or together show all of it;
    the sphere where a hull of photos that cut it off does not cover what they show, or there are no masks."""
    level: Annotated[int, Range(0, 9), _SPHERE] = 4
    """The sphere has 20 * 4^level faces."""
    radius: Annotated[float, Range(1e-6, 1e6)] = 1.05
    """Radius of the sphere, in which the hull lies too, as a multiple of the radius of a sphere around the object."""
    hull_faces: Annotated[int, Range(100, 10**7), _HULL] = 12_500
    """About how many faces the hull has, and no more than half of `max_faces`;
    up to twice as many where thin parts of the object would be broken. Other runs have more faces later:
    where a hull is finer than photos tell depths, its hollows are opened worse."""
    near: Annotated[float, Range(1e-6, 1), _HULL] = 0.3
    """A hull is near the surface already: the rate of vertices is multiplied by this."""
    near_fall: Annotated[Literal["exponential", "late"], _HULL] = "late"
    """How that rate falls: as it does elsewhere; or late, which stays high for longer and ends as low.
    Hollows, which travel far, are then opened deeper in as many steps."""
    near_iterations: Annotated[int | None, Range(1), _HULL] = 8000
    """A run of the preset's own length has so many iterations at most where the hull is near the surface all over:
    hardly a hollow was to be opened, and photos see nearly all of it and agree there.
    None for all iterations, at the whole rate."""
    near_rate: Annotated[float, Range(1e-6, 1), _HULL] = 0.7
    """In these iterations the rate of vertices is multiplied by this, too.
    So it is in all iterations of a hull that was cut out between walls."""
    near_edge: Annotated[float, Range(0, 1), _HULL] = 0.02
    """And the weight of edges by this: pulled tight they fill hollows."""
    near_reach: Annotated[float, Range(0), _HULL] = 2.0
    """And this is how far untangling reaches: folds do not hold up a shape that has the right holes."""
    near_pace: Annotated[float, Range(0, 1), _HULL] = 1.0
    """Where photos agree on vertices of a hull, their rate is multiplied by this;
    not of one that was cut open, or is near the surface all over.
    Noise throws them about, while hollows beside them have a way to go."""
    color: Annotated[float, Range(0, 1)] = 0.5
    """Grey of all faces at the start."""
    opacity: Annotated[float, Range(0.01, 0.999), _SOFT] = 0.98
    """Opacity of all faces at the start."""
    sigma: Annotated[float, Range(1e-6), _SOFT] = 0.25
    """Softness at the start; small is sharp."""


@dataclass(frozen=True)
class Optimizer:
    """How vertices, colours, opacities and softness move."""

    vertex_update: Literal["adam", "uniform", "large-steps"] = "adam"
    """Adam's; Adam's with one scale for all vertices; or that, smoothed by the mesh's Laplacian."""
    large_steps_weight: Annotated[float, Range(0), _LARGE] = 10.0
    """How far large-steps smooths: the weight of the Laplacian beside the identity."""
    lr_vertices: Annotated[float, Range(0)] = 2e-3
    """Adam learning rate of positions, in units of the object's radius."""
    lr_vertices_final: Annotated[float, Range(1e-6)] = 0.02
    """Ratio of that rate's last value to its first; it falls exponentially."""
    lr_opaque: Annotated[float, Range(0), _OPAQUE] = 6e-5
    """Adam learning rate of positions where triangles are drawn opaque (`drawing.opaque_from`).
    Vertices that are never at an outline move less."""
    lr_colors: Annotated[float, Range(0)] = 1e-2
    """Adam learning rate of colours."""
    lr_harmonics: Annotated[float, Range(0), _HARMONICS] = 5e-4
    """Adam learning rate of what depends on the direction in colours."""
    lr_opacities: Annotated[float, Range(0), _SOFT] = 1e-3
    """Adam learning rate of opacities, before their sigmoid."""
    lr_sigma: Annotated[float, Range(0), _LEARNED] = 1e-4
    """Adam learning rate of the logarithm of sigma."""
    sigma_final: Annotated[float, Range(0), _SOFT] = 0.0
    """Softness at the end: sigma then falls exponentially from start.sigma and is not learned; 0 to learn it."""


@dataclass(frozen=True)
class Regularization:
    """What is added to the difference of the pictures, so that the mesh stays fair."""

    lambda_edge: Annotated[float, Range(0)] = 1.5
    """Weight of the mean edge length."""
    edge_power: Annotated[Literal[1, 2], _EDGES] = 1
    """1: mean edge length, as the paper prints it; 2: mean squared length."""
    lambda_smooth_normal: Annotated[float, Range(0)] = 0.01
    """Weight of the angle between neighbouring faces."""
    lambda_laplacian: Annotated[float, Range(0)] = 0.5
    """Weight of the distance of vertices from the mean of their neighbours."""
    lambda_sigma: Annotated[float, Range(0), _SOFT] = 1e-4
    """Weight of sigma^-2; the paper uses 1e-3 and 1e-4."""
    hold: Annotated[int, Range(0)] = 500
    """The weights above are multiplied by a cosine that falls from 1 at this iteration to `final` at the last."""
    final: Annotated[float, Range(0, 1)] = 0.03
    """Where that cosine ends; the paper's ends at 0."""
    depth: Annotated[Literal["auto", "l1", "pearson", "off"], _SOFT] = "auto"
    """What depth maps are taken for, where the capture has them and they do not contradict its photos.
    l1: depths in the capture's units; pearson: depths, or inverse ones, of unknown scale and shift;
    auto: the first of these that agrees with the capture's points, or with the mesh as photos have shaped it."""
    lambda_depth: Annotated[float, Range(0), _DEPTH] = 0.5
    """Weight of the distance from depth maps, of soft triangles: relative (l1), or 1 minus the correlation (pearson).
    The cosine multiplies it too."""


@dataclass(frozen=True)
class Refinement:
    """When faces are subdivided, and those that cut through each other untangled."""

    first: Annotated[float, Range(0, 1), _SUBDIVIDED] = 0.1
    """First subdivision, as a fraction of the iterations."""
    last: Annotated[float, Range(0, 1)] = 0.6
    """Last subdivision, as a fraction of the iterations."""
    subdivisions: Annotated[int, Range(0, 10_000)] = 30
    """Number of subdivisions between these two; each adds the same fraction of faces, up to `max_faces`."""
    flips: Annotated[bool, _SUBDIVIDED] = True
    """After each subdivision edges are flipped to the other diagonal where that makes faces less slender."""
    untanglings: Annotated[int, Range(0, 10_000)] = 6
    """How often faces that cut through others are pushed apart, from the last subdivision to the last step.
    If ever, then once more at 98 % of the run, and from there on vertices stay."""
    reach: Annotated[float, Range(0), _UNTANGLED] = 0.5
    """Folds stay in which a vertex would have to move farther than so many lengths of its edges.
    They may hold up the shape. If it is more than a half, and that spoils the photos, a half is tried (`guard`)."""
    outlines: Annotated[bool, _OUTLINED] = True
    """Once triangles are opaque, vertices are brought to where the masks of all photos have their outlines.
    That is by least squares, to a small fraction of a pixel."""
    guard: Annotated[float, Range(0)] = 0.02
    """A subdivision or untangling is undone where 100 steps later training photos are explained worse;
    that is where their loss, at a small size, is higher by more than this part; 0 lets all of them stay."""


@dataclass(frozen=True)
class Output:
    """What is written and measured, and when."""

    log_every: Annotated[int, Range(1)] = 50
    """Iterations between lines of history.jsonl."""
    evaluate_every: Annotated[int, Range(0)] = 1000
    """Iterations between evaluations for history.jsonl; 0 for one at the end only."""
    checkpoint_every: Annotated[int, Range(0)] = 1000
    """Iterations between checkpoints; 0 for one at the end only."""
    chamfer_samples: Annotated[int, Range(1, 10**7)] = 100_000
    """Points per surface for the Chamfer distance."""
    texture_faces: Annotated[int, Range(4, 10_000_000), _TEXTURED] = LIGHT_FACES
    """At most so many faces under the texture."""
    lpips_weights: Path | None = None
    """Weights file for LPIPS; "download" fetches it; None uses the one in torch's cache or goes without."""


@dataclass(frozen=True, kw_only=True)
class ReconstructConfig(Settings):
    """Settings of `etsplat.reconstruct`; the defaults are preset "best".

    Raises InputError where a setting is out of its range, is none of its choices, or would have no effect.

    Example:
        >>> config = etsplat.ReconstructConfig.of("quick").changed({"iterations": 1000, "optimizer.lr_vertices": 1e-3})
        >>> config.optimizer.lr_vertices
        0.001
    """

    TASK: ClassVar[str] = "reconstruct"
    LABELS: ClassVar[tuple[str, ...]] = ("preset",)

    preset: Preset = "best"
    """Where the other settings start from; in Python, begin with `ReconstructConfig.quick()` and the like.
    best: the closest to the truth that we know, a quarter of an hour on four cores;
    quick: the same in a minute;
    paper: the paper's method at its budget;
    study: the paper's method in two minutes, for comparisons;
    demo, tiny: for `etsplat demo object` and for tests."""
    method: Annotated[str, OneOf(lambda: (*kernel_methods(), *get_args(RasterMethod)))] = "elastic"
    """Kernel of soft triangles: elastic (the paper's), bilateral (2DTS) or single-sided (Triangle Splatting);
    or the name of one of your own, with --kernel-file.
    Opaque triangles with antialiased silhouettes: raster-face or raster-vertex (a colour per face or per vertex)."""
    iterations: Annotated[int, Range(1)] = 30_000
    """Optimization steps; of more than 5,000, fewer where photos carry fewer faces (`pixels_per_face`)."""
    resolution: Annotated[int, Range(1, 8192)] = 1024
    """Side of the pictures taken of a mesh, in pixels; wider images of a scene are scaled down to this width.
    So are close-ups, to which photos are cropped in which the object is small."""
    max_faces: Annotated[int, Range(1)] = 100_000
    """Subdivision stops here, or earlier where photos are small."""
    pixels_per_face: Annotated[float | None, Range(0.01), Rare] = 3.5
    """Subdivision stops where there is a face for so many pixels of the surface, as the photos show it largest.
    Smaller ones learn noise. Iterations beyond 5,000 are in proportion fewer. None for all of both in any case."""
    texture: Annotated[int | None, TEXELS] = None
    """Make a light mesh too, textured.glb: few faces under a texture with so many texels along each side, say 2048.
    It is what `etsplat export --texture` makes of a run. Needs pip install 'etsplat[texture]'."""
    watch: Annotated[int | None, Range(0)] = None
    """One in so many training photos is kept from training, to watch the run by; 0 keeps none.
    None keeps one in 16 where there are at least 24, and none of those that are taken of a mesh.
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
    """Of the order of views and the backgrounds. (Metrics always sample with the same seed.)"""
    device: Device | None = None
    """Where it runs: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    engine: Annotated[str | None, OneOf(training_engines), Rare] = None
    """What computes: cpu, cuda, reference (plain PyTorch, slow), or None for the fastest on the device."""

    pictures: Pictures = Pictures()
    drawing: Drawing = Drawing()
    start: Start = Start()
    optimizer: Optimizer = Optimizer()
    regularization: Regularization = Regularization()
    refinement: Refinement = Refinement()
    output: Output = Output()

    @classmethod
    def best(cls) -> "ReconstructConfig":
        """The closest to the truth that we know; a quarter of an hour on four cores."""
        return cls.of("best")

    @classmethod
    def quick(cls) -> "ReconstructConfig":
        """The same in a minute."""
        return cls.of("quick")

    @classmethod
    def paper(cls) -> "ReconstructConfig":
        """The paper's method at its budget."""
        return cls.of("paper")

    @classmethod
    def study(cls) -> "ReconstructConfig":
        """The paper's method in two minutes, for comparisons."""
        return cls.of("study")

    @classmethod
    def demo(cls) -> "ReconstructConfig":
        """For `etsplat demo object`: quick with fewer steps, for those who wait."""
        return cls.of("demo")

    @classmethod
    def tiny(cls) -> "ReconstructConfig":
        """For tests."""
        return cls.of("tiny")

    @property
    def soft(self) -> bool:
        """Whether triangles are soft."""
        return not self.method.startswith("raster-")

    @property
    def vertex_colored(self) -> bool:
        """Whether colours belong to vertices."""
        return self.drawing.colors == "vertex" if self.soft else self.method == "raster-vertex"

    @property
    def face_colored(self) -> bool:
        """Whether triangles are soft and have a colour each."""
        return self.soft and not self.vertex_colored

    @classmethod
    def implied_by(cls, *labels: str) -> Mapping[str, Any]:
        """What the preset sets."""
        return _PRESETS.get(labels[0], {})

    def contradiction(self) -> str | None:
        """What is wrong with settings that are right one by one."""
        if self.drawing.backend == "nvdiffrast" and self.soft:
            choose = option("method", *get_args(RasterMethod))
            return f"drawing.backend: nvdiffrast draws opaque triangles; choose {choose}"
        if self.watch == 1:
            return "watch: 1 would keep all photos from training; choose 0 or at least 2"
        if self.refinement.first > self.refinement.last:
            return "refinement.first: is after refinement.last; make it smaller"
        return texture_problem(self.texture)


# The paper does without what measurements support beyond it: coarse pictures at first, weights that stay, untangling
# (research/ablations.md), a guard of its edits and a start from the hull. With them the result is closer to the truth,
# and no face cuts through another.
_PAPER: dict[str, Any] = {
    "watch": 0,
    "exposure": "off",
    "pixels_per_face": None,
    "start.shape": "sphere",
    "start.near_fall": "exponential",
    "start.near_iterations": None,
    "pictures.coarse_levels": 0,
    "pictures.coarse_until": 0.5,
    "drawing.harmonics": 0,
    "drawing.opaque_from": 1.0,
    "regularization.final": 0.0,
    "regularization.depth": "off",
    "refinement.flips": False,
    "refinement.untanglings": 0,
    "refinement.guard": 0.0,
    "refinement.outlines": False,
}
# A fifth of the budget.
_QUICK: dict[str, Any] = {
    "resolution": 448,
    "iterations": 5000,
    "max_faces": 25_000,
    "optimizer.lr_vertices": 1e-2,
    "optimizer.lr_opaque": 3e-4,
    "optimizer.lr_harmonics": 2e-3,
    "optimizer.lr_sigma": 3e-4,
    "regularization.hold": 50,
    "refinement.subdivisions": 10,
    "output.evaluate_every": 250,
    "output.checkpoint_every": 500,
}

_PRESETS: dict[str, dict[str, Any]] = {
    "best": {},
    "paper": _PAPER,
    "study": {
        **_PAPER,
        **_QUICK,
        "resolution": 640,
        "iterations": 6000,
        "max_faces": 40_000,
        "optimizer.lr_vertices": 8e-3,
        "regularization.hold": 100,
        "refinement.subdivisions": 15,
        "output.checkpoint_every": 1000,
    },
    "quick": {**_QUICK, "start.near_iterations": 1400, "start.near_rate": 1 / 3, "start.near_pace": 1 / 3},
    "demo": {**_QUICK, "iterations": 1500, "refinement.subdivisions": 5, "refinement.untanglings": 3},
    "tiny": {
        **_PAPER,
        **_QUICK,
        "resolution": 64,
        "iterations": 300,
        "max_faces": 2000,
        "pictures.supersampling": 2,
        "start.level": 2,
        "start.opacity": 0.9,
        "start.sigma": 0.5,
        "optimizer.lr_vertices": 2e-2,
        "optimizer.lr_vertices_final": 0.05,
        "optimizer.lr_colors": 2e-2,
        "optimizer.lr_opacities": 2e-2,
        "optimizer.lr_sigma": 1e-2,
        "regularization.edge_power": 2,
        "regularization.hold": 20,
        "refinement.subdivisions": 5,
        "output.log_every": 20,
        "output.evaluate_every": 100,
        "output.checkpoint_every": 50,
        "output.chamfer_samples": 20_000,
    },
}
"""What each changes of the defaults, by name; `ReconstructConfig.preset` says what each is for."""
