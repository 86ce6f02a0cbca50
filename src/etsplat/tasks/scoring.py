"""How good a model is: on the test views, splatted and as a mesh viewer draws it, and against the true mesh.

`Scorer` measures at the end of every run, `evaluate_run` all that is measured of a finished soup, speed included.
"""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.core.validation import check_kind
from etsplat.data.dataset import Dataset
from etsplat.data.loader import ViewLoader
from etsplat.engines.choice import engine_for
from etsplat.engines.threads import num_threads
from etsplat.geometry.intersections import count_degenerate_faces, count_self_intersections
from etsplat.io.atomic import write_error
from etsplat.io.images import save_image, to_8_bit
from etsplat.io.mesh_files import MeshFile
from etsplat.io.paths import given_path
from etsplat.metrics.flip import flip
from etsplat.metrics.geometry import SAMPLES, Surface, chamfer, geometry_metrics, sample_pair
from etsplat.metrics.image import WINDOW, Lpips, find_lpips_weights, psnr, silhouette_iou, ssim
from etsplat.model.model import Model
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.tasks.opened_runs import SoupRun
from etsplat.tasks.running import device_name
from etsplat.tasks.seen import Seen

SMALLEST = 16
"""Pixels a side below which LPIPS is not defined."""

METRICS = ("psnr", "psnr_8bit", "ssim", "ssim_interior", "flip", "lpips", "lpips_3dgs")
"""Of a view: psnr_8bit is that of images rounded to 8 bits, as published numbers are; ssim is zero-padded; lpips has
inputs in [-1, 1], lpips_3dgs in [0, 1]."""

BRIEF = ("psnr", "ssim", "flip")
"""Those of them that runs end with, of the model and of what a mesh viewer shows."""

REPEATS = 3
"""Every view is timed so often, after one picture that is not counted; the best time counts."""

FoundLpips = tuple[Lpips | None, str | None]
"""The metric, or why it is not measured."""


class Scorer:
    """Measures models on one data set. Measuring changes nothing and draws no random number of a run.

    Images are compared over the background, in float, renders clamped to [0, 1]; pixels that a mask excludes count as
    right.

    Attributes:
        starts: cameras of test views from which these are aligned to the model (`fitted_scores`); empty for views
            whose poses are not in doubt.

    Example:
        >>> photos = etsplat.photograph(etsplat.demo_object(), 16, 16, elevations=(0.0,), azimuths=5, supersampling=1)
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
        >>> scorer = etsplat.Scorer(photos, torch.device("cpu"))
        >>> sorted(scorer.cheap(mesh)), photos.test
        (['psnr'], [2])
    """

    starts: Mapping[int, Cameras] = MappingProxyType({})

    def __init__(
        self,
        dataset: Dataset,
        device: torch.device | str,
        *,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        truth: MeshFile | None = None,
        samples: int = SAMPLES,
        supersampling: int = 4,
        lpips: FoundLpips = (None, None),
    ) -> None:
        """Takes what measuring needs.

        Args:
            dataset: its test views are measured.
            device: of the models.
            background: behind pictures and photos.
            truth: the true mesh, in the frame of the data set, or None if there is none.
            samples: points on each surface for the Chamfer distance.
            supersampling: samples along each axis of a pixel of opaque pictures.
            lpips: from `load_lpips`; not measured by default.

        Raises:
            ValueError: `dataset` is none.
        """
        check_kind("dataset", dataset, Dataset, "etsplat.load_dataset(path) reads one")
        device = torch.device(device)
        self._dataset, self._views, self._device = dataset, ViewLoader(dataset, device), device
        self._background = torch.tensor(background, device=device)
        self._truth, self._samples, self._supersampling = truth, samples, supersampling
        self._true_surface: Surface | None = None  # with samples, once they are drawn
        sides = [min(camera.width, camera.height) for camera in (dataset.cameras[index] for index in dataset.test)]
        too_small = min(sides, default=SMALLEST) < SMALLEST
        self._lpips, self.lpips_reason = (None, "the images are smaller than 16 pixels") if too_small else lpips

    def see_by(self, dataset: Dataset, starts: Mapping[int, Cameras]) -> None:
        """From now on training views have the cameras of this data set of the same photos; for `starts` see there."""
        self._dataset, self._views, self.starts = dataset, ViewLoader(dataset, self._device), starts

    def cheap(self, model: Model) -> dict[str, float]:
        """For the history: "psnr" if there are test views, "chamfer" (an estimate) if there is a true mesh."""
        scores: dict[str, float] = {}
        if self._dataset.test:
            seen = [self.see(model, index) for index in self._dataset.test]
            scores["psnr"] = sum(psnr(view.counting(view.splatted), view.photo) for view in seen) / len(seen)
        if self._truth is not None:
            truth = self._truth.vertices, self._truth.faces
            pair = sample_pair(*model.surface(), *truth, self._samples, truth=self._true_surface)
            self._true_surface = pair[1]
            scores["chamfer"] = chamfer(*pair, queries=self._samples // 10)
        return scores

    def full(self, model: Model, folder: Path | str) -> dict[str, Any]:
        """For metrics.json; draws the test views into `folder` on the way.

        Args:
            model: what to measure.
            folder: gets NNN_render.png, NNN_truth.png and NNN_<model.OPAQUE>.png for every test view; made if it is
                missing.

        Returns:
            Means over the test views, and what was found of each, null where there are none; geometry, null where there
            is no true mesh.

        Raises:
            InputError: `folder` is no path, or a picture cannot be written.
        """
        folder = given_path("folder", folder, "the path of a folder")
        folder.mkdir(parents=True, exist_ok=True)
        rows: list[dict[str, Any]] = []
        for number, index in enumerate(self._dataset.test):
            seen = self.see(model, index)
            rows.append({"name": self._dataset.names[index], **self._scores(seen, model.OPAQUE)})
            for kind, image in (("truth", seen.photo), ("render", seen.splatted), (model.OPAQUE, seen.opaque)):
                save_image(folder / f"{number:03d}_{kind}.png", image)
        names = (
            "psnr",
            "psnr_affine",
            *(["psnr_aligned"] if self.starts else []),
            "ssim",
            "flip",
            *(f"{name}_{model.OPAQUE}" for name in BRIEF),
            "lpips",
            "silhouette_iou",
        )
        means = {name: _mean([row[name] for row in rows]) for name in names}
        reason = self.lpips_reason if rows else "no test views"
        return {**self._geometry(model), **means, "lpips_reason": reason, "test_views": rows}

    def asset(self, mesh: TriangleMesh, folder: Path) -> dict[str, float | None]:
        """How a mesh viewer draws the opaque mesh of a scene: means over the test views, and how many triangles it has.

        Args:
            mesh: what to measure.
            folder: gets NNN_opaque.png for every test view, in the place of the soup's.
        """
        rows = []
        for number, index in enumerate(self._dataset.test):
            seen = self.see(mesh, index)
            rows.append(image_scores(seen.counting(seen.opaque), seen.photo, names=BRIEF, suffix="_asset"))
            save_image(folder / f"{number:03d}_opaque.png", seen.opaque)
        means = {name: _mean([row[name] for row in rows]) for name in (f"{each}_asset" for each in BRIEF)}
        return {**means, "asset_triangles": mesh.count}

    def opaque(self, model: Model, views: Sequence[int]) -> dict[str, float | None]:
        """Means over some views, by index, of how a mesh viewer draws a model: "psnr_mesh" and "silhouette_iou".

        None where there are no views, or no masks.
        """
        rows = []
        for seen in (self.see(model, index) for index in views):
            rows.append((psnr(seen.counting(seen.opaque), seen.photo), self._outline_iou(seen)))
        psnrs, ious = zip(*rows, strict=True) if rows else ((), ())
        return {"psnr_mesh": _mean(psnrs), "silhouette_iou": _mean(ious)}

    def see(self, model: Model, index: int) -> Seen:
        """A view of the data set, by its index, beside the model's."""
        return Seen(model, self._views.view(index), self._background, self._supersampling, self.starts.get(index))

    def _scores(self, seen: Seen, opaque: str) -> dict[str, float | None]:
        splatted, drawn = seen.counting(seen.splatted), seen.counting(seen.opaque)
        return {
            **image_scores(splatted, seen.photo, names=BRIEF),
            **fitted_scores(seen),
            **image_scores(drawn, seen.photo, names=BRIEF, suffix=f"_{opaque}"),
            **image_scores(splatted, seen.photo, self._lpips, ("lpips",)),
            "silhouette_iou": self._outline_iou(seen),
        }

    def _outline_iou(self, seen: Seen) -> float | None:
        if seen.alpha is None or not self._has_outlines:
            return None
        return silhouette_iou(seen.covered[..., 3], seen.alpha)

    @cached_property
    def _has_outlines(self) -> bool:
        return self._dataset.has_masks

    def _geometry(self, model: Model) -> dict[str, Any]:
        vertices, faces = model.surface()
        if self._truth is not None:
            truth = self._truth.vertices, self._truth.faces
            return asdict(geometry_metrics(vertices, faces, *truth, samples=self._samples))
        found: dict[str, Any] = dict.fromkeys(("chamfer", "chamfer_floor", "chamfer_exact", "f_score"))
        if isinstance(model, TriangleMesh):
            found["degenerate_faces"] = count_degenerate_faces(vertices, faces)
            found["self_intersections"] = count_self_intersections(vertices, faces)
        return found


def image_scores(
    image: Float[Tensor, "H W 3"],
    photo: Float[Tensor, "H W 3"],
    lpips: Lpips | None = None,
    names: Sequence[str] = METRICS,
    *,
    suffix: str = "",
) -> dict[str, float | None]:
    """Metrics of one view by name, with a suffix; None where one is not defined or not at hand.

    Args:
        image: (H, W, 3) in [0, 1].
        photo: (H, W, 3) in [0, 1].
        lpips: the metric, if there is one.
        names: which of `METRICS`.
        suffix: of the names in the result.
    """
    smallest = min(image.shape[:2])
    measures: dict[str, Callable[[], float]] = {
        "psnr": lambda: psnr(image, photo),
        "psnr_8bit": lambda: psnr(to_8_bit(image).float() / 255, to_8_bit(photo).float() / 255),
        "ssim": lambda: ssim(image, photo),
        "flip": lambda: float(flip(image, photo)),
    }
    if smallest >= WINDOW:
        measures["ssim_interior"] = lambda: ssim(image, photo, interior=True)
    if lpips is not None and smallest >= SMALLEST:
        measures["lpips"] = lambda: float(lpips(image, photo))
        measures["lpips_3dgs"] = lambda: float(lpips(image, photo, rescale=False))
    return {f"{name}{suffix}": measures[name]() if name in measures else None for name in names}


def fitted_scores(seen: Seen) -> dict[str, float | None]:
    """What the PSNR of a view would be if more were known of its photograph, by names of their own.

    "psnr_affine" if its exposure and white balance were; and where it may be aligned, "psnr_aligned" if its pose were.
    """
    scores: dict[str, float | None] = {"psnr_affine": psnr(seen.counting(seen.fitted), seen.photo)}
    if seen.start is not None:
        scores["psnr_aligned"] = psnr(seen.counting(seen.aligned), seen.photo)
    return scores


def load_lpips(weights: Path | str | None, device: torch.device) -> FoundLpips:
    """The metric, or why it cannot be measured; `weights` as `etsplat.metrics.image.find_lpips_weights` takes it.

    Raises:
        InputError: `weights` are given and cannot be used.
    """
    found = find_lpips_weights(weights)
    if not found.paths:
        return None, found.reason
    lpips = Lpips.from_weights(*found.paths)
    lpips.to(device)
    return lpips, found.reason


def evaluate_run(
    run: SoupRun,
    *,
    lpips_weights: Path | str | None = None,
    pictures: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure a soup on the test views of its capture.

    Args:
        run: with its capture; measured on its device.
        lpips_weights: as `etsplat.metrics.image.find_lpips_weights` takes it.
        pictures: folder for NAME.png of every test view: photograph, soup, the opaque mesh (of runs that made none, the
            soup's opaque triangles), and the error of the soup times 4.
        progress: called with (views done, views in all).

    Returns:
        Means over the test views by name: psnr and psnr_8bit (of renders rounded to 8 bits, as published numbers are),
        ssim (zero-padded), ssim_interior, flip, lpips (inputs scaled to [-1, 1]) and lpips_3dgs (not scaled), each
        also with `_opaque` for the soup's opaque triangles, and with `_asset` for the opaque mesh where there is one
        (psnr, ssim and flip); psnr_affine, after a fit of the colours to each photograph;
        psnr_aligned, of runs that refined cameras, after a fit of the pose of each;
        `views`, the same for each; fps, ms_per_frame, ms_per_million and their circumstances. null where something
        could not be measured, `lpips_reason` says why. `other_scene` says whether the capture is known to be another
        one than that of the training.

    Raises:
        InputError: no capture, no test views, weights that cannot be read, `pictures` cannot be written to.
    """
    capture = run.needed_capture()
    if not capture.test:
        raise InputError(f"{run.path}: the capture has no test views; there is nothing to measure")
    if pictures is not None:
        try:
            pictures.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise write_error(pictures, error) from error
    place, soup = run.device, run.soup
    lpips, reason = load_lpips(lpips_weights, place)
    background = soup.appearance.background
    scorer = Scorer(capture, place, background=background)
    scorer.starts = run.test_cameras
    rows: list[dict[str, Any]] = []
    for index, view in enumerate(capture.test):
        seen = scorer.see(soup, view)
        photo, soft, opaque = seen.photo, seen.counting(seen.splatted), seen.counting(seen.opaque)
        name, scores = capture.names[view], image_scores(soft, photo, lpips)
        scores |= fitted_scores(seen) | image_scores(opaque, photo, lpips, suffix="_opaque")
        if run.solid is not None:
            opaque = seen.counting(scorer.see(run.solid, view).opaque)
            scores |= image_scores(opaque, photo, names=BRIEF, suffix="_asset")
        rows.append({"name": name, **scores})
        if pictures is not None:
            error = (4 * (soft - photo).abs()).clamp(0, 1)
            save_image(pictures / f"{name}.png", torch.cat([photo, soft, opaque, error], dim=1))
        if progress is not None:
            progress(index + 1, len(capture.test))

    def draw(camera: Cameras) -> None:
        soup.render(camera, backgrounds=torch.tensor([background], device=place))

    cameras = [capture.cameras[view] for view in capture.test]
    speed = {**drawing_speed(draw, cameras, place, len(soup)), "engine": engine_for(soup.vertices).name}
    about = {"triangles": len(soup), "other_scene": run.other_scene}
    return {**mean_scores(rows), "lpips_reason": reason, **speed, **about, "views": rows}


def mean_scores(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Means over views, of what was measured in all of them."""
    columns = {name: [row[name] for row in rows] for name in rows[0] if name != "name"}
    return {name: None if None in values else statistics.fmean(values) for name, values in columns.items()}


@torch.no_grad()
def drawing_speed(
    draw: Callable[[Cameras], object], cameras: Sequence[Cameras], device: torch.device, primitives: int
) -> dict[str, Any]:
    """Pictures one after the other, colour only; the mean over cameras of each one's best time."""
    best = []
    for camera in (camera.to(device) for camera in cameras):
        times = []
        for repeat in range(REPEATS + 1):
            start = time.perf_counter()
            draw(camera)
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            if repeat:
                times.append(time.perf_counter() - start)
        best.append(min(times))
    seconds = statistics.fmean(best)
    return {
        "fps": 1 / seconds,
        "ms_per_frame": 1e3 * seconds,
        "ms_per_million": 1e3 * seconds / (primitives / 1e6),
        "width": cameras[0].width,
        "height": cameras[0].height,
        "device": device_name(device),
        "threads": num_threads(),
    }


def _mean(values: Sequence[float | None]) -> float | None:
    """Of what was measured in all views."""
    present = [value for value in values if value is not None]
    return sum(present) / len(present) if present and len(present) == len(values) else None
