"""The visual hull alone, beside which a reconstruction must be worth its time. Made once, and kept."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.where_up import up_of
from etsplat.engines.choice import engine, resolve_device
from etsplat.io.atomic import write_error
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.sources import load_source, make_subject
from etsplat.tasks.starting_hull import plain_hull
from studies.grid.writing import write_text
from studies.objects.subjects import Subject


@dataclass(frozen=True)
class Hull:
    """The hull of an object's photos, and what only the photos tell.

    Attributes:
        mesh: its file, in the units of the source; None where there is no hull.
        problem: why there is none, in a sentence; None where there is one.
        silhouette_iou: mean over the test views; None where there are none.
        seconds: that it took.
        up: where up is in the world, as a unit vector; None where the cameras contradict each other.
    """

    mesh: Path | None
    problem: str | None
    silhouette_iou: float | None
    seconds: float
    up: list[float] | None


def hull_of(subject: Subject, config: ReconstructConfig, folder: Path) -> Hull:
    """The hull as a run with these settings starts from it, but with its hollows closed.

    Args:
        subject: whose photos are read or taken.
        config: resolution, faces, and how many photos are left out.
        folder: keeps it; what is there for the same source and settings is not made again.

    Raises:
        InputError: the source cannot be used, or the folder cannot be written.
    """
    mesh, record = folder / "mesh.ply", folder / "hull.json"
    made_of = {"source": str(subject.source.resolve()), "config": config.to_dict()}
    known = json.loads(record.read_text(encoding="utf-8")) if record.is_file() else {}
    if any(known.get(key) != value for key, value in made_of.items()):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise write_error(folder, error) from error
        with engine(config.engine):
            known = {**made_of, **_carve(subject, config, mesh)}
        write_text(record, json.dumps(known, indent=2) + "\n")
    found = {key: known[key] for key in ("problem", "silhouette_iou", "seconds", "up")}
    return Hull(mesh=None if known["problem"] else mesh, **found)


def _carve(subject: Subject, config: ReconstructConfig, path: Path) -> dict[str, Any]:
    device = resolve_device(config.device, config.engine)
    views, truth = make_subject(load_source(subject.source, config)[0], config, lambda done, total: None, device)
    # Meshes are photographed with +y up.
    up = up_of(views) if truth is None else None
    found: dict[str, Any] = {"problem": None, "silhouette_iou": None, "up": None if up is None else up.tolist()}
    started = time.perf_counter()
    try:
        vertices, faces = plain_hull(views, config)[:2]
    except InputError as error:
        return {**found, "problem": str(error), "seconds": time.perf_counter() - started}
    found["seconds"] = time.perf_counter() - started
    hull = TriangleMesh.from_mesh(
        vertices.to(device), faces.to(device), colors=config.start.color, opacity=None, sigma=None
    )
    hull.save(path, views.normalization)
    return {**found, "silhouette_iou": _outline(hull, views, config)}


def _outline(hull: TriangleMesh, views: Dataset, config: ReconstructConfig) -> float | None:
    scorer = Scorer(views, hull.vertices.device, supersampling=config.pictures.supersampling)
    return scorer.opaque(hull, views.test)["silhouette_iou"]
