"""The numbers of a run as cards: those of a mesh are in `report.metrics`, those of a soup here."""

from typing import Any

from etsplat.report.data import Run
from etsplat.report.metrics import Metric, describe, fixed, number_card, time_card

_PSNR = (
    "The soup against the photographs of the test views, which training never saw; mean over views, in float. Higher "
    "is better."
)
_OPAQUE = (
    "The same with the triangles drawn sharp and opaque, with 4 × 4 supersampling: what a mesh viewer shows of an "
    "export. Without --finish opaque, soft triangles lose much by this."
)
_SSIM = "Structural similarity on the test views: 11 × 11 Gaussian window, σ 1.5, zeros beyond the border, as 3DGS."
_LPIPS = (
    "Learned perceptual distance (VGG16) on the test views, images in [0, 1] as the network's inputs: the convention "
    "of 3DGS, not comparable with other ones. Lower is better."
)
_SPEED = "Test views drawn one after the other at their size, colour only, best of three."
_PER_MILLION = "The same time, divided by the millions of triangles in the soup."


def cards_of(run: Run) -> list[Metric]:
    """The cards of a run, most telling first."""
    return describe(run.metrics) if run.task == "reconstruct" else describe_soup(run.metrics)


def describe_soup(metrics: dict[str, Any]) -> list[Metric]:
    """The cards for the metrics.json of a soup, together with what `etsplat eval` found, if it was asked."""
    ask = "`etsplat eval` measures it"
    no_views = "no test views"
    return [
        number_card(metrics, "psnr", "PSNR", "dB", fixed(2), _PSNR, no_views),
        number_card(metrics, "ssim", "SSIM", "", fixed(4), _SSIM, no_views),
        number_card(metrics, "lpips_3dgs", "LPIPS", "", fixed(4), _LPIPS, metrics.get("lpips_reason") or ask),
        number_card(metrics, "psnr_opaque", "PSNR of opaque triangles", "dB", fixed(2), _OPAQUE, no_views),
        Metric("Triangles", f"{metrics['triangles']:,}", "", _triangles_meaning(metrics)),
        number_card(metrics, "fps", "Speed", "frames/s", fixed(1), _speed(metrics), ask),
        number_card(metrics, "ms_per_million", "Time per million triangles", "ms", fixed(1), _PER_MILLION, ask),
        time_card(metrics),
    ]


def _triangles_meaning(metrics: dict[str, Any]) -> str:
    def span(name: str) -> str:
        low, middle, high = (metrics.get(key) for key in (f"{name}_10", name, f"{name}_90"))
        return "" if None in (low, middle, high) else f"median {middle:.3g}, 10 to 90 %: {low:.3g} to {high:.3g}"

    parts = [
        f"{title} {text}" for title, name in (("Softness σ:", "sigma"), ("opacity:", "opacity")) if (text := span(name))
    ]
    return "; ".join(parts) + "." if parts else "In the soup at the end."


def _speed(metrics: dict[str, Any]) -> str:
    if "threads" not in metrics:
        return _SPEED
    return f"{_SPEED} Engine {metrics['engine']}, {metrics['threads']} thread{'s' * (metrics['threads'] != 1)}."
