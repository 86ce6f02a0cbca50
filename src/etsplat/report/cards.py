"""The numbers of metrics.json as cards: what each means, in words, with its convention and its noise floor."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from etsplat.core.spelling import option
from etsplat.report.data import Run


@dataclass(frozen=True)
class Metric:
    """One card of the report: title, formatted value (None if not measured), unit, and what it means."""

    title: str
    value: str | None
    unit: str
    meaning: str


_PSNR = (
    "The triangles, as the run drew them at last, against the photographs of the test views, which training never saw; "
    "mean over views, in float, over black. Higher is better."
)
_PSNR_MESH = (
    "The same with the exported mesh drawn as opaque triangles, many samples a pixel: what a mesh viewer shows. Where "
    "it is far below the other, pictures depend on the softness of triangles."
)
_TEXTURED = (
    "The test views of textured.glb, a light mesh under a texture that was fitted to the training photos, with 4 × 4 "
    "supersampling: what a mesh viewer shows."
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
_PSNR_AFFINE = (
    "PSNR after the colours of each picture were fitted to those of its photograph: what it would be if the exposure "
    "and white balance of test views were known. It has seen what it is measured on; PSNR is the score."
)
_PSNR_ALIGNED = (
    "PSNR after the pose of each test photograph was fitted to the result: what it would be if test views had poses "
    "as good as those that the run refined. It has seen what it is measured on; PSNR is the score."
)
_SSIM = "Structural similarity on the test views: 11 × 11 Gaussian window, σ 1.5, zero padding. 1 is identical."
_FLIP = (
    "How visible the differences from the photographs of the test views are to who flips between both, at 67 pixels "
    "per degree; mean over pixels and views. 0 is identical, lower is better."
)
_LPIPS = "Learned perceptual distance (VGG16) on the test views. Lower is better."


_SOUP_PSNR = (
    "The soup against the photographs of the test views, which training never saw; mean over views, in float. Higher "
    "is better."
)
_OPAQUE = (
    "The same with the triangles drawn sharp and opaque, with 4 × 4 supersampling: what a mesh viewer shows of an "
    "export. Soft triangles lose much by this; {asset} makes an opaque mesh beside them."
)
_ASSET = (
    "The test views of opaque.glb with 4 × 4 supersampling: opaque triangles in colours that are the same from every "
    "side, as any mesh viewer shows them."
)
_SOUP_SSIM = (
    "Structural similarity on the test views: 11 × 11 Gaussian window, σ 1.5, zeros beyond the border, as 3DGS."
)
_SOUP_LPIPS = (
    "Learned perceptual distance (VGG16) on the test views, images in [0, 1] as the network's inputs: the convention "
    "of 3DGS, not comparable with other ones. Lower is better."
)
_SPEED = "Test views drawn one after the other at their size, colour only, best of three."
_PER_MILLION = "The same time, divided by the millions of triangles in the soup."


def cards_of(run: Run) -> list[Metric]:
    """The cards of a run, most telling first."""
    cards = describe_mesh(run.metrics) if run.task == "reconstruct" else describe_soup(run.metrics)
    watched = [_watched_card(run.metrics)] if run.metrics.get("watched_psnr") is not None else []
    return [cards[0], *watched, *cards[1:], *_aligned_cards(run.metrics)]


def _aligned_cards(metrics: dict[str, Any]) -> list[Metric]:
    """Of runs that were to refine cameras: test photos from where they look best, and what became of cameras."""
    if "cameras_refined" not in metrics:
        return []
    given, refined = (metrics.get(f"watched_psnr_{kind}_cameras") for kind in ("given", "refined"))
    judged = "The run was too short to judge."
    if given is not None and refined is not None:
        judged = (
            f"Photos kept from training, aligned to the model, had {refined:.2f} dB with refined cameras and "
            f"{given:.2f} dB with those given."
        )
    what = "refined" if metrics["cameras_refined"] else "as given"
    return [
        number_card(metrics, "psnr_aligned", "PSNR, poses fitted", "dB", fixed(2), _PSNR_ALIGNED, "no test views"),
        Metric("Cameras", what, "", judged),
    ]


def describe_mesh(metrics: dict[str, Any]) -> list[Metric]:
    """The cards for the metrics.json of a mesh."""
    no_mesh = "no ground-truth mesh to compare with"
    return [
        number_card(metrics, "psnr", "PSNR", "dB", fixed(2), _PSNR, "no test views"),
        number_card(metrics, "chamfer", "Chamfer distance", "× 10⁻³", _thousandths, _chamfer_meaning(metrics), no_mesh),
        number_card(metrics, "psnr_mesh", "PSNR of the mesh", "dB", fixed(2), _PSNR_MESH, "no test views"),
        number_card(metrics, "f_score", "F-score at 0.005", "%", _percent, _F_SCORE, no_mesh),
        number_card(metrics, "chamfer_exact", "Exact Chamfer", "× 10⁻³", _thousandths, _EXACT, no_mesh),
        number_card(metrics, "silhouette_iou", "Silhouette IoU", "%", _percent, _IOU, "no masks, or no test views"),
        number_card(metrics, "ssim", "SSIM", "", fixed(4), _SSIM, "no test views"),
        number_card(metrics, "flip", "FLIP", "", fixed(4), _FLIP, "no test views"),
        number_card(metrics, "lpips", "LPIPS", "", fixed(4), _LPIPS, metrics.get("lpips_reason") or "no weights"),
        number_card(metrics, "psnr_affine", "PSNR, colours fitted", "dB", fixed(2), _PSNR_AFFINE, "no test views"),
        Metric("Mesh", f"{metrics['faces']:,}", "faces", _mesh_meaning(metrics)),
        *_textured_cards(metrics),
        time_card(metrics),
    ]


def _textured_cards(metrics: dict[str, Any]) -> list[Metric]:
    """Of the light mesh under a texture, where the run made one."""
    if metrics.get("textured_faces") is None:
        return []
    side = f" of {metrics['texture']} × {metrics['texture']} texels" if metrics.get("texture") else ""
    return [
        number_card(metrics, "psnr_textured", "PSNR of the textured mesh", "dB", fixed(2), _TEXTURED, "no test views"),
        Metric("Textured mesh", f"{metrics['textured_faces']:,}", "faces", f"textured.glb, under a texture{side}."),
    ]


def describe_soup(metrics: dict[str, Any]) -> list[Metric]:
    """The cards for the metrics.json of a soup, together with what `etsplat eval` found, if it was asked."""
    ask = "`etsplat eval` measures it"
    weights = "`etsplat eval` with `--lpips-weights download`, or a file of weights, measures it"
    no_views = "no test views"
    return [
        number_card(metrics, "psnr", "PSNR", "dB", fixed(2), _SOUP_PSNR, no_views),
        number_card(metrics, "ssim", "SSIM", "", fixed(4), _SOUP_SSIM, no_views),
        number_card(metrics, "flip", "FLIP", "", fixed(4), _FLIP, no_views),
        number_card(metrics, "lpips_3dgs", "LPIPS", "", fixed(4), _SOUP_LPIPS, metrics.get("lpips_reason") or weights),
        *_opaque_cards(metrics),
        number_card(metrics, "psnr_affine", "PSNR, colours fitted", "dB", fixed(2), _PSNR_AFFINE, no_views),
        Metric("Triangles", f"{metrics['triangles']:,}", "", _triangles_meaning(metrics)),
        number_card(metrics, "fps", "Speed", "frames/s", fixed(1), _speed(metrics), ask),
        number_card(metrics, "ms_per_million", "Time per million triangles", "ms", fixed(1), _PER_MILLION, ask),
        time_card(metrics),
    ]


def _opaque_cards(metrics: dict[str, Any]) -> list[Metric]:
    """Of the opaque mesh where the run made one, of the soup drawn opaque otherwise."""
    if metrics.get("asset_triangles") is None:
        opaque = _OPAQUE.format(asset=option("asset", True))
        return [
            number_card(metrics, "psnr_opaque", "PSNR of opaque triangles", "dB", fixed(2), opaque, "no test views")
        ]
    return [
        number_card(metrics, "psnr_asset", "PSNR of the opaque mesh", "dB", fixed(2), _ASSET, "no test views"),
        Metric("Opaque mesh", f"{metrics['asset_triangles']:,}", "triangles", "opaque.glb, in one colour per corner."),
    ]


def _watched_card(metrics: dict[str, Any]) -> Metric:
    last, now = metrics.get("watched_psnr_last"), metrics["watched_psnr"]
    meaning = (
        f"{metrics.get('watched_views') or 'Some'} of the training photos were kept from training to watch the run by, "
        "and choose the state that is the result; drawn at 512 pixels at most."
    )
    if last is not None and last != now:
        meaning += (
            f" The run got worse towards its end, where they have {last:.2f} dB: the result is of iteration "
            f"{metrics.get('result_iteration') or 0:,}."
        )
    return number_card(metrics, "watched_psnr", "PSNR of watched photos", "dB", fixed(2), meaning, "")


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
    undone = f" Left out, since they spoilt it: {metrics['edits_undone']} edits." if metrics.get("edits_undone") else ""
    return f"{vertices}{degenerate}, {count('self_intersections', 'self-intersecting faces')}.{undone}"


def time_card(metrics: dict[str, Any]) -> Metric:
    """How long the optimization took."""
    meaning = (
        f"{metrics['iterations']:,} iterations at {1000 * metrics['seconds_per_iteration']:.1f} ms on the engine "
        f"{metrics['engine']}; photographs and metrics not counted in the milliseconds."
    )
    return Metric("Time", *_duration(metrics["seconds"]), meaning)


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
