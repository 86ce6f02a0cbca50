"""Meshes in light that colours of their surfaces cannot explain, and what harmonics do for their shape.

    python -m benchmarks.lights FOLDER --out RUNS [--objects NAMES] [--kinds NAMES] [--harmonics auto 0 2] [--rate R]

Photographs each mesh of a folder as preset quick photographs a mesh, painted with waves, and reconstructs it with
preset quick. Of each run it is printed: how far colours follow the direction (`directional_deviation` of the start),
exact Chamfer distance x 1e-3 of 20,000 samples, mean angle between the normals of nearest points in degrees, silhouette
IoU, PSNR of the mesh and CPU seconds. Harmonics are learned at the rate R, or at the preset's. Kinds:

    fixed    two soft lights that stay where they are, no gloss: colours are of the surface
    flash    the light is at the camera
    turning  the object turns before a camera that stays, in a light from the left and above
    satin    fixed, and broad highlights (Blinn-Phong, exponent 12) of three lights
    gloss    fixed, and narrow ones (exponent 60)
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import normalize

import etsplat
from benchmarks.starts import distance
from benchmarks.vessels import waves
from etsplat.core.cameras import camera_centers
from etsplat.data.dataset import Dataset, Normalization
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.distance import closest_points
from etsplat.geometry.measures import vertex_normals
from etsplat.io.mesh_files import MeshFile
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import load_source, make_subject
from etsplat.tasks.starts import make_start
from studies.objects.subjects import find_subjects

LIGHTS = normalize(torch.tensor([[0.5, 0.8, 0.4], [-0.7, 0.5, -0.5], [0.1, 0.6, -0.9]]), dim=1)
"""Where lights are that stay; the first two are soft ones too."""

GLOSS = {"satin": (0.35, 12), "gloss": (0.6, 60)}
"""How bright highlights are, and how narrow."""

KINDS = ("fixed", "flash", "turning", *GLOSS)


def lit(kind: str, base: Tensor, vertices: Tensor, normals: Tensor, viewmat: Tensor) -> Tensor:
    """Colours of vertices as a camera sees them."""
    towards = normalize(camera_centers(viewmat[None])[0] - vertices, dim=1)
    if kind in ("flash", "turning"):
        right, down = viewmat[0, :3], viewmat[1, :3]
        light = towards if kind == "flash" else normalize(towards - 1.0 * right - 0.7 * down, dim=1)
        return base * (0.25 + 0.85 * (light * normals).sum(dim=1, keepdim=True).clamp_min(0))
    soft = (0.5 + 0.5 * normals @ LIGHTS[:2].T) @ torch.tensor([[0.6], [0.3]])
    colors = base * (0.2 + soft)
    if kind in GLOSS:
        strength, exponent = GLOSS[kind]
        half = normalize(towards[:, None] + LIGHTS, dim=2)
        colors = colors + strength * (half * normals[:, None]).sum(dim=2).clamp_min(0).pow(exponent).sum(1)[:, None]
    return colors.clamp(0, 1)


def relit(views: Dataset, mesh: MeshFile, kind: str) -> Dataset:
    """The views of a mesh in another light."""
    vertices, faces = mesh.vertices, mesh.faces
    normals, images = vertex_normals(vertices, faces), []
    base = torch.from_numpy((0.45 + waves(vertices.numpy(), 0, (0.06, 0.045, 0.035, 0.03))).clip(0.05, 0.8)).float()
    for index in range(len(views.names)):
        colors = lit(kind, base, vertices, normals, views.viewmats[index].float())
        drawn = etsplat.render_opaque(
            vertices, vertex_colors=colors, cameras=views.cameras[index], faces=faces, supersampling=4
        )
        images.append(drawn.rgba[0])
    return replace(views, images=StoredPictures(images))


def angle(found: MeshFile, truth: MeshFile) -> float:
    """Mean angle between the normals of a mesh's faces and those of the true surface where that is nearest, degrees."""
    corners = found.vertices[found.faces].double()
    crosses = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, faces = closest_points(corners.mean(dim=1), truth.vertices, truth.faces)
    true = truth.vertices[truth.faces[faces]].double()
    there = normalize(torch.linalg.cross(true[:, 1] - true[:, 0], true[:, 2] - true[:, 0]), dim=1)
    angles = (normalize(crosses, dim=1) * there).sum(dim=1).clamp(-1, 1).acos()
    weights = crosses.norm(dim=1)
    return float((angles * weights).sum() / weights.sum() * 180 / torch.pi)


def run(mesh: MeshFile, views: Dataset, harmonics: str, rate: float | None, out: Path) -> tuple[str, ...]:
    """A row of the table."""
    config = ReconstructConfig.quick()
    if harmonics != "auto":
        config = config.changed({"drawing.harmonics": int(harmonics)})
    if rate is not None and harmonics != "0":
        config = config.changed({"optimizer.lr_harmonics": rate})
    begun = time.process_time()
    result = etsplat.reconstruct(views, out, config, overwrite=True)
    seconds, scores = time.process_time() - begun, result.metrics
    exact = distance((result.mesh.vertices, result.mesh.faces), mesh.vertices, mesh.faces)
    return (
        f"{1e3 * exact:.3f}",
        f"{angle(result.mesh, mesh):.1f}",
        f"{scores['silhouette_iou']:.4f}",
        f"{scores['psnr_mesh']:.2f}",
        f"{seconds:.0f}",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inputs", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--objects", nargs="*", default=())
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--harmonics", nargs="*", default=["auto", "0", "2"], choices=["auto", "0", "1", "2", "3"])
    parser.add_argument("--rate", type=float)
    options = parser.parse_args()
    titles = ("object", "light", "deviation", "harmonics", "Chamfer", "angle", "IoU", "PSNR of the mesh", "CPU s")
    print(f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}", flush=True)
    config = ReconstructConfig.quick()
    for subject in find_subjects(options.inputs, options.objects):
        views, mesh = make_subject(load_source(subject.source, config)[0], config, lambda *_: None, torch.device("cpu"))
        assert mesh is not None
        for kind in options.kinds:
            scene = replace(relit(views, mesh, kind), normalization=Normalization())
            deviation = f"{make_start(None, scene, config).deviation or 0:.4f}"
            for harmonics in options.harmonics:
                row = run(mesh, scene, harmonics, options.rate, options.out / f"{subject.name}_{kind}_{harmonics}")
                print(f"| {' | '.join((subject.name, kind, deviation, harmonics, *row))} |", flush=True)


if __name__ == "__main__":
    main()
