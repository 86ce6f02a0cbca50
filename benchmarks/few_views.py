"""Objects in captures that show less than all sides: what runs make of what few photos see, or none.

    python -m benchmarks.few_views FOLDERS --out RUNS [--objects NAMES] [--kinds NAMES] [--size PIXELS] [--up z]

Inputs are those of `python -m studies.gallery`, with a known surface. Each is divided finely, painted with soft spots
and photographed under light; it is reconstructed at preset quick. Of each it is printed: the start's exact Chamfer
distance x 1e-3 of 20,000 samples, the result's, its parts and holes and the true ones, the verdict, and CPU seconds.
Kinds:

    few    twenty photos from all sides: four around it at each of five heights
    ring   twenty-four around it, from 25 degrees above
    above  thirty-nine from above: thirteen around it at each of 15, 40 and 65 degrees
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
import trimesh

import etsplat
from benchmarks.starts import distance
from etsplat.data.dataset import Dataset
from etsplat.data.photograph import normalize_mesh
from etsplat.geometry.parts import shape_of
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import load_source, make_subject
from etsplat.tasks.starts import make_start
from studies.objects.subjects import Subject, find_subjects

KINDS: dict[str, dict[str, Any]] = {
    "few": {"azimuths": 4},
    "ring": {"elevations": (25.0,), "azimuths": 24},
    "above": {"elevations": (15.0, 40.0, 65.0), "azimuths": 13},
}

WAVES, FREQUENCY = 6, 9.0
"""Of each colour of the paint: how many are summed, and their numbers in the object's radius, about."""

FINE = 0.03
"""Longest edge of a painted mesh, in units of its radius."""


def painted(mesh: MeshFile, up: str) -> MeshFile:
    """In the unit frame, y up, with colours of its vertices, smooth and nowhere the same."""
    unit = normalize_mesh(mesh)[0].vertices.numpy()
    found = trimesh.remesh.subdivide_to_size(unit[:, [0, 2, 1]] * (1, 1, -1) if up == "z" else unit, mesh.faces, FINE)
    vertices, faces = torch.from_numpy(found[0]).float(), torch.from_numpy(found[1])
    waves = FREQUENCY * torch.randn(3, 3, WAVES, generator=torch.Generator().manual_seed(1))
    phases = torch.einsum("vk,kcw->vcw", vertices, waves)
    colors = 0.5 + 0.4 * (phases + torch.arange(WAVES)).sin().mean(dim=2) * WAVES**0.5
    return MeshFile(vertices, faces, vertex_colors=colors.clamp(0.05, 0.95))


def row(subject: Subject, kind: str, out: Path, size: int, up: str) -> str:
    """Of the table; the run is made if it is not there yet."""
    if subject.surface is None:
        raise SystemExit(f"{subject.name}: its surface is not known")
    mesh, config, begun = painted(load_mesh(subject.surface), up), ReconstructConfig.quick(), time.process_time()
    photos = etsplat.photograph(mesh, size, size, **KINDS[kind])
    views, _ = make_subject(load_source(photos, config)[0], config, lambda *_: None, torch.device("cpu"))
    start = _off(*make_start(None, views, config).mesh.surface(), mesh, views)
    if not (out / "metrics.json").is_file():
        etsplat.reconstruct(photos, out, config, overwrite=True)
    result, judged = load_mesh(out / "mesh.ply"), json.loads((out / "metrics.json").read_text())["judgement"]
    end = _off(views.normalization.apply(result.vertices), result.faces, mesh, views)
    shapes = (shape_of(each.vertices, each.faces.long()) for each in (result, mesh))
    found, true = (f"{shape.parts}, {shape.holes}" for shape in shapes)
    cells = (subject.name, kind, f"{start:.3f}", f"{end:.3f}", found, true, judged["verdict"])
    return f"| {' | '.join(cells)} | {time.process_time() - begun:.0f} |"


def _off(vertices: torch.Tensor, faces: torch.Tensor, truth: MeshFile, views: Dataset) -> float:
    wanted = views.normalization.apply(truth.vertices), truth.faces.long()
    return 1e3 * distance((vertices.detach().cpu(), faces.cpu().long()), *wanted)


def main() -> None:
    """Makes what is not there yet, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inputs", nargs="+", type=Path)
    parser.add_argument("--objects", nargs="*", default=())
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--size", type=int, default=320)
    parser.add_argument("--up", choices=("y", "z"), default="y")
    options = parser.parse_args()
    titles = ("object", "photos", "start", "result", "parts, holes", "true", "verdict", "CPU s")
    print(f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}", flush=True)
    for subject in find_subjects(options.inputs, options.objects):
        for kind in options.kinds:
            print(row(subject, kind, options.out / subject.name / kind, options.size, options.up), flush=True)


if __name__ == "__main__":
    main()
