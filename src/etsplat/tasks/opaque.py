"""The opaque mesh of a scene: triangles that any mesh viewer draws as they are, fitted to the same photos.

Most triangles of a soft soup are half transparent, and it is sorted by centroids: drawn opaque it falls apart. So the
mesh is made in two steps. A soup becomes opaque while it is trained (`--finish opaque`), which puts its triangles where
the surfaces are. Then each of its corners gets a colour of its own, the same from every side, and corners and colours
are fitted by the z-buffer with antialiased edges (`ops/antialias.py`): the very picture that a viewer draws. Triangles
in the way of what photos show are removed, and others halved where pictures are most wrong. What no training photo
shows stays: other views do. What was tried besides is in research/ablations.md.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.shown_width import ShownWidths
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.exposure import Exposure
from etsplat.optim.objective import Objective
from etsplat.optim.picture_errors import PictureErrors
from etsplat.optim.schedules import NEVER, Schedule, Scheduled, exponential_decay, face_budgets, ramp
from etsplat.optim.strategies import HalveWhereWrong
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.trainer import Trainer
from etsplat.tasks.running import Job
from etsplat.tasks.settings import get
from etsplat.tasks.soup_trainer import background_of, shown_across, start_trainer
from etsplat.tasks.train_checks import triangle_limit
from etsplat.tasks.train_config import TrainConfig

SOUP_SHARE, SOUP_TRIANGLES, MESH_SHARE = 0.3, 0.5, 0.4
"""Of the soup that becomes opaque, where the run's own is soft: its steps and its triangles, as parts of a run's. The
others come where the mesh is wrong. And steps of the mesh (research/ablations.md)."""

VERTEX_RATE, VERTEX_FINAL = 3e-4, 0.03
"""Adam's rate of corners, as a fraction of what photos show across where they are, and its rest at the end."""

SLOWEST, FASTEST = 0.1, 30.0
"""Limits of what photos show across at a corner, beside what they do at the capture's points."""

COLOR_RATE, SETTLING_FROM, SETTLED = 5e-3, 0.7, 0.1
"""Adam's rate of colours; from this part of the steps on it falls, to this part of itself."""

HALVINGS, FIRST_HALVING, LAST_HALVING = 5, 0.15, 0.65
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
    if config.finish == "none":
        shorter = towards_opaque(capture, config)
        trainer = start_trainer(_with_points(capture, soup, shorter.max_triangles), shorter, None, job.device)
        _take_over(trainer.exposure, exposure)
        soup = job.fit_stage(trainer, shorter.iterations, "soup", "Making opaque triangles").finished()
    trainer = start_mesh(soup, exposure, capture, config)
    return job.fit_stage(trainer, mesh_steps(config), "mesh", "Fitting the opaque mesh")


def start_mesh(soup: TriangleSoup, exposure: Exposure, capture: Dataset, config: TrainConfig) -> Trainer[TriangleMesh]:
    """The start of the mesh of an opaque soup; arguments are those of `fit_opaque_mesh`."""
    trainer = make_opaque_trainer(
        opaque_mesh(soup),
        capture,
        iterations=mesh_steps(config),
        unit=shown_across(soup, capture),
        max_faces=triangle_limit(capture, config),
        background=background_of(config),
        batch=config.batch,
        seed=config.seed,
    )
    _take_over(trainer.exposure, exposure)
    return trainer


def mesh_steps(config: TrainConfig) -> int:
    """How many steps the mesh of a run is fitted for."""
    return max(1, round(MESH_SHARE * config.iterations))


def _take_over(exposure: Exposure, known: Exposure) -> None:
    """Begins with what is known of the photos, and does not measure them again."""
    exposure.measured_at = NEVER
    exposure.load_state(known.state())


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
            "max_triangles": max(1, round(SOUP_TRIANGLES * triangle_limit(capture, config))),
        }
    )


def opaque_mesh(soup: TriangleSoup) -> TriangleMesh:
    """The triangles of a soup that are drawn opaque, each corner a vertex of its own, in colours for all directions."""
    kept = soup.seen_opaque
    vertices = soup.vertices.detach()[kept].reshape(-1, 3)
    colors = soup.display_colors()[kept].repeat_interleave(3, dim=0)
    faces = torch.arange(len(vertices), device=vertices.device).reshape(-1, 3)
    return TriangleMesh.from_mesh(vertices, faces, colors=colors, opacity=None, sigma=None, vertex_colored=True)


def make_opaque_trainer(
    mesh: TriangleMesh,
    capture: Dataset,
    *,
    iterations: int,
    unit: float,
    max_faces: int,
    background: tuple[float, float, float],
    batch: int = 1,
    seed: int = 0,
) -> Trainer[TriangleMesh]:
    """From the triangles of an opaque soup to a mesh whose picture is that of the photos.

    Args:
        mesh: the start; changed in place.
        capture: what it is fitted to.
        iterations: steps.
        unit: what the rate of corners is a fraction of, where photos show as much across as at the capture's points.
        max_faces: most faces that there may be.
        background: behind the pictures.
        batch: views of each step.
        seed: of the order of the views.
    """
    budgets = face_budgets(
        iterations,
        steps=HALVINGS,
        first=FIRST_HALVING,
        last=LAST_HALVING,
        start_faces=mesh.count,
        max_faces=max_faces,
    )
    exposure = Exposure(NEVER)
    errors = PictureErrors(capture, JUDGES, mesh.vertices.device, torch.tensor(background), exposure)
    return Trainer(
        mesh,
        capture,
        Objective(Photometric(DSSIM, pixel="rms")),
        HalveWhereWrong(budgets, errors),
        schedule=Schedule({"vertices": _corners(iterations, unit), "colors": _colors(iterations)}),
        batch=batch,
        background=background,
        exposure=exposure,
        paces={"vertices": corner_paces(capture, unit)},
        seed=seed,
    )


def corner_paces(capture: Dataset, unit: float) -> Callable[[Float[Tensor, "N3 3"]], Float[Tensor, " N3"]]:
    """How much faster than at that unit the corners of separate triangles move: as fast on screen near and far.

    Those of a triangle that no photo shows move at the usual rate.
    """
    shown = ShownWidths(capture)

    def paces(corners: Float[Tensor, "N3 3"]) -> Float[Tensor, " N3"]:
        relative = shown(corners.reshape(-1, 3, 3).mean(dim=1)) / unit
        return relative.nan_to_num(1.0, posinf=1.0).clamp(SLOWEST, FASTEST).repeat_interleave(3)

    return paces


def _corners(iterations: int, unit: float) -> Callable[[int], float]:
    return lambda iteration: unit * VERTEX_RATE * exponential_decay(iteration, iterations, VERTEX_FINAL)


def _colors(iterations: int) -> Scheduled:
    first = round(SETTLING_FROM * iterations)
    return lambda iteration: COLOR_RATE * SETTLED ** ramp(iteration, first, iterations)
