"""Shape reconstruction (paper section 3.3): posed images of an object in, a run directory with its mesh out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.precision import usual_defaults
from etsplat.core.workers import together
from etsplat.data.agreement import contradicted, looked_at, plain_share, settled, unseen_share, unseen_vertices
from etsplat.data.closed_hollows import closed_hollows
from etsplat.data.cut_off import cut_off
from etsplat.data.dataset import Dataset
from etsplat.data.lids import lids
from etsplat.data.outlines import outlines
from etsplat.data.silhouettes import looks_inverted
from etsplat.engines.choice import engine
from etsplat.engines.threads import one_torch_thread
from etsplat.geometry.parts import Shape, genera, shape_of
from etsplat.io.mesh_files import MeshFile
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.antialias_nvdiffrast import load_nvdiffrast
from etsplat.optim.camera_refinement import CameraRefinement
from etsplat.optim.depth_trust import DepthTrust
from etsplat.optim.exposure import Exposure
from etsplat.optim.guard import Guard
from etsplat.optim.loop import Callback, NoteEvent, StageEvent
from etsplat.optim.objective import Objective
from etsplat.optim.schedules import evenly, face_budgets, regularization_weight
from etsplat.optim.strategies import SubdivideAndUntangle
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.trainer import Trainer
from etsplat.optim.vertex_updates import UniformSteps
from etsplat.tasks.camera_results import conclude_cameras
from etsplat.tasks.cut_hulls import Cut
from etsplat.tasks.depths import trusted_depths, wanted_depths
from etsplat.tasks.export_mesh import Reconstruction
from etsplat.tasks.judgement import (
    DOUBTED,
    TRAINING_VIEWS,
    Judgement,
    Run,
    Shares,
    Start,
    expect_hull,
    expect_mesh,
    expect_photos,
    judge,
    spread,
)
from etsplat.tasks.pixel_limits import within_pixels
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.reconstruct_schedule import held_from, make_schedule, outlines_after, soft_until, while_soft
from etsplat.tasks.running import Job, Result, path_of, settings_for, terms_of
from etsplat.tasks.scoring import Scorer, load_lpips
from etsplat.tasks.sources import Source, directions_digest, fingerprint, load_source, make_subject
from etsplat.tasks.starting_hull import finer_shape
from etsplat.tasks.starts import Started, doubtful_start, load_start, make_start, nearby, within_need
from etsplat.tasks.texturing import check_installed

DEPTHS_NEAR, DEPTHS_FAR = 0.02, 0.15
"""When depth maps are compared with the mesh, as a fraction of a run that starts near the surface, or far from it."""


_CUT: dict[Cut | None, str] = {
    None: "",
    "walls": ", cut out between walls",
    "soup": ", cut open where photos see into it",
    False: ", though photos contradict it",
}
"""What is said of a hull by `Started.cut`."""

_BY_DIRECTION = (
    "colours of the photos follow the direction (they deviate by {:.3f}): harmonics of degree {} explain that while "
    "triangles are soft (drawing.harmonics)"
)


@dataclass(frozen=True)
class ReconstructResult(Result):
    """What a run gives back; all of it is in the run directory too.

    Attributes:
        path: the run directory.
        mesh: the result with its colours, in the units of the input.
        metrics: as in metrics.json.

    Example:
        Of ten steps, as in the example of `etsplat.reconstruct`, which gave this result:

        >>> result.path.name, result.verdict.split(":")[0]
        ('owl', 'poor')
        >>> result.metrics["silhouette_iou"] < 0.9
        True
    """

    OPAQUE = TriangleMesh.OPAQUE

    mesh: MeshFile

    @property
    def verdict(self) -> str:
        """A sentence that begins with "good", "poor" or "not judged"; it says what is wrong and what to try."""
        return self.metrics["judgement"]["verdict"]


@together()
@one_torch_thread()
@usual_defaults()
def reconstruct(
    source: Source,
    out: str | Path,
    config: ReconstructConfig | None = None,
    *,
    init_mesh: str | Path | MeshFile | None = None,
    masks: str | Path | None = None,
    depths: str | Path | None = None,
    depth_unit: float | None = None,
    callbacks: Sequence[Callback] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> ReconstructResult:
    """Deforms a sphere, or the visual hull, into the object that the source shows.

    A run ends with the same bits on the same machine and version of torch, on any number of threads, also if it was
    killed and resumed any number of times, or made by several workers of torchrun (docs/distributed.md), which all call
    this. Ctrl-C leaves a checkpoint of the last whole iteration.

    Args:
        source: a mesh file or `MeshFile`, which is photographed from 40 sides; "demo:owl", an object built in code; a
            folder with posed images and masks, or a `Dataset`. Where the object is, outlines say; without
            them it must be in the unit sphere (`Dataset.renormalized`).
        out: the run directory; made if it does not exist. README.txt in it explains what is there.
        config: settings; None for preset "best". See `ReconstructConfig`.
        init_mesh: a mesh to start from, in the units of the source.
        masks: folder with a mask (white inside the object) for every image of a scene folder, instead of its own masks/
            or the images' transparency.
        depths: folder with depth maps of images (16-bit PNG, NPY or EXR); None for the scene's own, if it has any.
            What becomes of them `regularization.depth` says.
        depth_unit: units of the scene in a step of their numbers; None for what the scene says of them, or else 0.001
            for integers and 1 for others.
        callbacks: each is called with every event, in the thread of the caller. With none a notebook shows a line.
        resume: continue the run in `out`, which must have been started with the same source and settings; from the
            beginning if it has no checkpoint yet.
        overwrite: replace a run in `out`. Nothing but files of a run is ever removed.

    Raises:
        InputError: something handed in cannot be used; earlier results in `out` are as they were.
        DivergedError: the optimization went to NaN or infinity.

    Example:
        >>> tiny = etsplat.ReconstructConfig.tiny().changed({"resolution": 32, "iterations": 10})
        >>> result = etsplat.reconstruct("demo:owl", "runs/owl", tiny)
        >>> result.mesh.vertices.shape[1], sorted(path.name for path in result.path.glob("mesh.*"))
        (3, ['mesh.glb', 'mesh.obj', 'mesh.ply'])
    """
    config = settings_for(config, ReconstructConfig)
    job = Job(config, out, callbacks, resume=resume, overwrite=overwrite)
    for name, given in (("depths", depths), ("depth_unit", depth_unit)):
        if given is not None and not config.soft:
            raise InputError(f"{name}: has no effect with method {config.method}; leave it out, or take soft triangles")
    maps = wanted_depths(depths, depth_unit, config.regularization.depth)
    loaded, notes = load_source(source, config, masks, depths=maps, depth_unit=depth_unit)
    start = load_start(init_mesh)
    hashes = {"fingerprint": fingerprint(loaded), "init_mesh": fingerprint(start)}
    paths = {"source": source, "init_mesh": init_mesh, "masks": masks, "depths": depths}
    held = directions_digest(loaded) if isinstance(loaded, Dataset) else None
    job.identify(hashes, {name: path_of(path) for name, path in paths.items()}, views=held)
    for name, found in (("source", notes), ("init_mesh", start.notes if start else [])):
        for note in found:
            job.announce(NoteEvent(f"{name}: {note}"))
    views, truth = make_subject(loaded, config, job.prepared, job.device)
    for note in views.notes:
        if note not in notes:
            job.announce(NoteEvent(note))
    if (doubt := doubtful_start(start, views)) is not None:
        job.announce(NoteEvent(f"init_mesh: {doubt}"))
    if config.drawing.backend == "nvdiffrast":
        load_nvdiffrast()  # now rather than at the first step
    if config.texture is not None:
        check_installed()
    with engine(config.engine):
        scorer = Scorer(
            views,
            job.device,
            truth=truth,
            samples=config.output.chamfer_samples,
            supersampling=config.pictures.supersampling,
            lpips=load_lpips(config.output.lpips_weights, job.device),
        )
        started = make_start(start, views, config, job.device, job.announce, one_color=truth is not None)
        mesh, begun = started.mesh, started.kind
        judging = partial(_judge, scorer, views, truth, config, started, shape_of(*mesh.surface()))
        if begun == "hull":
            holes = f"holes in each part: {genera(mesh.faces.cpu(), len(mesh.vertices))}"
            form = holes if mesh.topology.is_closed() else "open where photos look onto the inner side of its surface"
            hull = f"the visual hull{_CUT[started.cut]}, {mesh.count:,} faces"
            job.announce(NoteEvent(f"start: {hull}; {form}"))
            config = nearby(config)
        if started.deviation is not None and mesh.degree:
            job.announce(NoteEvent(_BY_DIRECTION.format(started.deviation, mesh.degree)))
        config = _told(job, *within_need(config, started))
        config = _told(job, *within_pixels(config, views, mesh))
        trust = _trusted_depths(views, config, begun, job)
        trainer = make_trainer(mesh, views, config, scorer.cheap, trust, near=begun == "hull", cut=bool(started.cut))
        with job.writing():  # what only the first of several workers does goes through `job.first`
            if views.georeference is not None:
                job.first(partial(views.georeference.write, job.run.path))
            outcome, frame = job.fit(trainer), views.normalization
            mesh, views = outcome.model, conclude_cameras(job, trainer, views, scorer)
            for suffix in (".ply", ".obj", ".glb"):
                job.first(partial(mesh.save, job.run.mesh_path(suffix), frame))
            sizes = {"faces": len(mesh.faces), "vertices": len(mesh.vertices)}
            sizes["edits_undone"] = len(trainer.guard.undone) if trainer.guard else 0
            exposed = job.exposed(trainer.exposure, views.names)
            scores = job.first(lambda: scorer.full(mesh, job.run.test))
            found = {**scores, **sizes, **outcome.metrics, **trainer.trial.metrics, **exposed}
            found |= {} if trust is None else trust.metrics()
            judgement = job.first(partial(judging, mesh, found))
            found |= job.first(lambda: _texture(job, views, scorer, config))
            metrics = job.finish(trainer.progress, {**found, "judgement": judgement.to_dict()}, mesh.vertices)
            job.first(lambda: job.run.conclude(judgement.verdict))
    return ReconstructResult(job.run.path, metrics, mesh.to_file(frame))


def _told(job: Job, config: ReconstructConfig, about: str | None) -> ReconstructConfig:
    """These settings; if there is something to say of them, the run says it, and has their length from here on."""
    if about is not None:
        job.announce(NoteEvent(about))
        job.shorten(config.iterations)
    return config


def _trusted_depths(views: Dataset, config: ReconstructConfig, begun: Start, job: Job) -> DepthTrust | None:
    """Compared with the mesh soon where that starts near the surface, or else when photos have shaped it."""
    weights = config.regularization
    first = DEPTHS_NEAR if begun != "sphere" else DEPTHS_FAR
    if not config.soft and views.images.with_depth:
        job.announce(NoteEvent(f"depth maps: method {config.method} has no use for them; they are left out"))
    choice = weights.depth if weights.lambda_depth and config.soft else "off"
    return trusted_depths(views, choice, max(1, round(first * config.iterations)), job.announce)


def _texture(job: Job, views: Dataset, scorer: Scorer, config: ReconstructConfig) -> dict[str, Any]:
    """Makes textured.glb of the mesh that the run has written, where that is asked for; for metrics.json, what it is.

    The same file as of `etsplat export`. A run that is interrupted here makes it anew.
    """
    if config.texture is None:
        return {}
    views = replace(views, train=sorted([*views.train, *views.watched]), watched=[])
    done = Reconstruction.of(job.run, views, job.device)
    mesh = done.textured(
        config.texture, config.output.texture_faces, tell=lambda *state: job.announce(StageEvent(*state))
    )
    done.in_own_units(mesh).save(job.run.textured_path)
    seen = scorer.opaque(mesh.to(job.device), views.test)
    return {"psnr_textured": seen["psnr_mesh"], "textured_faces": mesh.count, "texture": config.texture}


def _judge(
    scorer: Scorer,
    views: Dataset,
    truth: MeshFile | None,
    config: ReconstructConfig,
    started: Started,
    start: Shape,
    mesh: TriangleMesh,
    scores: Mapping[str, Any],
) -> Judgement:
    """A run ends with the parts and holes of its start, so those of a hull are what its silhouettes show.

    Args:
        scorer: of the run.
        views: all of them.
        truth: the mesh that was photographed, if one was.
        config: of the run.
        started: from what.
        start: the parts and holes that it had, before it was fitted.
        mesh: the result.
        scores: of it.
    """
    found = shape_of(*mesh.surface())
    doubtful, hull = started.contradicted > DOUBTED, started.hull
    from_photos = truth is None and views.has_masks
    looked = looked_at(views, *mesh.surface()) if doubtful or from_photos else None
    if truth is not None:
        expected = expect_mesh(truth, views, found, config.start.radius)
    elif hull is not None:
        expected = expect_hull(start, finer_shape(hull, views, config.start.radius), 2 * hull.wanted)
    else:
        expected = expect_photos(views, found, config.start.radius)
    return judge(
        "test" if views.test else "training",
        scores if views.test else scorer.opaque(mesh, spread(views.train, TRAINING_VIEWS)),
        100 * scores["self_intersections"] / mesh.count,
        found,
        expected,
        Shares(
            contradicted=contradicted(looked, mesh.display_face_colors.cpu()) if doubtful else 0.0,
            cut_off=0.0 if hull is None else cut_off(views, hull.vertices, hull.faces),
            closed=0.0 if truth is None else closed_hollows(views, (truth.vertices, truth.faces), mesh.surface()),
            grown_over=_grown_over(views, started, mesh) if from_photos else 0.0,
            plain=plain_share(looked) if from_photos else 0.0,
            unseen=unseen_share(looked) if from_photos else 0.0,
        ),
        Run(
            begun=started.kind,
            preset=config.preset,
            untangled=config.refinement.untanglings > 0,
            photos=len(views.train),
            inverted=from_photos and looks_inverted(views),
            lacking=0.0 if hull is None else hull.uncovered,
        ),
    )


def _grown_over(views: Dataset, started: Started, mesh: TriangleMesh) -> float:
    """Where a hollow that was cut open is closed again, of what photos see of the start."""
    if not started.cut or started.opened is None:
        return 0.0
    return closed_hollows(views, (started.opened.vertices, started.opened.faces), mesh.surface())


def _paces(
    mesh: TriangleMesh, views: Dataset, config: ReconstructConfig, *, near: bool, cut: bool
) -> dict[str, Callable[[Tensor], Tensor]]:
    """Those of a mesh's vertices: what no view sees of a start that was cut open rests, what views agree on is slow."""
    if not cut and (not near or config.start.near_pace == 1):
        return {}
    measure = unseen_vertices(views) if cut else settled(views)
    slow = 0.0 if cut else config.start.near_pace

    def paces(vertices: Tensor) -> Tensor:
        found = measure(vertices.cpu(), mesh.faces.cpu().long()).to(vertices)
        return 1 - (1 - slow) * found

    return {"vertices": paces}


def make_trainer(
    mesh: TriangleMesh,
    views: Dataset,
    config: ReconstructConfig,
    evaluate: Callable[[TriangleMesh], dict[str, float]] | None = None,
    depths: DepthTrust | None = None,
    *,
    near: bool = False,
    cut: bool = False,
) -> Trainer[TriangleMesh]:
    """The paper's way from a start to the object that views show: L_mesh, Adam, subdivision.

    Args:
        mesh: the start; changed in place.
        views: what it is fitted to.
        config: settings.
        evaluate: cheap metrics of a mesh.
        depths: which depth maps are believed; None where none are used.
        near: whether the start is near the surface, so that what no view sees of the mesh is no part of it on its way.
        cut: whether it has hollows that were cut out: their walls are where they belong beyond what views see of them,
            and what none sees stays as it is. Lids are looked for no more: both sides of plain walls look alike.
    """
    length, regularization, refinement = config.iterations, config.regularization, config.refinement
    terms = terms_of(
        regularization,
        leaving=[*([] if config.soft else ["sigma"]), *(["depth"] if depths is None else [])],
        scheduled={"depth": partial(while_soft, last=soft_until(config))},
        arguments={"edge": {"power": regularization.edge_power}, "depth": {"trust": depths}},
    )
    gamma = partial(regularization_weight, iterations=length, hold=regularization.hold, final=regularization.final)
    budgets = face_budgets(
        length,
        steps=refinement.subdivisions,
        first=refinement.first,
        last=refinement.last,
        start_faces=mesh.count,
        max_faces=config.max_faces,
    )
    untanglings = evenly(length, refinement.untanglings, refinement.last)
    untanglings += [held_from(config)] if untanglings else []
    exposure = Exposure.of(config.exposure, length, len(views.train) / config.batch)
    smoothing = config.optimizer.large_steps_weight if config.optimizer.vertex_update == "large-steps" else None
    return Trainer(
        mesh,
        views,
        Objective(Photometric(), terms, scale=gamma),
        SubdivideAndUntangle(
            budgets,
            untanglings,
            flips=refinement.flips,
            reach=refinement.reach,
            unseen=unseen_vertices(views) if near and not cut else None,
            lids=lids(views, exposure.matrices) if near and not cut else None,
            outlines=outlines(views),
            outlines_after=outlines_after(config),
        ),
        schedule=make_schedule(config, mesh.appearance, near=near),
        batch=config.batch,
        exposure=exposure,
        depths=depths,
        cameras=CameraRefinement.of(config.refine_cameras, length, len(views.train) / config.batch),
        update=None if config.optimizer.vertex_update == "adam" else UniformSteps(smoothing),
        paces=_paces(mesh, views, config, near=near, cut=cut),
        evaluate=evaluate,
        guard=Guard(tolerance=refinement.guard, until=length) if refinement.guard else None,
        seed=config.seed,
    )
