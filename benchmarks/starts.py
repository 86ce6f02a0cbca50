"""From the visual hull to what runs start from: without false handles, with its hollows open, with plain sides flat.

    python -m benchmarks.starts FOLDERS [--objects NAMES] [--starts]

Inputs are those of `python -m studies.gallery`, with a known surface. Of each of the five its holes, and the exact
Chamfer distance x 1e-3 of 20,000 samples; photos, faces and frame are those of preset quick. With CPU seconds; of the
hull also what it leaves uncovered of the silhouettes, and the parts and holes of a finer one if it has others. Lids
that photos look through go before hollows are opened, and a hull that they still contradict, or that is hollow between
walls, is cut: neither is done in these. The fifth, `start`, is what a run starts from, with all that; --starts prints
it alone.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.false_handles import without_false_handles
from etsplat.data.hollows import open_hollows
from etsplat.data.plain_sides import with_flat_sides
from etsplat.geometry.parts import genera
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.metrics.geometry import chamfer_exact, exact_squared_distances, sample_pair
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import load_source, make_subject
from etsplat.tasks.starting_hull import Hull, finer_shape, plain_hull
from etsplat.tasks.starts import make_start
from studies.objects.subjects import Subject, find_subjects

SAMPLES = 20_000


def rows(subject: Subject, only_start: bool) -> list[str]:
    """One of the table for each of the five."""
    if subject.surface is None:
        raise SystemExit(f"{subject.name}: its surface is not known")
    config = ReconstructConfig.quick()
    views, _ = make_subject(load_source(subject.source, config)[0], config, lambda *_: None, torch.device("cpu"))
    truth = load_mesh(subject.surface)
    found, begun = [], time.process_time()
    for name, surface, covers in [] if only_start else _stages(views, config):
        found.append(_row(subject, name, surface, truth, views, covers, time.process_time() - begun))
        begun = time.process_time()
    surface = make_start(None, views, config).mesh.surface()
    return [*found, _row(subject, "start", surface, truth, views, "", time.process_time() - begun)]


def _stages(views: Dataset, config: ReconstructConfig) -> Iterator[tuple[str, tuple[Tensor, Tensor], str]]:
    """The four, each with its name, and what the first leaves uncovered."""
    hull = plain_hull(views, config)
    surface = hull.vertices, hull.faces
    yield "hull", surface, _uncovered(hull, views, config)
    surface = without_false_handles(views, *surface)
    yield "without false handles", surface, ""
    surface = open_hollows(views, *surface)[:2]
    yield "opened", surface, ""
    yield "flat", (with_flat_sides(views, *surface), surface[1]), ""


def _row(
    subject: Subject,
    name: str,
    surface: tuple[Tensor, Tensor],
    truth: MeshFile,
    views: Dataset,
    covers: str,
    seconds: float,
) -> str:
    score = distance(surface, views.normalization.apply(truth.vertices), truth.faces)
    holes = ", ".join(str(count) for count in genera(surface[1], len(surface[0])))
    row = (subject.name, name, f"{len(surface[1]):,}", holes, covers, f"{1e3 * score:.3f}", f"{seconds:.1f}")
    return f"| {' | '.join(row)} |"


def _uncovered(hull: Hull, views: Dataset, config: ReconstructConfig) -> str:
    finer = finer_shape(hull, views, config.start.radius)
    return f"{100 * hull.uncovered:.3f}" + (f"; finer: {finer.parts}, {finer.holes}" if finer else "")


def distance(surface: tuple[Tensor, Tensor], vertices: Tensor, faces: Tensor) -> float:
    """From a surface to the true one and back."""
    return chamfer_exact(*exact_squared_distances(*sample_pair(*surface, vertices, faces, SAMPLES)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inputs", nargs="+", type=Path)
    parser.add_argument("--objects", nargs="*", default=())
    parser.add_argument("--starts", action="store_true")
    options = parser.parse_args()
    titles = ("object", "start", "faces", "holes of each part", "uncovered, %", "Chamfer", "CPU s")
    print(f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}", flush=True)
    with torch.no_grad():
        for subject in find_subjects(options.inputs, options.objects):
            print("\n".join(rows(subject, options.starts)), flush=True)


if __name__ == "__main__":
    main()
