"""Depth maps and dense clouds, right and wrong ones, in runs of objects whose surface is known.

python -m benchmarks.depth_maps data/objects/mug ... --work runs/depths --iterations 500

Maps are drawn from the true surface by the z-buffer and written beside links to the photos, or a cloud of points of it;
then the command line is run as a user would, and test views are compared with the true depth.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from etsplat.data.dataset import Dataset
from etsplat.data.load import load_dataset
from etsplat.geometry.sampling import sample_surface
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.io.ply_tables import encode_ply
from etsplat.metrics.geometry import geometry_metrics
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.tasks.opened_runs import open_run

COMMAND = "import sys; from etsplat.cli import main; sys.exit(main())"
SAMPLES, CLOUD = 50_000, "cloud.ply"
COMMON = {
    "train": "--scene-type object --width {width} --iterations {iterations} --max-triangles 10000 --start.points 5000"
    " --no-asset --exposure off --background random",
    "reconstruct": "--preset quick --resolution {width} --iterations {iterations} --max-faces 8000 --exposure off",
}


def _noise(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """1 % Gaussian noise, and 5 % of pixels anywhere between half the nearest and 1.5 times the farthest."""
    known = depth[depth > 0]
    wild = rng.uniform(0.5 * known.min(), 1.5 * known.max(), depth.shape)
    return np.where(rng.random(depth.shape) < 0.05, wild, depth * (1 + 0.01 * rng.normal(size=depth.shape)))


def _garbage(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A smooth random surface of the right range, another in every photo."""
    known, field = depth[depth > 0], gaussian_filter(rng.normal(size=depth.shape), 20)
    unit = (field - field.min()) / (field.max() - field.min())
    return known.min() + (known.max() - known.min()) * unit


KINDS: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "exact": lambda depth, rng: depth,
    "noise": _noise,
    "scale": lambda depth, rng: 0.5 * depth,
    "disparity": lambda depth, rng: 0.3 + 2 / np.maximum(depth, 1e-9),
    "garbage": _garbage,
}


def _noisy_points(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """1 % of the radius Gaussian noise, and one point in five anywhere in the cube around."""
    radius = np.abs(points).max()
    wild = rng.uniform(-1.2 * radius, 1.2 * radius, points.shape)
    return np.where(rng.random((len(points), 1)) < 0.2, wild, points + 0.01 * radius * rng.normal(size=points.shape))


CLOUDS: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "cloud": lambda points, rng: points,
    "noisy cloud": _noisy_points,
}


def true_depth(mesh: MeshFile, dataset: Dataset, view: int) -> torch.Tensor:
    """(H, W), 0 where there is nothing."""
    drawn = rasterize_opaque(mesh.vertices, cameras=dataset.cameras[view], faces=mesh.faces).depth
    assert drawn is not None
    return drawn[0, ..., 0]


def write_capture(source: Path, kind: str, folder: Path) -> None:
    """Links to the photos, and depths/ of a kind for those of training, or cloud.ply; neither for kind "off"."""
    folder.mkdir(parents=True)
    for path in source.iterdir():
        if path.suffix != ".obj":
            (folder / path.name).symlink_to(path.resolve())
    if kind == "off":
        return
    mesh, rng = load_mesh(source / "mesh.obj"), np.random.default_rng(0)
    if kind in CLOUDS:
        points = CLOUDS[kind](sample_surface(mesh.vertices, mesh.faces, SAMPLES, seed=0)[0].numpy(), rng)
        table = np.ascontiguousarray(points).view([(axis, np.float64) for axis in "xyz"])[:, 0]
        (folder / CLOUD).write_bytes(encode_ply({"vertex": table}))
        return
    dataset = load_dataset(source, preload=False)
    frames = json.loads((source / "transforms_train.json").read_text())["frames"]
    for view, frame in zip(dataset.train, frames, strict=True):
        depth = true_depth(mesh, dataset, view).double().numpy()
        path = folder / "depths" / f"{frame['file_path'].removeprefix('./')}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.where(depth > 0, KINDS[kind](depth, rng), 0).astype(np.float32))


def depth_error(run: Path, source: Path, width: int) -> float:
    """Per cent: the mean over test views of the median depth's relative distance from the truth, where both are."""
    dataset, mesh, soup = load_dataset(source, width=width), load_mesh(source / "mesh.obj"), open_run(run).soup
    errors = []
    for view in dataset.test:
        truth = true_depth(mesh, dataset, view)
        with torch.no_grad():
            drawn = soup.render(dataset.cameras[view], outputs=("color", "median_depth")).median_depth
        assert drawn is not None
        both = (truth > 0) & (drawn[0, ..., 0] > 0)
        errors.append(float(((drawn[0, ..., 0] - truth).abs() / truth)[both].mean()))
    return 100 * sum(errors) / len(errors)


def chamfer(run: Path, source: Path) -> float:
    """Squared, two-sided, in 1e-3 of the true surface's bounding sphere of radius 1."""
    true, found = load_mesh(source / "mesh.obj"), load_mesh(run / "mesh.ply")
    return 1e3 * geometry_metrics(found.vertices, found.faces, true.vertices, true.faces, samples=SAMPLES).chamfer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", nargs="+", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--task", choices=list(COMMON), default="train")
    parser.add_argument("--kinds", nargs="+", choices=["off", *KINDS, *CLOUDS], default=["off", *KINDS])
    parser.add_argument("--width", type=int, default=200)
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--more", default="", help="more options of the command")
    chosen = parser.parse_args()
    print("| object | maps | used | PSNR | " + ("depth, % off |" if chosen.task == "train" else "CD x 1e-3 |"))
    for source in chosen.objects:
        for kind in chosen.kinds:
            capture = chosen.work / "captures" / source.name / kind
            if not capture.is_dir():
                write_capture(source, kind, capture)
            out = chosen.work / chosen.task / source.name / kind
            options = COMMON[chosen.task].format(width=chosen.width, iterations=chosen.iterations)
            cloud = ["--init-points", capture / CLOUD] if kind in CLOUDS else []
            words = [chosen.task, capture, "--out", out, "--overwrite", *options.split(), *cloud, *chosen.more.split()]
            subprocess.run([sys.executable, "-c", COMMAND, *map(str, words)], check=True, stdout=subprocess.DEVNULL)
            metrics = json.loads((out / "metrics.json").read_text())
            error = depth_error(out, source, chosen.width) if chosen.task == "train" else chamfer(out, source)
            used = f"{metrics.get('depth_used')}, {metrics.get('depth_photos')}" if kind in KINDS else ""
            print(f"| {source.name} | {kind} | {used} | {metrics['psnr']:.2f} | {error:.3f} |", flush=True)


if __name__ == "__main__":
    main()
