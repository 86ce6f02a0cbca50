"""What refining cameras does to runs whose poses are right, or wrong on purpose: a table for research/results.md.

python -m benchmarks.poor_poses data/scenes/fox --work runs/poses
python -m benchmarks.poor_poses data/objects/mug --task reconstruct --triangles 3000 --work runs/poses

Every camera, those of test photos too, is turned by 0.5 degrees about a random axis and shifted by 1 % of its distance
in a random direction. Poses are compared with the right ones after the similarity by which pictures of the surface
agree best; test photos are scored from where they were given, and after their poses were aligned to the result.
"""

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.refined_cameras import alignment_starts, refined_capture
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.sources import load_source

DEGREES, OF_DISTANCE = 0.5, 0.01

WATCH = 16
"""One photo in so many is kept aside."""

POINTS = 600
"""About so many places on the surface are looked at."""


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


@dataclass(frozen=True)
class PoseErrors:
    """How far training cameras are from the right ones: means over them, `framed` and `pixels` medians of points.

    Attributes:
        degrees: by how much each is turned.
        shift: in percent of the distance of what it shows.
        pixels: how far points of the surface are in its picture from where they should be.
        framed: the same before the alignment, with what moves all cameras alike.
    """

    degrees: float
    shift: float
    pixels: float
    framed: float


def pose_errors(found: Dataset, right: Dataset, points: Float[Tensor, "N 3"], views: Sequence[int]) -> PoseErrors:
    """How far cameras are from the right ones, after the similarity by which pictures of points agree best.

    What moves, turns or scales all cameras and the model together no photo shows. Centres alone say little of it where
    cameras stand in an arc or each is shifted as it is turned: pictures do.

    Args:
        found: whose cameras to judge.
        right: the same capture by the right ones.
        points: on the surface, in world space.
        views: whose cameras.
    """
    points = points.double()
    a, b = found.viewmats[views], right.viewmats[views]
    sizes = torch.tensor([right.images.sizes[view] for view in views])
    wanted, depth = _pictured(points, b, right.Ks[views])
    framed = (depth > 0) & ((wanted >= 0) & (wanted <= sizes[:, None])).all(dim=-1)
    middle = points.median(dim=0).values

    def offsets(similarity: Float[Tensor, "7"]) -> Float[Tensor, "M 2"]:
        there = similarity[6].exp() * (points - middle) @ _turn(similarity[:3]).T + middle + similarity[3:6]
        return (_pictured(there, a, found.Ks[views])[0] - wanted)[framed]

    similarity = torch.zeros(7, dtype=torch.float64)
    before = offsets(similarity).norm(dim=-1)
    for _ in range(12):  # Gauss and Newton; what is far off counts by its distance, not by its square
        off, slopes = offsets(similarity), torch.func.jacfwd(offsets)(similarity)
        size = off.norm(dim=-1)
        weighted = slopes / size.clamp_min(max(float(size.median()), 1e-9))[:, None, None]
        slope = torch.einsum("nci,nc->i", weighted, off)
        similarity = similarity - torch.linalg.solve(torch.einsum("nci,ncj->ij", weighted, slopes), slope)
    rotation, scale = _turn(similarity[:3]), similarity[6].exp()
    centers = (found.centers[views] - middle - similarity[3:6]) @ rotation / scale + middle
    distances = torch.tensor([distance_shown(points, right.cameras[view]) for view in views])
    chords = (a[:, :3, :3] @ rotation - b[:, :3, :3]).flatten(1).norm(dim=1) / 8**0.5
    return PoseErrors(
        float(torch.rad2deg(2 * chords.asin()).mean()),
        float(100 * ((centers - right.centers[views]).norm(dim=1) / distances).mean()),
        float(offsets(similarity).norm(dim=-1).median()),
        float(before.median()),
    )


def _pictured(
    points: Float[Tensor, "N 3"], viewmats: Float[Tensor, "P 4 4"], Ks: Float[Tensor, "P 3 3"]
) -> tuple[Float[Tensor, "P N 2"], Float[Tensor, "P N"]]:
    """Pixels and depths."""
    at = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    pixels = at @ Ks.mT
    return pixels[..., :2] / pixels[..., 2:], at[..., 2]


def _turn(turn: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation by a small vector; differentiable."""
    return torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3, dtype=turn.dtype), turn.expand(3, 3), dim=1).mT)


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
    print(
        "| capture | poses | refined | stayed | degrees | % of distance | pixels | pixels, aligned | PSNR | aligned |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
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
        points = right.points[:: max(1, len(right.points) // POINTS)]
    else:
        right, _ = load_source(path, etsplat.ReconstructConfig(resolution=options.width), None)
        assert isinstance(right, Dataset)
        vertices = etsplat.load_mesh(path / "mesh.obj").vertices
        points = vertices[:: max(1, len(vertices) // POINTS)]
    given = right if poses == "right" else spoiled(right, points, DEGREES, OF_DISTANCE)
    if not (out / "metrics.json").is_file():
        run(given, out, refine, options)
    metrics = json.loads((out / "metrics.json").read_text())
    refined = refined_capture(given, out)
    off = pose_errors(refined, right, points, right.watching(WATCH).train)
    aligned = metrics.get("psnr_aligned") or aligned_psnr(out, given, refined, options)
    stayed = {True: "yes", False: "no", None: ""}[metrics.get("cameras_refined")]
    return (
        f"| {path.name} | {poses} | {refine} | {stayed} | {off.degrees:.2f} | {off.shift:.2f} | {off.framed:.2f} | "
        f"{off.pixels:.2f} | {metrics['psnr']:.2f} | {aligned:.2f} |"
    )


def run(given: Dataset, out: Path, refine: str, options: argparse.Namespace) -> None:
    """One run."""
    common = {"iterations": options.iterations, "refine_cameras": refine, "exposure": "off", "watch": WATCH}
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
