"""What refining cameras does to runs whose poses are right, or wrong on purpose: a table for research/results.md.

python -m benchmarks.poor_poses data/scenes/fox --work runs/poses
python -m benchmarks.poor_poses data/objects/mug --task reconstruct --triangles 3000 --work runs/poses

Every camera, those of test photos too, is turned by 0.5 degrees about a random axis and shifted by 1 % of its distance
in a random direction. Poses are compared with the right ones after the similarity that fits the centres best; test
photos are scored from where they were given, and after their poses were aligned to the result.
"""

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

import etsplat
from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.io.tensors import read_tensors
from etsplat.metrics.image import psnr
from etsplat.optim.camera_motion import distance_shown, moved
from etsplat.tasks.refined_cameras import alignment_starts, refined_capture
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.sources import load_source, open_run

DEGREES, OF_DISTANCE = 0.5, 0.01


def spoiled(capture: Dataset, points: Float[Tensor, "N 3"], degrees: float, part: float, seed: int = 0) -> Dataset:
    """Every camera turned by so many degrees, and shifted by a part of the distance of what it shows."""
    generator = torch.Generator().manual_seed(seed)
    viewmats = capture.viewmats.clone()
    for view, camera in enumerate(capture.cameras):
        turn, shift = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=1)
        motion = torch.cat([math.radians(degrees) * turn, part * distance_shown(points, camera) * shift])
        exact = Cameras(viewmats[view][None], capture.Ks[view][None], camera.width, camera.height)
        viewmats[view] = moved(exact, motion).viewmats[0]
    return replace(capture, viewmats=viewmats)


def pose_errors(found: Dataset, right: Dataset, points: Float[Tensor, "N 3"]) -> tuple[float, float, float]:
    """How far training cameras are from the right ones, after the similarity that fits their centres best.

    Returns:
        Means over them: the angle in degrees, the shift in percent of the distance of what they show, and how far that
        is in their pictures from where it should be, in percent of the longer side.
    """
    views = found.train
    a, b = found.centers[views], right.centers[views]
    mean_a, mean_b = a.mean(dim=0), b.mean(dim=0)
    u, sizes, vt = torch.linalg.svd((b - mean_b).T @ (a - mean_a))
    flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vt).sign())], dtype=a.dtype))
    rotation = u @ flip @ vt
    scale = float((sizes * flip.diagonal()).sum() / (a - mean_a).square().sum())
    centers = scale * (a - mean_a) @ rotation.T + mean_b
    rotations = found.viewmats[views, :3, :3] @ rotation.T
    distances = torch.tensor([distance_shown(points, right.cameras[view]) for view in views])
    chords = (rotations - right.viewmats[views, :3, :3]).flatten(1).norm(dim=1) / 8**0.5
    offsets = []
    for number, view in enumerate(views):
        K, size = right.Ks[view], torch.tensor(right.images.sizes[view])
        seen = points.double() @ right.viewmats[view, :3, :3].T + right.viewmats[view, :3, 3]
        pixels = (seen @ K.T)[:, :2] / seen[:, 2:]
        framed = (seen[:, 2] > 0) & ((pixels >= 0) & (pixels <= size)).all(dim=1)
        there = (points.double()[framed] - centers[number]) @ rotations[number].T @ found.Ks[view].T
        offsets.append((there[:, :2] / there[:, 2:] - pixels[framed]).norm(dim=1).median() / size.max())
    return (
        float(torch.rad2deg(2 * chords.asin()).mean()),
        float(100 * ((centers - b).norm(dim=1) / distances).mean()),
        float(100 * torch.stack(offsets).mean()),
    )


def main() -> None:
    """Makes the runs that are not there yet, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--work", type=Path, default=Path("runs/poses"))
    parser.add_argument("--task", choices=["train", "reconstruct"], default="train")
    parser.add_argument("--width", type=int, default=120)
    parser.add_argument("--iterations", type=int, default=700)
    parser.add_argument("--refine", nargs="+", default=["off", "poses"])
    parser.add_argument("--poses", nargs="+", default=["right", "poor"])
    parser.add_argument("--triangles", type=int, default=4000)
    options = parser.parse_args()
    print("| capture | poses | refined | stayed | degrees | % of distance | % of picture | PSNR | aligned |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for path in options.scenes:
        for poses in options.poses:
            for refine in options.refine:
                print(row(path, poses, refine, options), flush=True)


def row(path: Path, poses: str, refine: str, options: argparse.Namespace) -> str:
    """One run, made if it is not there yet."""
    out = options.work / f"{path.name}_{options.task}_{poses}_{refine}"
    if options.task == "train":
        right = etsplat.load_dataset(path, width=options.width)
        assert right.points is not None
        points = right.points[:: max(1, len(right.points) // 2000)]
    else:
        right, _ = load_source(path, etsplat.ReconstructConfig(resolution=options.width), None)
        assert isinstance(right, Dataset)
        points = torch.randn(2000, 3, generator=torch.Generator().manual_seed(1))
        points = 0.6 * torch.nn.functional.normalize(points, dim=1)
    given = right if poses == "right" else spoiled(right, points, DEGREES, OF_DISTANCE)
    if not (out / "metrics.json").is_file():
        run(given, out, refine, options)
    metrics = json.loads((out / "metrics.json").read_text())
    refined = refined_capture(given, out)
    turn, shift, pixels = pose_errors(refined, right, points)
    aligned = metrics.get("psnr_aligned") or aligned_psnr(out, given, refined, options)
    stayed = {True: "yes", False: "no", None: ""}[metrics.get("cameras_refined")]
    return (
        f"| {path.name} | {poses} | {refine} | {stayed} | {turn:.2f} | {shift:.2f} | {pixels:.2f} | "
        f"{metrics['psnr']:.2f} | "
        f"{aligned:.2f} |"
    )


def run(given: Dataset, out: Path, refine: str, options: argparse.Namespace) -> None:
    """One run."""
    common = {"iterations": options.iterations, "refine_cameras": refine, "exposure": "off", "watch": 16}
    if options.task == "train":
        config = etsplat.TrainConfig.quick().changed(
            {**common, "asset": False, "max_triangles": options.triangles, "loss.depth": "off"}
        )
        etsplat.train(given, out, config, overwrite=True)
    else:
        config = etsplat.ReconstructConfig.quick().changed(
            {**common, "resolution": options.width, "max_faces": options.triangles, "regularization.depth": "off"}
        )
        etsplat.reconstruct(given, out, config, overwrite=True)


def aligned_psnr(out: Path, given: Dataset, refined: Dataset, options: argparse.Namespace) -> float:
    """Of the test photos of a run that did not align them."""
    if options.task == "train":
        opened = open_run(out, device="cpu")
        model, background = opened.soup, opened.soup.appearance.background
    else:
        tensors, _ = read_tensors(max((out / "checkpoints").iterdir()))
        state = {name.removeprefix("model."): tensor for name, tensor in tensors.items() if name.startswith("model.")}
        colored = len(state["colors"]) == len(state["vertices"])
        model = etsplat.TriangleMesh.from_mesh(
            state["vertices"], state["faces"], colors=0.5, opacity=0.9, sigma=0.1, vertex_colored=colored
        )
        model.load_state(state)
        background = (0.0, 0.0, 0.0)
    scorer = Scorer(given, torch.device("cpu"), background=background)
    scorer.see_by(refined, alignment_starts(given, refined))
    seen = [scorer.see(model, view) for view in given.test]
    return sum(psnr(each.counting(each.aligned), each.photo) for each in seen) / len(seen)


if __name__ == "__main__":
    main()
