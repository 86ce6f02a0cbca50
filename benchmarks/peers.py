"""Forward and backward of other differentiable renderers with a CPU path, in turn with ours, on the same mesh.

python -m benchmarks.peers --peers mitsuba                    sphere6 at 1024 x 1024, one thread
python -m benchmarks.peers --peers pytorch3d --level 4 --size 256 --threads 2 --turns 3

Each peer is told its fastest setting that still draws the mesh: Mitsuba one sample of a pixel and one of an outline,
emission alone; PyTorch3D the nearest of the faces that lie within a pixel ("pytorch3d"), or the nearest eight
("pytorch3d-8"). Vertices are new in each step, so that what a peer builds for a mesh is part of it. Pictures are
compared with ours first. research/results.md says how the peers were installed.
"""

import argparse
import math
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

import etsplat
from benchmarks import machine, scenes

FOCAL, DISTANCE = 1.3, 3.0
"""Of the camera of benchmarks.scenes: focal length in image sides, distance to the middle of the mesh."""
ALIKE = 0.02
"""How far pictures may be apart, mean of all values; turned over they are 0.05 apart."""

Step = Callable[[Tensor], Tensor]
"""Vertices that want a gradient, which they get -> the picture, (size, size, 3)."""


@dataclass(frozen=True)
class Subject:
    """A mesh of one colour before black, and the gradient that reaches its picture."""

    vertices: Tensor
    faces: Tensor
    color: Tensor
    cotangent: Tensor

    @property
    def size(self) -> int:
        """Pixels along each side."""
        return len(self.cotangent)


def subject(level: int, size: int) -> Subject:
    """The mesh of benchmarks.scenes."""
    vertices, faces, colors, _, _ = scenes.displaced_sphere(level)
    generator = torch.Generator().manual_seed(1)
    return Subject(vertices, faces, colors[0], torch.rand(size, size, 3, generator=generator) - 0.5)


def ours(given: Subject, threads: int) -> Step:
    etsplat.set_num_threads(threads)
    torch.set_num_threads(threads)
    size, count = given.size, len(given.faces)
    viewmats, colors = torch.eye(4)[None].clone(), given.color.repeat(count, 1).requires_grad_()
    viewmats[0, 2, 3] = DISTANCE
    Ks = torch.tensor([[[FOCAL * size, 0, size / 2], [0, FOCAL * size, size / 2], [0, 0, 1]]])

    def step(vertices: Tensor) -> Tensor:
        out = etsplat.rasterize(
            vertices,
            opacities=torch.full((count,), 0.95),
            sigma=torch.tensor(0.5),
            face_colors=colors,
            viewmats=viewmats,
            Ks=Ks,
            width=size,
            height=size,
            faces=given.faces,
        )
        out.color[0].backward(given.cotangent)
        return out.color[0].detach()

    return step


def mitsuba(given: Subject, threads: int) -> Step:
    """Projective sampling. Positions go in and their gradients come out as arrays, as in a loop of PyTorch."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    import drjit as dr

    dr.set_thread_count(threads)
    mesh = mi.Mesh("mesh", len(given.vertices), len(given.faces))
    written = mi.traverse(mesh)
    written["faces"] = given.faces.flatten().numpy().astype("uint32")
    written["vertex_positions"] = given.vertices.flatten().numpy()
    written.update()
    size, side = given.size, [0, 0, -DISTANCE]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "mesh.ply"
        mesh.write_ply(str(file))
        glow = {"type": "area", "radiance": {"type": "rgb", "value": given.color.tolist()}}
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "prb_projective", "max_depth": 1, "sppi": 0},
                "sensor": {
                    "type": "perspective",
                    "fov": math.degrees(2 * math.atan(0.5 / FOCAL)),
                    "to_world": mi.ScalarTransform4f().look_at(origin=side, target=[0, 0, 0], up=[0, -1, 0]),
                    "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
                    "sampler": {"type": "independent", "sample_count": 1},
                },
                "mesh": {"type": "ply", "filename": str(file), "face_normals": True, "emitter": glow},
            }
        )
    parameters = mi.traverse(scene)
    cotangent, seed = mi.TensorXf(given.cotangent.numpy()), 0

    def step(vertices: Tensor) -> Tensor:
        nonlocal seed
        seed += 1
        moved = mi.Float(vertices.detach().flatten().numpy())
        dr.enable_grad(moved)
        parameters["mesh.vertex_positions"] = moved
        parameters.update()
        picture = mi.render(scene, parameters, spp=1, seed=seed)
        dr.backward(dr.sum(picture * cotangent, axis=None))
        vertices.grad = torch.from_numpy(dr.grad(moved).numpy().reshape(-1, 3))
        return torch.from_numpy(picture.numpy())

    return step


def pytorch3d(given: Subject, threads: int, faces: int) -> Step:
    """The nearest faces of each pixel, with outlines that are soft over a pixel. Bins are for GPUs: each meets each."""
    from pytorch3d.renderer import BlendParams, MeshRasterizer, PerspectiveCameras, RasterizationSettings
    from pytorch3d.renderer.blending import softmax_rgb_blend
    from pytorch3d.structures import Meshes

    torch.set_num_threads(threads)
    radius = (2 / given.size) ** 2  # of a pixel, squared
    turned = torch.diag(torch.tensor([-1.0, -1, 1]))[None]  # x to the left, y up
    camera = PerspectiveCameras(focal_length=2 * FOCAL, R=turned, T=torch.tensor([[0, 0, DISTANCE]]))
    rasterizer = MeshRasterizer(camera, RasterizationSettings(given.size, radius, faces))
    # At the radius a triangle's share of a pixel is 1e-4, as in PyTorch3D's tutorials.
    blend = BlendParams(sigma=radius / math.log(1e4 - 1), background_color=(0.0, 0, 0))
    colors = given.color.repeat(len(given.faces), 1).requires_grad_()

    def step(vertices: Tensor) -> Tensor:
        fragments = rasterizer(Meshes([vertices], [given.faces]))
        texels = colors[fragments.pix_to_face.clamp(min=0)]
        picture = softmax_rgb_blend(texels, fragments, blend)[0, ..., :3]
        picture.backward(given.cotangent)
        return picture.detach()

    return step


PEERS: dict[str, Callable[[Subject, int], Step]] = {
    "mitsuba": mitsuba,
    "pytorch3d": partial(pytorch3d, faces=1),
    "pytorch3d-8": partial(pytorch3d, faces=8),
}


def timed(step: Step, given: Subject) -> tuple[float, float, Tensor]:
    """Seconds by the clock and of the processor, all threads, and the picture; of new vertices.

    Raises:
        RuntimeError: the vertices got no gradient.
    """
    vertices = given.vertices.clone().requires_grad_()
    clock, processor = time.perf_counter(), time.process_time()
    picture = step(vertices)
    seconds = time.perf_counter() - clock, time.process_time() - processor
    if vertices.grad is None or not vertices.grad.any():
        raise RuntimeError("the vertices got no gradient")
    return *seconds, picture


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", nargs="*", choices=PEERS, default=list(PEERS))
    parser.add_argument("--level", type=int, default=6, help="of the sphere: 20 * 4^level faces")
    parser.add_argument("--size", type=int, default=1024, help="pixels along each side")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--turns", type=int, default=5, help="steps of each, one after the other")
    parser.add_argument("--warm", type=int, default=2, help="turns before, which are not counted")
    options = parser.parse_args(arguments)
    given = subject(options.level, options.size)
    steps = {
        name: make(given, options.threads)
        for name, make in ({"etsplat": ours} | PEERS).items()
        if name in ("etsplat", *options.peers)
    }
    turns = [{name: timed(step, given) for name, step in steps.items()} for _ in range(options.warm + options.turns)]
    found = machine.description()
    print(f"{found['cpu']}, {found['cores']} cores, load {found['load_average']}, commit {found['commit']}")
    print("| renderer | triangles | pixels | threads | processor ms | of ours | ms | from our picture |")
    print("|---|---|---|---|---|---|---|---|")
    for name in steps:
        counted = turns[options.warm :]
        clock, processor = (statistics.median(turn[name][kind] for turn in counted) for kind in (0, 1))
        ratio = statistics.median(turn[name][1] / turn["etsplat"][1] for turn in counted)
        apart = float((turns[0][name][2] - turns[0]["etsplat"][2]).abs().mean())
        if apart > ALIKE:
            raise SystemExit(f"{name} drew another picture: {apart:.3f} apart")
        cells = (
            f"{len(given.faces):,}",
            f"{options.size} x {options.size}",
            options.threads,
            f"{1000 * processor:,.0f}",
            f"{ratio:,.1f}",
        )
        print(f"| {' | '.join(map(str, (name, *cells, f'{1000 * clock:,.0f}', f'{apart:.4f}')))} |")


if __name__ == "__main__":
    main()
