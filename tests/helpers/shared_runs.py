"""Small runs that any number of workers make, and what became of them."""

import math
import os
import signal
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import torch.distributed as dist
from safetensors.torch import load_file

from etsplat.core.errors import InputError
from etsplat.core.workers import Workers, workers
from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.demo_scene import demo_scene
from etsplat.data.photograph import photograph
from etsplat.data.pictures import LazyPictures, Picture, StoredPictures
from etsplat.geometry.icosphere import icosphere
from etsplat.io.run_directory import RunDirectory
from etsplat.model.soup_init import StartPoints, start_soup
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim import drive
from etsplat.optim.checkpoints import list_checkpoints
from etsplat.optim.drive import digest_of
from etsplat.optim.exposure import Exposure
from etsplat.optim.guard import Guard
from etsplat.optim.loop import LoopSettings, RefineEvent, optimize
from etsplat.optim.objective import Custom, Drawing, Objective, Term
from etsplat.optim.schedules import Schedule, face_budgets
from etsplat.optim.strategies import DensifyAndPrune, SubdivideAndUntangle
from etsplat.optim.terms.mesh import EdgeLength, Laplacian, SmoothNormals, Softness
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.terms.soup import DepthNormals, Harmonics, Opacity, Size
from etsplat.optim.trainer import Trainer

ITERATIONS = 14


@cache
def a_scene() -> Dataset:
    """Photos of two sizes, a mask for every third, few points."""
    scene = demo_scene(28, 24)
    assert scene.exact_points is not None
    assert scene.point_colors is not None
    scene = replace(scene, exact_points=scene.exact_points[::30], point_colors=scene.point_colors[::30])
    pixels, masks, Ks = [], [], scene.Ks.clone()
    for index in range(len(scene)):
        photo = scene.images[index]
        if index % 2:
            photo = photo[2:22, 4:24].contiguous()
            Ks[index, 0, 2] -= 4
            Ks[index, 1, 2] -= 2
        mask = torch.full(photo.shape[:2], 255, dtype=torch.uint8)
        mask[:, : photo.shape[1] // 3] = 0
        pixels.append(photo)
        masks.append(mask if index % 3 == 0 else None)
    return replace(scene, Ks=Ks, images=StoredPictures(pixels, masks)).normalized()


@cache
def an_object() -> Dataset:
    """Photos with transparency; two are kept aside to watch the run by."""
    views = photograph(demo_object(), 20, 20, elevations=(-35.0, 35.0), azimuths=6, supersampling=1)
    return replace(views, train=views.train[2:], watched=views.train[:2])


def fit_counted(kind: str, batch: int) -> dict[str, Any]:
    """What the steps of a run ask of torch.distributed: calls, and bytes of this worker's own and of others'."""
    counted = dict.fromkeys(("broadcasts", "gatherings", "own", "received"), 0)
    broadcast, all_gather, rank = dist.broadcast, dist.all_gather, workers().rank

    def broadcasting(tensor: torch.Tensor, src: int, **options: Any) -> Any:
        counted["broadcasts"] += 1
        counted["own" if src == rank else "received"] += tensor.numel() * tensor.element_size()
        return broadcast(tensor, src=src, **options)

    def gathering(found: list[torch.Tensor], tensor: torch.Tensor, **options: Any) -> Any:
        counted["gatherings"] += 1
        return all_gather(found, tensor, **options)

    dist.broadcast, dist.all_gather = broadcasting, gathering
    trainer = trainer_of(kind, batch)
    try:
        for event in optimize(trainer, LoopSettings(ITERATIONS, ITERATIONS, 0, 0), trainer.progress, None, None):
            assert event is not None
    finally:
        dist.broadcast, dist.all_gather = broadcast, all_gather
    return {**counted, "sent": dict(workers().sent), "rank": rank}


def photos_read(batch: int) -> dict[str, Any]:
    """Which photos a worker reads that may keep a quarter of them: to check them, and in the steps of a run."""
    scene, made = a_scene(), list[int]()
    stored, sizes = scene.images, [4 * width * height for width, height in scene.images.sizes]

    def make(index: int) -> Picture:
        made.append(index)
        return stored.picture(index)

    photos = LazyPictures(make, stored.sizes, sizes, stored.fingerprint, limit=sum(sizes) // 4)
    photos.preload()
    checked = sorted(made)
    made.clear()
    trainer = Trainer(_soup(scene), replace(scene, images=photos), Objective(Photometric(0.2)), batch=batch)
    for _ in optimize(trainer, LoopSettings(ITERATIONS, ITERATIONS, 0, 0), trainer.progress, None, None):
        assert photos.held_bytes <= sum(sizes) // 4
    return {"checked": checked, "made": list(made), "photos": len(sizes)}


def _soup(data: Dataset) -> TriangleSoup:
    assert data.points is not None
    assert data.point_colors is not None
    points, rng = StartPoints(data.points, data.point_colors), torch.Generator().manual_seed(1)
    return start_soup(points, rng, scale=2.0, opacity=0.4, sigma=0.8, sh_degree=2)


def handed_round(owners: list[int]) -> tuple[list[str], list[list[int]]]:
    """What a worker did to hand messages round, in its order, and these."""
    did, broadcast = list[str](), dist.broadcast

    def make(number: int) -> torch.Tensor:
        did.append(f"make {number}")
        return torch.full((number + 1,), number, dtype=torch.uint8)

    def broadcasting(tensor: torch.Tensor, src: int, **options: Any) -> Any:
        did.append(f"from {src}")
        return broadcast(tensor, src=src, **options)

    dist.broadcast = broadcasting
    try:
        return did, [message.tolist() for message in workers().hand_round(make, owners)]
    finally:
        dist.broadcast = broadcast


def with_nan(dataset: Dataset, view: int) -> Dataset:
    """One photo is not a number somewhere."""
    pixels = [dataset.images[index].clone() for index in range(len(dataset))]
    stored = StoredPictures(pixels)
    pixels[view][3, 4] = math.nan  # as a file may have it, of which nothing is known before it is read
    return replace(dataset, images=stored)


def trainer_of(kind: str, batch: int) -> Trainer[Any]:
    """Of a soup that grows and is pruned, or a mesh that is subdivided, with a guard."""
    if kind in ("soup", "normals", "inseparable"):
        data = a_scene()
        terms: list[Term] = [Opacity(0.005), Harmonics(0.1), Size(1e-6)]
        if kind == "normals":
            terms.append(DepthNormals(1e-3))
        if kind == "inseparable":
            terms += [Custom(_near_what_is_seen, 1e-3, outputs=("depth",)), Custom(_small, 1e-3)]
        objective = Objective(Photometric(0.2), terms, depth_of="centroid")
        strategy = DensifyAndPrune(begin=3, every=4, max_triangles=400)
        exposure = Exposure(6, needed=-math.inf)
        return Trainer(_soup(data), data, objective, strategy, batch=batch, exposure=exposure)
    data = an_object()
    if kind == "nan":
        data = with_nan(data, data.train[5])
    vertices, faces = icosphere(2)
    mesh = TriangleMesh.from_mesh(1.05 * vertices, faces, colors=0.5, opacity=0.9, sigma=0.5)
    terms = [EdgeLength(0.5), SmoothNormals(0.01), Laplacian(0.2), Softness(1e-4)]
    budgets = face_budgets(ITERATIONS, steps=2, first=0.3, last=0.6, start_faces=mesh.count, max_faces=500)
    rates = Schedule({"vertices": 1e-2, "colors": 2e-2, "opacity_logits": 1e-2, "log_sigma": 1e-2})
    strategy = SubdivideAndUntangle(budgets)
    return Trainer(
        mesh, data, Objective(Photometric(), terms), strategy, schedule=rates, batch=batch, guard=Guard(steps=3)
    )


def _near_what_is_seen(drawing: Drawing) -> torch.Tensor:
    """Of parameters and pictures at once."""
    assert drawing.rendering.depth is not None
    return drawing.rendering.depth.mean() * drawing.model.vertices.square().mean()


def _small(drawing: Drawing) -> torch.Tensor:
    """Of corners and of colours, by nobody's word of parameters alone."""
    return drawing.model.vertices.square().mean() + drawing.model.sh_dc.square().mean()


def fit(kind: str, batch: int, folder: Path | None = None, until: int = ITERATIONS) -> dict[str, Any]:
    """A run, or what is left of it: the state at its end, and what it said of edits."""
    trainer, edits = trainer_of(kind, batch), []

    def tell(event: object) -> None:
        if isinstance(event, RefineEvent):
            edits.append(event.added)

    options = {"run": folder, "run_hash": kind} if folder else {}
    trainer.fit(until, callbacks=[tell], log_every=5, checkpoint_every=5, **options)
    sent = dict(workers().sent)
    return {"state": digest_of(trainer.state()), "count": trainer.count, "edits": edits, "sent": sent}


def gradients_of_steps(kind: str, batch: int, steps: int) -> list[dict[str, bytes]]:
    """The bits of all gradients that Adam gets, and the loss, step by step."""
    trainer, found = trainer_of(kind, batch), list[dict[str, bytes]]()
    make_step = trainer.adam.step

    def step(decays: Mapping[str, float] | None = None) -> None:
        gradients = {name: parameter.grad for name, parameter in trainer.adam.parameters.items()}
        found.append({name: t.contiguous().numpy().tobytes() for name, t in gradients.items() if t is not None})
        found[-1]["decays"] = repr(decays).encode()
        make_step(decays)

    trainer.adam.step = step
    for iteration in range(1, steps + 1):
        loss = trainer._stepper.advance(iteration, iteration, ())
        found[-1]["loss"] = repr(loss).encode()
    return found


class TwoInOne(Workers):
    """The first of two workers, who makes the part of the second as well."""

    def __init__(self) -> None:
        super().__init__(0, 2)
        self.messages: list[torch.Tensor] = []

    def hand_round(self, make: Any, owners: Any) -> Any:
        self.messages += map(make, range(len(owners)))
        return iter(self.messages[-len(owners) :])


@cache
def fit_alone(kind: str, batch: int) -> dict[str, Any]:
    """What one process makes of it, and the digest of its checkpoint."""
    with TemporaryDirectory() as folder:
        run = fit(kind, batch, Path(folder) / "run")
        return {**run, "checkpoint": digest_of_checkpoint(Path(folder) / "run")}


def fit_swapped(kind: str, batch: int) -> dict[str, Any]:
    """A run in whose sums the second view of a step changes places with the third."""
    honest = Workers.hand_round

    def swapped(self: Workers, make: Any, owners: Any) -> Any:
        first, second, third, *others = honest(self, make, owners)
        return iter([first, third, second, *others])

    Workers.hand_round = swapped
    try:
        return fit(kind, batch)
    finally:
        Workers.hand_round = honest


def fit_unlike(what: str) -> None:
    """A run of workers of which the second differs from the first."""
    second = workers().rank == 1
    trainer = trainer_of("mesh", 4)
    if what == "seed" and second:
        trainer = trainer_of("soup", 4)
    if what == "parameter":

        def disturb(iteration: int) -> None:
            if second and iteration == 7:
                trainer.model.colors.data[0, 0] += 1e-6

        trainer.onlooker = disturb
    said = drive.about_this
    if what == "instruction set" and second:
        drive.about_this = lambda: {**said(), "instruction set": "another"}
    try:
        trainer.fit(ITERATIONS, log_every=5)
    finally:
        drive.about_this = said


def fit_interrupted(kind: str, batch: int, folder: Path) -> int:
    """A run of which one worker is asked to stop; which iteration it stopped at."""
    trainer = trainer_of(kind, batch)

    def stop(iteration: int) -> None:
        if workers().rank == 1 and iteration == 7:
            os.kill(os.getpid(), signal.SIGINT)

    trainer.onlooker = stop
    try:
        trainer.fit(ITERATIONS, log_every=5, checkpoint_every=5, run=folder, run_hash=kind)
    except KeyboardInterrupt:
        return trainer.progress.iteration
    raise AssertionError("nobody was interrupted")


def made_by_first() -> int:
    return workers().from_first(lambda: workers().rank)


def failed_by_first() -> None:
    def fail() -> None:
        raise InputError("disk: full")

    workers().from_first(fail)


def mapped(count: int) -> list[int]:
    return workers().map(lambda number: number**2, range(count))


def digest_of_checkpoint(folder: Path) -> str:
    """Of the last one of a run, but for the seconds that it took, and of what it is called."""
    path = list_checkpoints(RunDirectory(folder).checkpoints)[-1]
    tensors = load_file(path)
    tensors["progress"] = tensors["progress"][1:]
    return f"{path.name} {digest_of(tensors)}"


def same(values: Sequence[Any]) -> bool:
    return all(value == values[0] for value in values)
