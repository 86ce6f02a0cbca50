"""What a reconstruction starts from: a sphere, the visual hull, or a given mesh."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from etsplat.data.agreement import looked_at
from etsplat.data.dataset import Dataset
from etsplat.data.directional_colors import directional_deviation
from etsplat.data.false_handles import silhouette_errors
from etsplat.data.hollows import Opened
from etsplat.data.kept import keeping
from etsplat.data.photos import photos_of
from etsplat.data.plain_sides import with_flat_sides
from etsplat.data.silhouettes import silhouette, touches_border
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.untangle import untangle
from etsplat.io.mesh_files import MeshFile, load_exported, weld_vertices
from etsplat.io.paths import given_path
from etsplat.model.triangle_mesh import MeshAppearance, TriangleMesh
from etsplat.optim.loop import Event, StageEvent
from etsplat.tasks.cut_hulls import Cut, cut_open, open_hull
from etsplat.tasks.judgement import CONTRADICTED, Start
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.starting_hull import Hull, hull_faces, plain_hull

_LOST = 0.05
"""The part of silhouettes that a hull may leave uncovered, in the mean, where most photos cut the object off: less than
a limb."""

_DOUBTFUL, _AGREED = 0.05, 0.5
"""A hull is near the surface all over if it was not cut, and no larger part of its vertices was moved or is not seen by
two photos: hollows, which travel on to the end of a run; and if photos agree on so many, which they hardly do on thin
parts."""

_OPAQUE_FROM = 0.8
"""From this fraction of a run on triangles are opaque, where a hull is near the surface all over: what is left to do is
at outlines. Hollows are opened while triangles are soft."""

_BESIDE, _OTHER_SIZE = 1.0, 4.0
"""A given mesh is doubted that is farther from the object than that, in radii of the larger one, or so many times as
large or small: of half the diagonal of its box."""

_DEGREE, _DEVIATES = 2, 0.026
"""Degree of the harmonics where colours that follow the direction deviate by more. In six objects before plain
backgrounds, glossy ones too, they do by 0.011 to 0.021, in photos of four real ones by 0.032 to 0.051."""


class Started(NamedTuple):
    """What a run starts from.

    Attributes:
        mesh: in the unit frame.
        kind: where it comes from.
        opened: the hull with its hollows open, and what photos say of it; None for another kind.
        hull: that it was, before it was mended; None for another kind.
        cut: by what it was cut open, if by anything; None where it was not, and photos do not contradict it.
        deviation: of its colours, as of `directional_deviation`; None where it was not measured.
    """

    mesh: TriangleMesh
    kind: Start
    opened: Opened | None = None
    hull: Hull | None = None
    cut: Cut | None = None
    deviation: float | None = None

    @property
    def contradicted(self) -> float:
        """The largest patch of a hull that photos contradict, as a fraction of its area; 0 for another kind."""
        return 0.0 if self.opened is None else self.opened.contradicted


def load_start(start: str | Path | MeshFile | None) -> MeshFile | None:
    """Reads the mesh to start from and merges vertices at equal positions, so that neighbours move together.

    One that `etsplat export` moved is led back to the units and axes of its run, with a note.

    Raises ValueError where the arrays of a mesh in memory are no such arrays, InputError for what is no mesh.
    """
    if start is None:
        return None
    if isinstance(start, MeshFile):
        start.check()
        return weld_vertices(start)
    return weld_vertices(load_exported(given_path("init_mesh", start, "a path or a MeshFile"))[0])


def doubtful_start(start: MeshFile | None, views: Dataset) -> str | None:
    """A note where a mesh to start from is elsewhere than the object, or much larger or smaller; None where it is not.

    Args:
        start: from `load_start`, in the input's units.
        views: of the unit frame.
    """
    if start is None:
        return None
    places = views.normalization.apply(start.vertices)
    low, high = places.aminmax(dim=0)
    middle, radius = (low + high) / 2, float((high - low).norm()) / 2
    if float(middle.norm()) <= _BESIDE * max(1, radius) and 1 / _OTHER_SIZE <= radius <= _OTHER_SIZE:
        return None
    where = f"it is {radius:.2g} times as large as the object, {float(middle.norm()):.2g} of the object's radii from it"
    return f"{where}: is it in the units and axes of the input?"


def start_shape(config: ReconstructConfig, views: Dataset) -> Literal["sphere", "hull"]:
    """What "auto" amounts to, or what is asked for.

    Args:
        config: settings.
        views: from `make_subject`.
    """
    if config.start.shape != "auto":
        return config.start.shape
    if not views.has_masks:
        return "sphere"
    whole = [not touches_border(silhouette(views.images[index])) for index in views.train]
    return "hull" if 2 * sum(whole) > len(views.train) or _explained(views, config) else "sphere"


@torch.no_grad()
def _explained(views: Dataset, config: ReconstructConfig) -> bool:
    """Whether the hull covers what photos show, though most of them cut it off."""
    surface = visual_hull(views, hull_faces(config), radius=config.start.radius)
    if len(surface[1]) == 0:
        return False
    lost, _ = silhouette_errors(photos_of(views), *surface).unbind(dim=1)
    return float(lost.mean()) <= _LOST


@keeping()
def make_start(
    start: MeshFile | None,
    views: Dataset,
    config: ReconstructConfig,
    device: torch.device | None = None,
    tell: Callable[[Event], None] = lambda event: None,
    *,
    one_color: bool = False,
) -> Started:
    """The mesh that a run starts from, in the unit frame: an icosphere around the object, its hull, or the given mesh.

    Args:
        start: from `load_start`, in the input's units; its colours are used if it has the kind that is optimised.
        views: of the unit frame.
        config: shape, colour, opacity and softness.
        device: of the mesh; None for the CPU.
        tell: called before what takes long, and while it does. What it raises ends this.
        one_color: whether places have one colour from all sides, as in pictures of a mesh.

    Raises:
        InputError: the hull is asked for, and the views have no masks, or masks that exclude everything.
    """
    colors: Tensor | float = config.start.color
    kind: Start = start_shape(config, views) if start is None else "mesh"
    opened, hull, cut, surface = None, None, None, None
    if kind == "hull":
        tell(StageEvent("Carving the visual hull", 0, 0))
        hull = plain_hull(views, config)
        opened = open_hull(views, hull.vertices, hull.faces, config.max_faces, tell)
        if not _near(opened):
            opened, cut = cut_open(views, hull, opened, config, device, tell)
        faces = opened.faces
        tell(StageEvent("Untangling the start", 0, 0))
        vertices = with_flat_sides(views, opened.vertices, faces)
        vertices = untangle(vertices, MeshTopology.from_faces(faces, len(vertices)))[0]
        surface = opened.vertices, faces
    elif start is None:
        vertices, faces = icosphere(config.start.level)
        vertices = vertices * config.start.radius
    else:
        vertices, faces = surface = views.normalization.apply(start.vertices), start.faces
        given = start.vertex_colors if config.vertex_colored else start.face_colors
        colors = config.start.color if given is None else given
    degree, deviation = (0, None) if one_color else _degree(config, views, surface)
    kernel = config.method.replace("-", "_") if config.soft else None
    mesh = TriangleMesh.from_mesh(
        vertices.to(device or "cpu"),
        faces.to(device or "cpu"),
        colors=colors,
        opacity=config.start.opacity if config.soft else None,
        sigma=config.start.sigma if config.soft else None,
        vertex_colored=config.vertex_colored,
        appearance=MeshAppearance(kernel, config.drawing.distance, config.drawing.backend),
        harmonics=degree,
    )
    return Started(mesh, kind, opened, hull, cut, deviation)


def _degree(
    config: ReconstructConfig, views: Dataset, surface: tuple[Tensor, Tensor] | None
) -> tuple[int, float | None]:
    """Of the harmonics, and what was measured for it on a surface; None where nothing was."""
    asked = config.drawing.harmonics
    if asked is not None or surface is None or not config.face_colored or not views.has_masks:
        return asked or 0, None
    looked = looked_at(views, *surface)
    deviation = 0.0 if looked is None else directional_deviation(looked)
    return _DEGREE if deviation > _DEVIATES else 0, deviation


def nearby(config: ReconstructConfig) -> ReconstructConfig:
    """The settings for a start that is near the surface."""
    start, rates, weights, edits = config.start, config.optimizer, config.regularization, config.refinement
    return replace(
        config,
        optimizer=replace(rates, lr_vertices=start.near * rates.lr_vertices),
        regularization=replace(weights, lambda_edge=start.near_edge * weights.lambda_edge),
        refinement=replace(edits, reach=start.near_reach) if edits.untanglings else edits,
    )


def within_need(config: ReconstructConfig, started: Started) -> tuple[ReconstructConfig, str | None]:
    """The settings for a hull that is near the surface all over: triangles are opaque sooner.

    With `start.near_iterations` there are also fewer iterations: noise goes on making dents as long as a run lasts.
    A hull that was cut out between walls has all of them, at the same rate of vertices: photos agree on its walls, and
    at the whole rate noise throws flaps of the rim over the opening, which stay where it is dark behind them.

    Args:
        config: as asked for. A length that is not its preset's own stays.
        started: from `make_start`.

    Returns:
        What the run is made with; and a sentence about its length, or None if that is what was asked for.
    """
    if started.cut:
        return _slower(config) if started.cut == "walls" else config, None
    if not _near(started.opened):
        return config, None
    if config.drawing.opaque_from < 1:
        sooner = min(config.drawing.opaque_from, _OPAQUE_FROM)
        config = replace(config, drawing=replace(config.drawing, opaque_from=sooner))
    enough, own = config.start.near_iterations, ReconstructConfig.of(config.preset).iterations
    if enough is None or config.iterations != own or own <= enough:
        return config, None
    less = f"{enough:,} iterations, not {own:,}, and vertices at {config.start.near_rate:.2g} of their rate"
    about = f"the hull is near the surface all over: {less} (start.near_iterations)"
    return replace(_slower(config), iterations=enough), about


def _slower(config: ReconstructConfig) -> ReconstructConfig:
    """Vertices, all of them, at the rate that is enough near the surface."""
    rates, start = config.optimizer, replace(config.start, near_pace=1.0)
    slower = replace(rates, lr_vertices=config.start.near_rate * rates.lr_vertices)
    return replace(config, optimizer=slower, start=start)


def _near(opened: Opened | None) -> bool:
    """Whether a hull is near the surface all over, as far as photos tell."""
    if opened is None:
        return False
    return opened.doubtful <= _DOUBTFUL and opened.agreed >= _AGREED and opened.contradicted <= CONTRADICTED
