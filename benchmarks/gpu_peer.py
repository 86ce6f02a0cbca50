"""The rasterizer of Triangle Splatting beside ours on a GPU: the same triangles, cameras and gradient of the picture.

python -m benchmarks.gpu_peer [--scene sphere6] [--json FILE]

needs its package `diff_triangle_rasterization` (github.com/trianglesplatting/diff-triangle-rasterization), built for
the torch that is used. It draws depth, normals and distortion at each call, so ours is measured without and with them.
It leaves out triangles whose inscribed circle has a radius of less than a pixel, among others: here so do we.
"""

import argparse
import importlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from benchmarks import gpu_scenes
from benchmarks.gpu_scenes import GpuScene
from benchmarks.gpu_timing import captured, event_times, kernel_times, step
from benchmarks.tables import Table

REPEATS = 30
NEAR, FAR = 0.01, 100.0
# Its function of the distance to the edges, and its derivative.
THEIRS = {"kernel": "single_sided", "distance": "sdf", "freeze_inradius": True}
MAPS = {**THEIRS, "outputs": ("depth", "median_depth", "normal", "distortion", "statistics"), "depth_of": "centroid"}


def separate(name: str, device: str) -> GpuScene:
    """A scene of `benchmarks.gpu_scenes`, each of its triangles with corners and a softness of its own."""
    scene = gpu_scenes.load(name, device)
    assert scene.vertex_colors is None
    corners = scene.vertices if scene.faces is None else scene.vertices[scene.faces.long()]
    own = {"vertices": corners, "opacities": scene.opacities, "sigma": scene.sigma.expand(len(corners))}
    leaves = {key: tensor.detach().contiguous().clone().requires_grad_() for key, tensor in own.items()}
    return replace(scene, faces=None, options=THEIRS, **leaves)


def matrices(viewmat: Tensor, K: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, float, float]:
    """World to view and world to clip space as it wants them, for rows; tangents of half the fields of view."""
    fx, fy = float(K[0, 0]), float(K[1, 1])
    assert K[:2, 2].tolist() == [width / 2, height / 2], "it has the principal point in the middle"
    tan_x, tan_y = width / (2 * fx), height / (2 * fy)
    clip = torch.zeros(4, 4, dtype=torch.float64)
    clip[0, 0], clip[1, 1], clip[3, 2] = 1 / tan_x, 1 / tan_y, 1.0
    clip[2, 2:] = torch.tensor([FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)])
    view = viewmat.double().cpu().T
    both = (matrix.float().contiguous().to(viewmat.device) for matrix in (view, view @ clip.T))
    return *both, tan_x, tan_y


class Peer:
    """It on the same scene, with leaves of its own shapes; arrays that its user makes at each step are made once."""

    def __init__(self, scene: GpuScene) -> None:
        package = importlib.import_module("diff_triangle_rasterization")
        count, device = len(scene.vertices), scene.vertices.device
        height, width = scene.cotangent.shape[1:3]
        view, full, tan_x, tan_y = matrices(scene.viewmats[0], scene.Ks[0], width, height)
        settings = package.TriangleRasterizationSettings(
            image_height=height,
            image_width=width,
            tanfovx=tan_x,
            tanfovy=tan_y,
            bg=torch.zeros(3, device=device),
            scale_modifier=1.0,
            viewmatrix=view,
            projmatrix=full,
            sh_degree=0 if scene.sh is None else 3,
            campos=(-scene.viewmats[0, :3, :3].T @ scene.viewmats[0, :3, 3]).contiguous(),
            prefiltered=False,
            debug=False,
        )
        self._rasterizer = package.TriangleRasterizer(settings)
        self._given = {
            "triangles_points": scene.vertices.detach().flatten().requires_grad_(),
            "sigma": scene.sigma.detach().view(-1, 1).requires_grad_(),
            "opacities": scene.opacities.detach().view(-1, 1).requires_grad_(),
            "colors_precomp": None if scene.colors is None else scene.colors.detach().requires_grad_(),
            "shs": None if scene.sh is None else torch.cat([t.detach() for t in scene.sh], 1).requires_grad_(),
            "num_points_per_triangle": torch.full((count,), 3, dtype=torch.int32, device=device),
            "cumsum_of_points_per_triangle": torch.arange(0, 3 * count, 3, dtype=torch.int32, device=device),
            "number_of_points": count,
            "means2D": torch.zeros(count, 3, device=device),
            "scaling": torch.zeros(count, device=device),
            "density_factor": torch.zeros(count, device=device),
        }
        self._cotangent = scene.cotangent[0].permute(2, 0, 1).contiguous()

    def picture(self) -> tuple[Tensor, Tensor]:
        """(H, W, 3), and (N,) which triangles it draws: those that have a radius."""
        with torch.no_grad():
            out = self._rasterizer(**self._given)
            return out[0].permute(1, 2, 0).clone(), next(t for t in out if t.dtype == torch.int32) > 0

    def step(self) -> None:
        """Forward and backward."""
        for value in self._given.values():
            if isinstance(value, Tensor):
                value.grad = None
        self._rasterizer(**self._given)[0].backward(self._cotangent)


def measure(run: Callable[[], Any]) -> dict[str, float]:
    """Milliseconds of a call between two events and of its kernels, and MiB that it takes."""
    calls = event_times(run, REPEATS)["median"]
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    run()
    torch.cuda.synchronize()
    memory = (torch.cuda.max_memory_allocated() - before) / 2**20
    return {"calls": calls, "kernels": sum(kernel_times(run, 10).values()), "MiB": memory}


def compare(name: str) -> dict[str, Any]:
    """Everything about one scene, as plain data."""
    scene = separate(name, "cuda")
    peer = Peer(scene)
    theirs, drawn = peer.picture()
    results: dict[str, Any] = {"peer": measure(peer.step)}
    with torch.no_grad():
        scene.opacities *= drawn
    for what, options in (("ours, with maps", MAPS), ("ours, colours", THEIRS)):
        scene.options = options
        results[what] = measure(lambda: step(scene))
    results["ours, colours"]["graph"] = event_times(captured(scene).replay, REPEATS)["median"]
    apart = (scene.render().color[0].detach() - theirs).abs()
    inner = torch.ones_like(apart[..., 0], dtype=torch.bool)
    inner[::16], inner[:, ::16] = False, False
    differences = {"in the mean": float(apart.mean()), "within tiles": float(apart[inner].mean())}
    return {"triangles": len(drawn), "drawn": int(drawn.sum()), "pictures differ": differences, "rows": results}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", choices=gpu_scenes.NAMES, default=list(gpu_scenes.NAMES))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if not torch.cuda.is_available():
        raise SystemExit("no GPU")
    found, rows = {name: compare(name) for name in options.scene}, []
    columns = ("kernels", "calls", "graph", "MiB")
    for name, entry in found.items():
        for what, numbers in entry["rows"].items():
            rows.append([name, what, *(f"{numbers[key]:.3g}" if key in numbers else "" for key in columns)])
        apart = ", ".join(f"{share:.2g} {where}" for where, share in entry["pictures differ"].items())
        print(f"{name}: it draws {entry['drawn']:,} of {entry['triangles']:,}; pictures differ by {apart}")
    title = f"Forward and backward, {torch.cuda.get_device_name()}: milliseconds, MiB"
    Console(width=120).print(Table(title, ["scene", "", *columns], rows).rich())
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
