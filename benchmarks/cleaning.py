"""What an export without sky, cropped and cleaned leaves out of trained soups, and what that costs on their test views.

    python -m benchmarks.cleaning runs/bonsai runs/fox

A row of a table in Markdown for each run. Its soft triangles, and those of opacity 1/2 and more, drawn opaque, are
cleaned and measured on their own, as `etsplat render --clean` and `etsplat export --clean` do.
"""

import sys
from pathlib import Path
from statistics import fmean

from etsplat.metrics.image import psnr
from etsplat.model.soup_appearance import OPAQUE_FROM
from etsplat.tasks.opened_runs import SoupRun, open_run
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.soup_selection import Selection, select

COLUMNS = (
    "run",
    "half opaque",
    "of these sky",
    "clean: out of frame",
    "shown by too few",
    "alone",
    "left",
    "outside of crop auto",
    "PSNR opaque",
    "soft: triangles",
    "clean: out of frame",
    "shown by too few",
    "alone",
    "PSNR soft",
)


def scores(run: SoupRun, chosen: Selection) -> tuple[float, float]:
    """PSNR soft and opaque of what was chosen, means over the test views."""
    soup, capture = chosen.of(run.soup), run.needed_capture()
    scorer = Scorer(capture, run.device, background=soup.appearance.background)
    seen = [scorer.see(soup, view) for view in capture.test]
    soft = fmean(psnr(view.counting(view.splatted), view.photo) for view in seen)
    return soft, fmean(psnr(view.counting(view.opaque), view.photo) for view in seen)


def row(path: Path) -> list[str]:
    """The numbers of one run."""
    run = open_run(path)
    solid = select(run, min_opacity=OPAQUE_FROM)
    sky = int((solid.sky & solid.kept).sum())
    opaque = select(run, min_opacity=OPAQUE_FROM, clean=True, opaque=True)
    cropped = select(run, min_opacity=OPAQUE_FROM, sky=False, crop="auto")
    soft, everything = select(run, clean=True), select(run)
    before, after = scores(run, everything), (scores(run, soft)[0], scores(run, opaque)[1])
    reasons = ("frame", "unseen", "alone")
    return [
        path.name,
        f"{int(solid.kept.sum()):,}",
        f"{sky:,}",
        *(f"{opaque.removed.get(reason, 0):,}" for reason in reasons),
        f"{int((opaque.kept & ~opaque.sky).sum()):,}",
        f"{cropped.removed.get('crop', 0):,}",
        f"{before[1]:.2f} → {after[1]:.2f}",
        f"{len(run.soup):,}",
        *(f"{soft.removed.get(reason, 0):,}" for reason in reasons),
        f"{before[0]:.2f} → {after[0]:.2f}",
    ]


if __name__ == "__main__":
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    for name in sys.argv[1:]:
        print("| " + " | ".join(row(Path(name))) + " |", flush=True)
