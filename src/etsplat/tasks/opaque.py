"""The opaque mesh of a scene: triangles that any mesh viewer draws as they are, fitted to the same photos.

Most triangles of a soft soup are half transparent, and it is sorted by centroids: drawn opaque it falls apart. So the
mesh is made in two steps. A soup becomes opaque while it is trained (`--finish opaque`), which puts its triangles where
the surfaces are. Then each of its corners gets a colour of its own, the same from every side, and corners and colours
are fitted by the z-buffer with antialiased edges (`ops/antialias.py`): the very picture that a viewer draws. Beside few
photos it is fitted to what the soft soup shows from elsewhere, too (`tasks/soft_views.py`). Triangles in the way of
what photos show are removed, and others halved where pictures are most wrong, or where photos agree. What none of this
shows stays, in the colours of what is around it: other views do. Behind all of them is a closed backdrop, since other
views look through gaps that no training photo shows. What was tried besides is in research/ablations.md.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.shown_width import ShownWidths
from etsplat.geometry.blending import blended
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.optim.exposure import Exposure
from etsplat.optim.objective import Objective
from etsplat.optim.picture_errors import PictureErrors
from etsplat.optim.schedules import NEVER, Schedule, Scheduled, exponential_decay, face_budgets, ramp
from etsplat.optim.strategies import HalveWhereWrong
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.trainer import Trainer
from etsplat.tasks.opened_runs import training_cameras
from etsplat.tasks.pixel_limits import triangle_limit
from etsplat.tasks.running import Job
from etsplat.tasks.settings import get
from etsplat.tasks.soft_views import with_soft_views
from etsplat.tasks.soup_trainer import background_of, shown_across, start_trainer, surroundings_of_run
from etsplat.tasks.train_config import TrainConfig

SOUP_SHARE, SOUP_TRIANGLES, MESH_SHARE = 0.3, 0.5, 1 / 3
"""Of the soup that becomes opaque, where the run's own is soft: its steps and its triangles, as parts of a run's. The
others come where the mesh is wrong. And steps of the mesh (research/ablations.md)."""

VERTEX_RATE, VERTEX_FINAL = 3e-4, 0.03
"""Adam's rate of corners, as a fraction of what photos show across where they are, and its rest at the end."""

SLOWEST, FASTEST = 0.1, 30.0
"""Limits of what photos show across at a corner, beside what they do at the capture's points."""

COLOR_RATE, SETTLING_FROM, SETTLED = 5e-3, 0.7, 0.1
"""Adam's rate of colours; from this part of the steps on it falls, to this part of itself, and photos alone count."""

HALVINGS, FIRST_HALVING, LAST_HALVING = 8, 0.15, 0.65
"""How often triangles are halved, and when, as fractions of the steps."""

DSSIM = 0.2
"""Share of 1 - SSIM in the loss."""

JUDGES = 48
"""Training views, at most, by which it is said where pictures are wrong."""


def fit_opaque_mesh(
    job: Job, soup: TriangleSoup, exposure: Exposure, capture: Dataset, config: TrainConfig
) -> TriangleMesh:
    """The opaque mesh beside a run's soup, in the frame of the capture. It is gone on with where it was interrupted.

    Args:
        job: within its `writing`; of the run.
        soup: the run's own, where the mesh begins if it is opaque.
        exposure: what the run learned of that of the photos.
        capture: photos in the frame that is trained in.
        config: settings of the run.
    """
    views = capture
    if config.finish == "none":
        shorter = towards_opaque(capture, config)
        trainer = start_trainer(_with_points(capture, soup, shorter.max_triangles), shorter, None, job.device)
        trainer.exposure.take_over(exposure)
        views = with_soft_views(capture, soup, mesh_views(config), background_of(config), config.seed)
        soup = job.fit_stage(trainer, shorter.iterations, "soup", "Making opaque triangles").finished()
    trainer = start_mesh(soup, exposure, capture, views, config)
    return finished_mesh(job.fit_stage(trainer, mesh_steps(config), "mesh", "Fitting the opaque mesh"), views)


def start_mesh(
    soup: TriangleSoup, exposure: Exposure, capture: Dataset, views: Dataset, config: TrainConfig
) -> Trainer[TriangleMesh]:
    """The start of the mesh of an opaque soup.

    Args:
        soup: where it begins.
        exposure: as of `fit_opaque_mesh`.
        capture: likewise.
        views: that with soft views, or as it is; what the mesh is fitted to.
        config: settings of the run.
    """
    around = surroundings_of_run(capture, config)
    trainer = make_opaque_trainer(
        opaque_mesh(soup, None if around is None else around.backdrop(capture)),
        views,
        photos=capture,
        iterations=mesh_steps(config),
        unit=shown_across(soup, capture),
        carried=_carried(capture, config),
        max_faces=config.max_triangles,
        around=around,
        background=background_of(config),
        batch=config.batch,
        seed=config.seed,
    )
    trainer.exposure.take_over(exposure)
    return trainer


@torch.no_grad()
def finished_mesh(mesh: TriangleMesh, capture: Dataset) -> TriangleMesh:
    """Gives triangles that no training photo shows the colours of the nearest that one shows: other views show them.

    Args:
        mesh: of separate triangles; changed in place, its backdrop like the rest.
        capture: what it was fitted to.
    """
    shown = torch.zeros(mesh.count, dtype=torch.bool, device=mesh.vertices.device)
    for camera in training_cameras(capture):
        nearest = rasterize_opaque(mesh.vertices, cameras=camera.to(shown.device), faces=mesh.faces).triangle
        assert nearest is not None
        shown[nearest[nearest >= 0].long()] = True
    if bool(shown.any()) and not bool(shown.all()):
        corners, colors = (values.detach().cpu().reshape(-1, 3, 3) for values in (mesh.vertices, mesh.colors))
        shown = shown.cpu()
        guessed = blended(corners[~shown].flatten(0, 1), corners[shown].mean(dim=1), colors[shown].mean(dim=1))
        colors[~shown] = guessed.reshape(-1, 3, 3)
        mesh.colors.copy_(colors.reshape(-1, 3))
    return mesh


def mesh_steps(config: TrainConfig) -> int:
    """How many steps the mesh of a run is fitted for."""
    return max(1, round(MESH_SHARE * config.iterations))


def mesh_views(config: TrainConfig) -> int:
    """How many views it sees in these steps."""
    return mesh_steps(config) * config.batch


def _with_points(capture: Dataset, soup: TriangleSoup, most: int) -> Dataset:
    """The capture with points: where it has none, the middles of so many of the soup's most opaque triangles.

    Random points would all become opaque, and hide the scene from the photos.
    """
    if capture.exact_points is not None:
        return capture
    kept = soup.drawn_opacities.detach().topk(min(most, len(soup))).indices
    points = soup.vertices.detach()[kept].mean(dim=1).cpu().double()
    return replace(capture, exact_points=points, point_colors=soup.display_colors()[kept].cpu())


def towards_opaque(capture: Dataset, config: TrainConfig) -> TrainConfig:
    """Settings of the soup that becomes opaque beside a soft one. The mesh has no colours for each direction."""
    usual = TrainConfig.of(config.preset, config.scene_type)
    without = (
        "drawing.dropout",
        "loss.lambda_opacity",
        "loss.lambda_harmonics",
        "densification.replace_dead",
        "optimizer.lr_sh_rest",
        "schedule.sh_every",
    )
    return config.changed(
        {
            **{name: get(usual, name) for name in without},
            "finish": "opaque",
            "refine_cameras": "off",  # the capture has refined ones by now
            "drawing.sh_degree": 0,
            "iterations": max(1, round(SOUP_SHARE * config.iterations)),
            "max_triangles": max(1, round(SOUP_TRIANGLES * _carried(capture, config))),
        }
    )


def _carried(capture: Dataset, config: TrainConfig) -> int:
    """How many opaque triangles the pixels of the photos carry."""
    return triangle_limit(capture, replace(config, finish="opaque"))


def opaque_mesh(
    soup: TriangleSoup, backdrop: tuple[Float[Tensor, "K 3 3"], Float[Tensor, "K 3 3"]] | None = None
) -> TriangleMesh:
    """The triangles of a soup that are drawn opaque, each corner a vertex of its own, in colours for all directions.

    Args:
        soup: where the mesh begins.
        backdrop: corners of more triangles and the colours of these (`Surroundings.backdrop`); None for no more.
    """
    kept = soup.seen_opaque
    vertices = soup.vertices.detach()[kept].reshape(-1, 3)
    colors = soup.display_colors()[kept].repeat_interleave(3, dim=0)
    if backdrop is not None:
        more = [values.reshape(-1, 3).to(vertices) for values in backdrop]
        vertices, colors = torch.cat([vertices, more[0]]), torch.cat([colors, more[1]])
    faces = torch.arange(len(vertices), device=vertices.device).reshape(-1, 3)
    return TriangleMesh.from_mesh(vertices, faces, colors=colors, opacity=None, sigma=None, vertex_colored=True)


def make_opaque_trainer(
    mesh: TriangleMesh,
    views: Dataset,
    *,
    photos: Dataset | None = None,
    iterations: int,
    unit: float,
    carried: int,
    max_faces: int,
    background: tuple[float, float, float],
    around: Surroundings | None = None,
    batch: int = 1,
    seed: int = 0,
) -> Trainer[TriangleMesh]:
    """From the triangles of an opaque soup to a mesh whose picture is that of the photos.

    Args:
        mesh: the start; changed in place.
        views: what it is fitted to.
        photos: those of them that say what is wrong, and are fitted to alone at last; None for all.
        iterations: steps.
        unit: what the rate of corners is a fraction of, where photos show as much across as at the capture's points.
        carried: most faces that there may be by halving those that are most wrong.
        max_faces: most that there may be where photos agree to halve others.
        background: behind the pictures.
        around: whose backdrop is among the faces; None where none is.
        batch: views of each step.
        seed: of the order of the views.
    """
    times = {"steps": HALVINGS, "first": FIRST_HALVING, "last": LAST_HALVING, "start_faces": mesh.count}
    budgets = face_budgets(iterations, max_faces=max_faces, **times)
    grown = face_budgets(iterations, max_faces=carried, **times)
    more = (after - before for before, after in pairwise([mesh.count, *grown.values()]))
    most_wrong = dict(zip(grown, more, strict=True))
    exposure, photos = Exposure(NEVER), photos or views
    errors = PictureErrors(photos, JUDGES, mesh.vertices.device, torch.tensor(background), exposure, around)
    settling, rates = _settling(iterations), {"vertices": _corners(iterations, unit), "colors": _colors(iterations)}
    return Trainer(
        mesh,
        views,
        Objective(Photometric(DSSIM, pixel="rms")),
        HalveWhereWrong(budgets, errors, most_wrong),
        schedule=Schedule(rates, views=lambda iteration: (views if iteration <= settling else photos).train),
        batch=batch,
        background=background,
        exposure=exposure,
        paces={"vertices": corner_paces(views, unit, around)},
        seed=seed,
    )


def corner_paces(
    capture: Dataset, unit: float, around: Surroundings | None
) -> Callable[[Float[Tensor, "N3 3"]], Float[Tensor, " N3"]]:
    """How much faster than at that unit the corners of separate triangles move: as fast on screen near and far.

    Those of a triangle that no photo shows move at the usual rate, and those of the backdrop not at all: it is closed.
    """
    shown = ShownWidths(capture)

    def paces(corners: Float[Tensor, "N3 3"]) -> Float[Tensor, " N3"]:
        relative = shown(corners.reshape(-1, 3, 3).mean(dim=1)) / unit
        moving = relative.nan_to_num(1.0, posinf=1.0).clamp(SLOWEST, FASTEST).repeat_interleave(3)
        return moving if around is None else moving.masked_fill(around.at_backdrop(corners), 0.0)

    return paces


def _corners(iterations: int, unit: float) -> Callable[[int], float]:
    return lambda iteration: unit * VERTEX_RATE * exponential_decay(iteration, iterations, VERTEX_FINAL)


def _colors(iterations: int) -> Scheduled:
    first = _settling(iterations)
    return lambda iteration: COLOR_RATE * SETTLED ** ramp(iteration, first, iterations)


def _settling(iterations: int) -> int:
    return round(SETTLING_FROM * iterations)
