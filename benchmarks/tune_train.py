"""How settings of novel-view synthesis do at a small budget: a line for each, PSNR of test and training views.

python -m benchmarks.tune_train --width 200 --base iterations=600,max_triangles=15000 -- "" near_plane=0.02
python -m benchmarks.tune_train --scene ../shared/data/scenes/bonsai --scene-type indoor -- "" method=bilateral
"""

import argparse
import ast
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from etsplat.metrics.image import psnr, ssim
from etsplat.ops.engines import num_threads, one_torch_thread, set_num_threads
from etsplat.scene.captures import Capture, load_capture
from etsplat.scene.demo_scene import demo_scene
from etsplat.tasks.soup_scoring import SoupScorer
from etsplat.tasks.train import start_fitting
from etsplat.tasks.train_config import TrainConfig, train_settings

LINES = 4
TRAINING_VIEWS = 6


def settings_of(text: str) -> dict[str, Any]:
    """name=value,name=value; what is no Python literal is a string."""
    settings = {}
    for part in filter(None, text.split(",")):
        name, value = part.split("=", 1)
        try:
            settings[name] = ast.literal_eval(value)
        except ValueError:
            settings[name] = value
    return settings


def run(capture: Capture, config: TrainConfig) -> str:
    scorer = SoupScorer(capture, torch.zeros(3), config.engine)
    fitting = start_fitting(capture, config, scorer.cheap)
    training = capture.train[:: max(1, len(capture.train) // TRAINING_VIEWS)]
    columns = []
    start = time.perf_counter()
    for iteration in range(1, config.iterations + 1):
        fitting.advance(iteration, iteration)
        fitting.refine(iteration)
        if iteration % (config.iterations // LINES) == 0:
            seen = mean(scorer, training, lambda view: scorer.splatted(fitting.soup, fitting.appearance, view))
            columns.append(f"{fitting.evaluate()['psnr']:.2f} ({seen:.2f})")
    seconds = time.perf_counter() - start
    soup, appearance = fitting.finished()
    opaque = mean(scorer, capture.test, lambda view: scorer.opaque(soup, appearance, view))
    likeness = [ssim(scorer.splatted(soup, appearance, view), scorer.photo(view)) for view in capture.test]
    columns.append(f"SSIM {sum(likeness) / len(likeness):.3f}")
    return f"{' | '.join(columns)} | opaque {opaque:.2f} | {len(soup):,} triangles | {seconds:.0f} s"


def mean(scorer: SoupScorer, views: list[int], draw: Any) -> float:
    return sum(psnr(draw(view), scorer.photo(view)) for view in views) / len(views)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, help="a capture; the built-in scene without one")
    parser.add_argument("--width", type=int, default=300)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--scene-type", default="outdoor")
    parser.add_argument("--base", default="iterations=600,max_triangles=40000", help="settings of every run")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("runs", nargs="+", help="settings of one run each, name=value,...; empty for the base")
    options = parser.parse_args()
    set_num_threads(options.threads)
    width = options.width
    loaded = load_capture(options.scene, width=width) if options.scene else demo_scene(width, 3 * width // 4)
    print(f"{num_threads()} threads; PSNR of test views (of training views) at each quarter of a run", flush=True)
    for text in options.runs:
        settings = {**settings_of(options.base), **settings_of(text)}
        config = replace(train_settings(options.preset, options.scene_type), **settings)
        with one_torch_thread():
            print(text or "base", "|", run(loaded.normalized() if config.normalize else loaded, config), flush=True)


if __name__ == "__main__":
    main()
