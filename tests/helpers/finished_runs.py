"""Run directories as finished runs leave them, without any run."""

import math
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import save_mesh
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train_config import TrainConfig

METRICS = {
    "chamfer": 6.4e-5,
    "chamfer_floor": 5.1e-5,
    "chamfer_exact": 9.0e-6,
    "f_score": 0.987,
    "psnr": 38.21,
    "psnr_mesh": 37.5,
    "silhouette_iou": 0.981,
    "ssim": 0.9912,
    "flip": 0.0213,
    "lpips": None,
    "lpips_reason": "no weights: give --lpips-weights FILE",
    "faces": 5120,
    "vertices": 2562,
    "degenerate_faces": 0,
    "self_intersections": 3,
    "judgement": {"verdict": "poor: the result has 1 part and 0 holes, the input mesh <1> part and 4 holes: try this"},
    "iterations": 3000,
    "seconds": 61.7,
    "seconds_per_iteration": 0.0206,
    "engine": "cpu",
    "method": "elastic",
    "preset": "quick",
    "seed": 0,
    "versions": {"etsplat": "0.1.0", "torch": "2.13.0"},
}


CONFIG = {
    "task": "reconstruct",
    "config": replace(ReconstructConfig.quick(), iterations=3000, method="bilateral").to_dict(),
    "source": {"fingerprint": "0123456789abcdef", "init_mesh": None},
    "paths": {"source": "meshes/bunny <&> co.ply", "init_mesh": None},
    "versions": {"etsplat": version("etsplat"), "torch": "2.13.0"},
}


def write_run(folder: Path, views: int = 3, steps: int = 300) -> Path:
    """A finished run of `steps` log lines: a bumpy sphere, and disks for its pictures."""
    run = RunDirectory.create(folder, CONFIG)
    run.write_metrics(METRICS)
    for step in range(1, steps + 1):
        decay = math.exp(-4 * step / steps)
        line = {"iteration": 10 * step, "seconds": 0.2 * step, "loss": 0.01 + 0.2 * decay * (1 + 0.1 * math.sin(step))}
        line |= {"faces": 1280 * 4 ** (3 * step // (steps + 1)), "sigma": 0.05 + decay}
        if step % 20 == 0:
            line |= {"psnr": 38 - 20 * decay, "chamfer": 6e-5 + 0.1 * decay**2}
        run.append_history(line)
    vertices, faces = icosphere(4)
    vertices = vertices * (1 + 0.15 * torch.sin(6 * vertices[:, :1]) * torch.cos(5 * vertices[:, 1:2]))
    colors = 0.5 + 0.5 * vertices[faces].mean(dim=1).clamp(-1, 1)
    save_mesh(run.mesh_path(".ply"), vertices, faces, colors)
    for view in range(views):
        for kind, radius in (("truth", 0.8), ("render", 0.79), ("mesh", 0.78)):
            _disk(radius, view).save(run.test / f"{5 * view + 2:03d}_{kind}.png")
    return folder


def _disk(radius: float, view: int, size: int = 256) -> Image.Image:
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / (size / 2) - 1
    z = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0)) / radius
    light = z * (0.6 + 0.4 * np.cos(3 * x + view))
    return Image.fromarray(np.uint8(255 * np.clip(light[..., None] * [1, 0.95, 0.9], 0, 1)))


def write_soup_run(folder: Path) -> Path:
    """A finished run of `etsplat train`, with grey pictures."""
    config = {
        "task": "train",
        "config": replace(TrainConfig.quick("indoor"), iterations=500).to_dict(),
        "source": {"fingerprint": "0123456789abcdef"},
        "paths": {"source": "scenes/my kitchen", "images": "images_2", "masks": None},
        "versions": {"etsplat": version("etsplat"), "torch": "2.13.0"},
    }
    run = RunDirectory.create(folder, config)
    shared = ("iterations", "seconds", "seconds_per_iteration", "engine", "preset", "seed", "versions")
    run.write_metrics(
        {
            **{key: METRICS[key] for key in shared},
            "psnr": 27.1,
            "ssim": 0.81,
            "flip": 0.104,
            "psnr_opaque": 25.9,
            "psnr_affine": 27.5,
            "triangles": 98765,
            "threads": 4,
            "method": "elastic",
            "sigma": 0.4,
            "sigma_10": 0.1,
            "sigma_90": 0.9,
            "opacity": 0.6,
            "opacity_10": 0.2,
            "opacity_90": 0.99,
        }
    )
    for step in range(1, 30):
        spread = {"sigma": 1 / step, "sigma_10": 0.5 / step, "sigma_90": 2 / step, "triangles": 100 * step}
        run.append_history({"iteration": 10 * step, "seconds": step, "loss": 1 / step, **spread})
    corners = torch.randn(20, 3, 3, generator=torch.Generator().manual_seed(0))
    soup = TriangleSoup.from_triangles(corners, torch.full((20, 3), 0.6), opacity=0.9, sigma=0.3, sh_degree=1)
    soup.save(run.soup_path)
    for kind in ("truth", "render", "opaque"):
        Image.new("RGB", (32, 24), "#808080").save(run.test / f"000_{kind}.png")
    return folder
