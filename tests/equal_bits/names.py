"""What is called otherwise in this tree than in BASE, and where bits change on purpose. The only place that says so.

Cases are written with the names of e629b5e, and BASE is that one, or a later one that has this file too: what it says
is the same in both is the same. Whoever renames an option, a tensor of a checkpoint or a number adds a line here.
"""

import re
from dataclasses import dataclass

OPTIONS: dict[str, dict[str, str]] = {
    "reconstruct": {
        # Every run of a mesh started from the sphere.
        **{f"--preset {preset}": f"--preset {preset} --start.shape sphere" for preset in ("best", "quick", "demo")},
        "--views-per-step": "--batch",
        "--supersampling": "--pictures.supersampling",
        "--coarse-levels": "--pictures.coarse-levels",
        "--coarse-until": "--pictures.coarse-until",
        "--colors": "--drawing.colors",
        "--distance": "--drawing.distance",
        "--backend": "--drawing.backend",
        "--start-level": "--start.level",
        "--start-radius": "--start.radius",
        "--start-color": "--start.color",
        "--start-opacity": "--start.opacity",
        "--start-sigma": "--start.sigma",
        "--vertex-update": "--optimizer.vertex-update",
        "--large-steps-weight": "--optimizer.large-steps-weight",
        "--lr-vertices": "--optimizer.lr-vertices",
        "--lr-vertices-final": "--optimizer.lr-vertices-final",
        "--lr-colors": "--optimizer.lr-colors",
        "--lr-opacities": "--optimizer.lr-opacities",
        "--lr-sigma": "--optimizer.lr-sigma",
        "--sigma-final": "--optimizer.sigma-final",
        "--lambda-edge": "--regularization.lambda-edge",
        "--edge-power": "--regularization.edge-power",
        "--lambda-normal": "--regularization.lambda-smooth-normal",
        "--lambda-laplacian": "--regularization.lambda-laplacian",
        "--lambda-sigma": "--regularization.lambda-sigma",
        "--gamma-hold": "--regularization.hold",
        "--gamma-final": "--regularization.final",
        "--subdivide-from": "--refinement.first",
        "--subdivide-until": "--refinement.last",
        "--subdivide-steps": "--refinement.subdivisions",
        "--untangle-steps": "--refinement.untanglings",
        "--log-every": "--output.log-every",
        "--evaluate-every": "--output.evaluate-every",
        "--checkpoint-every": "--output.checkpoint-every",
        "--chamfer-samples": "--output.chamfer-samples",
        "--lpips-weights": "--output.lpips-weights",
    },
    "train": {
        # No photo was kept from training to watch runs by, and exposures were not looked at; the rate of positions and
        # the number of triangles did not depend on the photos; colours might depend on the direction as they liked.
        **{
            f"--preset {preset}": f"--preset {preset} --watch 0 --exposure off --pixels-per-triangle None --no-asset"
            " --optimizer.lr-vertices-unit frame --optimizer.lr-vertices 0.0015 --loss.lambda-harmonics 0"
            for preset in ("quick", "demo", "tiny")
        },
        "--near-plane": "--drawing.near-plane",
        "--cull-small": "--drawing.cull-small",
        "--no-cull-small": "--drawing.no-cull-small",
        "--cull-large": "--drawing.cull-large",
        "--sh-degree": "--drawing.sh-degree",
        "--freeze-incentre": "--drawing.freeze-inradius",
        "--no-freeze-incentre": "--drawing.no-freeze-inradius",
        "--start-points": "--start.points",
        "--start-scale": "--start.scale",
        "--start-limit": "--start.limit",
        "--start-opacity": "--start.opacity",
        "--start-sigma": "--start.sigma",
        "--schedule-length": "--schedule.length",
        "--max-epochs": "--schedule.max-epochs",
        "--sh-every": "--schedule.sh-every",
        "--lr-vertices": "--optimizer.lr-vertices",
        "--lr-vertices-length": "--optimizer.lr-vertices-length",
        "--lr-vertices-final": "--optimizer.lr-vertices-final",
        "--lr-sh-dc": "--optimizer.lr-sh-dc",
        "--lr-sh-rest": "--optimizer.lr-sh-rest",
        "--lr-opacities": "--optimizer.lr-opacities",
        "--lr-sigma": "--optimizer.lr-sigma",
        "--lr-settle": "--optimizer.lr-settle",
        "--lambda-dssim": "--loss.lambda-dssim",
        "--lambda-opacity": "--loss.lambda-opacity",
        "--lambda-size": "--loss.lambda-size",
        "--lambda-normal": "--loss.lambda-depth-normal",
        "--lambda-distortion": "--loss.lambda-distortion",
        "--regularize-from": "--loss.regularize-from",
        "--densify-from": "--densification.begin",
        "--densify-until": "--densification.end",
        "--densify-every": "--densification.every",
        "--growth": "--densification.growth",
        "--replace-dead": "--densification.replace-dead",
        "--no-replace-dead": "--densification.no-replace-dead",
        "--sample-by": "--densification.sample-by",
        "--split-size": "--densification.split-size",
        "--clone-noise": "--densification.clone-noise",
        "--prune-opacity": "--pruning.opacity",
        "--prune-importance": "--pruning.importance",
        "--prune-views": "--pruning.views",
        "--prune-screen-size": "--pruning.screen-size",
        "--log-every": "--output.log-every",
        "--evaluate-every": "--output.evaluate-every",
        "--checkpoint-every": "--output.checkpoint-every",
        "--sky-closed": "--sky sphere",
        "--no-sky-dome": "--sky none",
    },
}
"""By task, what BASE's options are here: "--old": "--new", or with a value "--old value": "--new other" (which goes
first). An empty text leaves the option out. A flag that stands alone is written alone."""


@dataclass(frozen=True)
class Names:
    """How the names of one kind of thing changed.

    Attributes:
        renamed: BASE's name, a regular expression that fits all of it, and what it is here (with \\1 for groups).
        gone: names that BASE alone has.
        added: names that this tree alone has.
        ignored: names of either tree whose values depend on the clock or on versions.
        rounded: names of numbers that are compared to twelve digits: float64 sums in another order.
    """

    renamed: dict[str, str]
    gone: frozenset[str] = frozenset()
    added: frozenset[str] = frozenset()
    ignored: frozenset[str] = frozenset()
    rounded: frozenset[str] = frozenset()

    def here(self, name: str) -> str:
        """What BASE's name is in this tree."""
        for pattern, replacement in self.renamed.items():
            if match := re.fullmatch(pattern, name):
                return match.expand(replacement)
        return name


TENSORS = Names(
    {r"(mesh|soup)\.(.*)": r"model.\2", r"statistics\.(.*)": r"strategy.\1"},
    added=frozenset({"exposure.explained"}),  # what is measured of the photos; where that is little, nothing else is
)
"""Of checkpoints and of soup.safetensors."""
_GEOMETRY = ("chamfer", "chamfer_floor", "chamfer_exact", "f_score")
METRICS = Names(
    {},
    # Meshes and soups are measured by one scorer; edits that spoil are undone; results of meshes are judged.
    added=frozenset(
        {"edits_undone", "ssim_mesh", "test_views", "lpips", "lpips_reason", "silhouette_iou", "judgement", *_GEOMETRY}
    )
    | {"psnr_affine", "exposure_learned", "exposure_explained", "flip", "flip_mesh", "flip_opaque", "flip_asset"},
    ignored=frozenset({"seconds", "seconds_per_iteration", "versions"}),
    # The window of SSIM is summed from its middle outwards.
    rounded=frozenset({"ssim", "ssim_interior", "ssim_mesh", "ssim_opaque", "ssim_asset"}),
)
"""Of metrics.json."""
HISTORY = Names({}, ignored=frozenset({"seconds"}))
"""Of the lines of history.jsonl."""
FILES = Names({})
"""Of files in the run directory, as test/000_render.png."""

CLOCKS = {"progress": 0}
"""Tensors with an element that is a time: its index. By the names of either tree."""

_HELD = "meshes are untangled once more at 0.98 of a run, and from there on their vertices stay"
_SPACED = "edits of scenes are thirty iterations, or a tenth of a short run, apart, and begin after two of these"

CHANGED: dict[str, str] = {
    "owl-batch": "each view of a step is differentiated by itself; their gradients are added in the order of the "
    "views; rates are multiplied by the square root of the batch",
    **dict.fromkeys(("owl-best", "owl-demo", "mesh-quick"), _HELD),
    **{
        f"scene-{name}": _SPACED
        for name in ("elastic", "bilateral", "single-sided", "not-frozen", "opaque", "sphere", "no-sky", "random")
    },
    **{f"scene-{name}": _SPACED for name in ("demo", "paper", "paper-indoor", "paper-object", "paper-sided")},
    **{f"soup-{name}": _SPACED for name in ("reference", "quick", "indoor", "masks", "other-masks", "pointless")},
}
"""Cases whose bits change on purpose, and why. They must differ: a line that is not true any more is an error."""


def translated(task: str, words: list[str]) -> list[str]:
    """BASE's options, as this tree calls them."""
    table, result, position = OPTIONS[task], [], 0
    while position < len(words):
        pair = " ".join(words[position : position + 2])
        if pair in table:
            result += table[pair].split()
            position += 2
        else:
            word = words[position]
            result += table[word].split() if word in table else [word]
            position += 1
    return result
