"""What each number of metrics.json means, in words, with its convention and its noise floor."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Metric:
    """One card of the report: title, formatted value (None if not measured), unit, and what it means."""

    title: str
    value: str | None
    unit: str
    meaning: str


def describe(metrics: dict[str, Any]) -> list[Metric]:
    """The cards for a metrics.json, most telling first."""
    no_mesh = "no ground-truth mesh to compare with"
    return [
        number_card(metrics, "psnr", "PSNR", "dB", fixed(2), _PSNR, "no test views"),
        number_card(metrics, "chamfer", "Chamfer distance", "× 10⁻³", _thousandths, _chamfer_meaning(metrics), no_mesh),
        number_card(metrics, "psnr_mesh", "PSNR of the mesh", "dB", fixed(2), _PSNR_MESH, "no test views"),
        number_card(metrics, "f_score", "F-score at 0.005", "%", _percent, _F_SCORE, no_mesh),
        number_card(metrics, "chamfer_exact", "Exact Chamfer", "× 10⁻³", _thousandths, _EXACT, no_mesh),
        number_card(metrics, "silhouette_iou", "Silhouette IoU", "%", _percent, _IOU, "no masks, or no test views"),
        number_card(metrics, "ssim", "SSIM", "", fixed(4), _SSIM, "no test views"),
        number_card(metrics, "lpips", "LPIPS", "", fixed(4), _LPIPS, metrics.get("lpips_reason") or "no weights"),
        Metric("Mesh", f"{metrics['faces']:,}", "faces", _mesh_meaning(metrics)),
        time_card(metrics),
    ]


_PSNR = (
    "The splatted triangles against the photographs of the test views, which training never saw; mean over views, in "
    "float, over black. Higher is better."
)
_PSNR_MESH = (
    "The same with the exported mesh drawn as opaque triangles: what a mesh viewer shows. Close to the PSNR of the "
    "splats means that nothing depends on their softness."
)
_F_SCORE = (
    "Points of each surface that lie within 0.005 of the other one, object at radius 1; harmonic mean of both "
    "directions. 100 % is a perfect match."
)
_EXACT = (
    "The Chamfer distance measured from sampled points to the other surface itself instead of to its samples: without "
    "the sampling floor. Lower is better."
)
_IOU = (
    "Pixels of the test views that the mesh and the object both cover, over those that either covers (at least half of "
    "the pixel); mean over views. 100 % is the same outline."
)
_SSIM = "Structural similarity on the test views: 11 × 11 Gaussian window, σ 1.5, zero padding. 1 is identical."
_LPIPS = "Learned perceptual distance (VGG16) on the test views. Lower is better."


def _chamfer_meaning(metrics: dict[str, Any]) -> str:
    meaning = (
        "Squared distances between 100,000 random points on each surface, both directions summed, object scaled to "
        "radius 1. Lower is better"
    )
    floor = metrics.get("chamfer_floor")
    if floor is None:
        return meaning + "."
    return f"{meaning}; a perfect copy would score about {_thousandths(floor)}, the floor that sampling leaves."


def _mesh_meaning(metrics: dict[str, Any]) -> str:
    def count(key: str, what: str) -> str:
        return f"{metrics[key]:,} {what}" if metrics.get(key) else f"no {what}"

    vertices = f"{metrics['vertices']:,} vertices; " if metrics.get("vertices") else ""
    degenerate = count("degenerate_faces", "faces without area")
    return f"{vertices}{degenerate}, {count('self_intersections', 'self-intersecting faces')}."


def time_card(metrics: dict[str, Any]) -> Metric:
    """How long the optimization took."""
    return Metric("Time", *_duration(metrics["seconds"]), _time_meaning(metrics))


def _time_meaning(metrics: dict[str, Any]) -> str:
    return (
        f"{metrics['iterations']:,} iterations at {1000 * metrics['seconds_per_iteration']:.1f} ms on the engine "
        f"{metrics['engine']}; photographs and metrics not counted in the milliseconds."
    )


def _duration(seconds: float) -> tuple[str, str]:
    if seconds < 120:
        return f"{seconds:.1f}", "s"
    minutes = round(seconds / 60)
    return (f"{minutes}", "min") if minutes < 120 else (f"{seconds / 3600:.1f}", "h")


def number_card(
    metrics: dict[str, Any],
    key: str,
    title: str,
    unit: str,
    show: Callable[[float], str],
    meaning: str,
    absent: str,
) -> Metric:
    """The card of one number, or of its absence."""
    value = metrics.get(key)
    if value is None:
        return Metric(title, None, "", f"{meaning} Not measured: {absent}.")
    return Metric(title, show(value), unit, meaning)


def fixed(digits: int) -> Callable[[float], str]:
    """A format with so many digits behind the point."""
    return lambda value: f"{value:.{digits}f}"


def _thousandths(value: float) -> str:
    return f"{1000 * value:.4f}" if value < 1e-3 else f"{1000 * value:#.3g}"


def _percent(value: float) -> str:
    return f"{100 * value:.1f}"
