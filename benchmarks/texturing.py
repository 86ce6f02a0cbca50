"""Light textured meshes of reconstructed objects beside the full ones: quality, size and time.

    python -m benchmarks.texturing RUNS [--texture 2048] [--faces 10000]
    python -m benchmarks.texturing RUNS --lods 3
    python -m benchmarks.texturing RUNS --stored

Seconds are of the processor, all threads together: the same beside other jobs, and about what one core would take.
Faces that cut through others are counted.

With --lods the coarser levels that `etsplat export RUN --texture N --lods N` has written: PSNR of the test views, at
their size, and halved as often as the level says, where that of the first level stands beside it. With --stored one
light mesh in every way in which GLB stores it: its size, PSNR of the test views, and of the texture in the file.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

from etsplat import Scorer, TexturedMesh, TriangleMesh, texture_mesh
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import as_float
from etsplat.geometry.intersections import count_self_intersections
from etsplat.geometry.topology import MeshTopology
from etsplat.metrics.image import psnr
from etsplat.tasks.export_mesh import open_reconstruction


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--texture", type=int, default=2048)
    parser.add_argument("--faces", type=int, default=10_000)
    parser.add_argument("--lods", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the files")
    parser.add_argument("--stored", action="store_true")
    options = parser.parse_args()
    if options.stored:
        print("run | --compress | --pictures | MB | PSNR | of the texture")
        for run in options.runs:
            measure_stored(run, options.texture, options.faces)
        return
    if options.lods:
        print("run, level | faces | MB | PSNR | halved | of level 0, halved")
        for run in options.runs:
            measure_levels(run, options.lods)
        return
    print("run | full: faces, PSNR, IoU, cutting | textured: faces, PSNR, IoU, cutting, sound | MB | processor seconds")
    for run in options.runs:
        measure(run, options.texture, options.faces, options.keep)


def measure(run: Path, size: int, faces: int, keep: Path | None) -> None:
    opened = open_reconstruction(run)
    views = opened.views
    scorer = Scorer(views, torch.device("cpu"))
    mesh = opened.mesh
    full = TriangleMesh.from_mesh(mesh.vertices, mesh.faces, colors=mesh.face_colors, opacity=None, sigma=None)

    def note(phase: str, *_: int) -> None:
        phases.setdefault(phase, time.process_time())

    phases: dict[str, float] = {}
    before = time.process_time()
    light = texture_mesh(run, size=size, faces=faces, tell=note)
    end = time.process_time()
    starts = [*phases.values(), end]
    seconds = {phase: round(after - start, 1) for (phase, start), after in zip(phases.items(), starts[1:], strict=True)}
    with tempfile.TemporaryDirectory() as folder:
        path = (keep or Path(folder)) / f"{run.name}.glb"
        light.save(path)
        size_mb, read = path.stat().st_size / 1e6, TexturedMesh.load(path)
    topology = MeshTopology.from_faces(light.faces, len(light.vertices))
    sound = topology.is_closed() and topology.is_manifold()
    rows = []
    for model in (full, replace(read, vertices=views.normalization.apply(read.vertices.detach()))):
        found = scorer.opaque(model, views.test)
        cutting = count_self_intersections(*model.surface())
        rows.append(f"{model.count} {found['psnr_mesh']:.2f} {found['silhouette_iou']:.4f} {cutting}")
    print(f"{run.name} | {rows[0]} | {rows[1]} {sound} | {size_mb:.2f} | {end - before:.0f} {seconds}", flush=True)


def measure_stored(run: Path, size: int, faces: int) -> None:
    opened = open_reconstruction(run)
    light = texture_mesh(run, size=size, faces=faces)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "light.glb"
        for pictures in ("png", "webp"):
            for compress in ("none", "quantize", "meshopt"):
                light.save(path, compress=compress, pictures=pictures)
                read = TexturedMesh.load(path)
                shown = replace(read, vertices=opened.views.normalization.apply(read.vertices.detach()))
                found = quality(shown, opened.views, 0)
                texture = psnr(read.texture.detach(), light.texture.detach().clamp(0, 1))
                stored = f"{compress} | {pictures} | {path.stat().st_size / 1e6:.2f}"
                print(f"{run.name} | {stored} | {found:.3f} | {texture:.1f}", flush=True)


@torch.no_grad()
def measure_levels(run: Path, lods: int) -> None:
    views = open_reconstruction(run).views
    first: TexturedMesh | None = None
    for level in range(lods + 1):
        path = run / (f"textured_lod{level}.glb" if level else "textured.glb")
        read = TexturedMesh.load(path)
        mesh = replace(read, vertices=views.normalization.apply(read.vertices.detach()))
        first = first or mesh
        found = quality(mesh, views, 0), quality(mesh, views, level), quality(first, views, level)
        numbers = " | ".join(f"{value:.2f}" for value in found)
        print(f"{run.name}, {level} | {mesh.count:,} | {path.stat().st_size / 1e6:.2f} | {numbers}", flush=True)


def quality(mesh: TexturedMesh, views: Dataset, halvings: int) -> float:
    """Mean PSNR of the test views, so many times halved, over black."""
    found, side = [], 1 << halvings
    for index in views.test:
        photo = as_float(views.images[index])
        small = torch.nn.functional.avg_pool2d((photo[..., :3] * photo[..., 3:]).permute(2, 0, 1), side)
        drawn = mesh.render_opaque(views.cameras[index].scaled(1 / side))[0, ..., :3].clamp(0, 1)
        found.append(psnr(drawn, small.permute(1, 2, 0)))
    return fmean(found)


if __name__ == "__main__":
    main()
