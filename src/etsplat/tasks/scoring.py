"""How good a reconstruction is: on the test views and against the true mesh."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.loader import ViewLoader
from etsplat.data.pictures import as_float
from etsplat.geometry.intersections import count_degenerate_faces, count_self_intersections
from etsplat.io.images import save_image
from etsplat.metrics.geometry import chamfer, geometry_metrics, sample_pair
from etsplat.metrics.image import Lpips, find_lpips_weights, psnr, silhouette_iou, ssim
from etsplat.model.mesh_rendering import render_exported, render_mesh
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import Subject


class Scorer:
    """Measures meshes of one subject. Measuring changes nothing and draws no random number of the run.

    Images are compared over black, in float, renders clamped to [0, 1].
    """

    def __init__(self, subject: Subject, config: ReconstructConfig, device: torch.device | None = None) -> None:
        """Loads what measuring needs.

        Raises:
            InputError: `config.output.lpips_weights` is given and cannot be used.
        """
        self._views, self._loader = subject.views, ViewLoader(subject.views, device or torch.device("cpu"))
        self._has_masks = subject.views.has_masks
        self._truth = subject.truth
        self._config = config
        # Now rather than after the run, so that a file that cannot be used is found before hours are spent.
        weights = find_lpips_weights(config.output.lpips_weights)
        self._lpips = Lpips.from_weights(*weights.paths) if weights.paths else None
        self._lpips_reason = weights.reason
        if self._lpips is not None:
            self._lpips.to(device or torch.device("cpu"))
        if min(min(size) for size in self._views.images.sizes) < 16:
            self._lpips, self._lpips_reason = None, "the images are smaller than 16 pixels"

    def cheap(self, mesh: TriangleMesh) -> dict[str, float]:
        """For the history: "psnr" if there are test views, "chamfer" (an estimate) if there is a true mesh."""
        scores: dict[str, float] = {}
        if self._views.test:
            scores["psnr"] = _mean([psnr(self._splatted(mesh, view), self._photo(view)) for view in self._views.test])
        if self._truth is not None:
            truth, samples = self._truth, self._config.output.chamfer_samples
            pair = sample_pair(mesh.vertices, mesh.faces, truth.vertices, truth.faces, samples)
            scores["chamfer"] = chamfer(*pair, queries=samples // 10)
        return scores

    def full(self, mesh: TriangleMesh, folder: Path) -> dict[str, Any]:
        """For metrics.json; draws the test views into `folder` on the way.

        Args:
            mesh: what to measure.
            folder: gets NNN_render.png, NNN_truth.png and NNN_mesh.png for every test view.

        Returns:
            Every key that there is; null where there are no test views or no true mesh.
        """
        return {
            **self._geometry(mesh),
            **self._images(mesh, folder),
            "faces": len(mesh.faces),
            "vertices": len(mesh.vertices),
        }

    def _geometry(self, mesh: TriangleMesh) -> dict[str, Any]:
        vertices, faces, truth = mesh.vertices.detach().cpu(), mesh.faces.cpu(), self._truth
        if truth is not None:
            samples = self._config.output.chamfer_samples
            return asdict(geometry_metrics(vertices, faces, truth.vertices, truth.faces, samples=samples))
        return {
            **dict.fromkeys(("chamfer", "chamfer_floor", "chamfer_exact", "f_score")),
            "degenerate_faces": count_degenerate_faces(vertices, faces),
            "self_intersections": count_self_intersections(vertices, faces),
        }

    def _images(self, mesh: TriangleMesh, folder: Path) -> dict[str, Any]:
        scores: dict[str, list[float]] = {"psnr": [], "psnr_mesh": [], "ssim": [], "lpips": [], "silhouette_iou": []}
        for number, view in enumerate(self._views.test):
            photo, splatted, covered = self._photo(view), self._splatted(mesh, view), self._opaque(mesh, view)
            opaque = covered[..., :3]
            scores["psnr"].append(psnr(splatted, photo))
            scores["psnr_mesh"].append(psnr(opaque, photo))
            scores["ssim"].append(ssim(splatted, photo))
            if self._has_masks:
                scores["silhouette_iou"].append(silhouette_iou(covered[..., 3], self._pixels(view)[..., 3]))
            if self._lpips is not None:
                scores["lpips"].append(float(self._lpips(splatted, photo)))
            for kind, image in (("truth", photo), ("render", splatted), ("mesh", opaque)):
                save_image(folder / f"{number:03d}_{kind}.png", image)
        means = {name: _mean(values) if values else None for name, values in scores.items()}
        return {**means, "lpips_reason": self._lpips_reason if self._views.test else "no test views"}

    def _photo(self, view: int) -> Float[Tensor, "H W 3"]:
        return self._pixels(view)[..., :3]

    def _pixels(self, view: int) -> Float[Tensor, "H W 4"]:
        return as_float(self._loader.view(view).photo[0])

    @torch.no_grad()
    def _splatted(self, mesh: TriangleMesh, view: int) -> Float[Tensor, "H W 3"]:
        return render_mesh(mesh, self._loader.view(view).camera, self._config.appearance)[0].clamp(0.0, 1.0)

    def _opaque(self, mesh: TriangleMesh, view: int) -> Float[Tensor, "H W 4"]:
        config = self._config
        camera = self._loader.view(view).camera
        image = render_exported(mesh, camera, supersampling=config.pictures.supersampling)
        return image[0]


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
