"""Processor time of a step of shape reconstruction, with what is done between steps; or of a whole run.

python -m benchmarks.reconstruct_step data/objects/mug --init runs/mug/mesh.ply
python -m benchmarks.reconstruct_step data/objects/mug/mesh.obj --whole runs/mug
"""

import argparse
import statistics
import time
from pathlib import Path

import torch

from etsplat.engines.threads import num_threads, one_torch_thread, set_num_threads
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.trainer import Trainer
from etsplat.tasks.reconstruct import make_trainer, reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import load_source, make_subject
from etsplat.tasks.starts import load_start, make_start

FIRST = 51
"""The iteration of the first step: regularizers fall by then."""


def started(source: Path, init: Path, preset: str) -> Trainer[TriangleMesh]:
    """A run that starts from a finished mesh and leaves its faces as they are, at full resolution."""
    config = ReconstructConfig.of(preset).changed(
        {
            "iterations": 100_000,
            "refinement.untanglings": 0,
            "refinement.subdivisions": 0,
            "pictures.coarse_levels": 0,
            "watch": 0,
        }
    )
    loaded, _ = load_source(source, config, None)
    views, _ = make_subject(loaded, config, lambda *_: None, torch.device("cpu"))
    return make_trainer(make_start(load_start(init), views, config).mesh, views, config)


def turns(trainer: Trainer[TriangleMesh], steps: int, count: int) -> list[float]:
    """Milliseconds of the processor a step, of each turn of so many steps."""
    found, iteration = [], FIRST
    for _ in range(count):
        begin = time.process_time()
        for _ in range(steps):
            trainer.advance(iteration, iteration)
            trainer.review(trainer.progress)
            trainer.refine(iteration)
            iteration += 1
        found.append(1e3 * (time.process_time() - begin) / steps)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="as of `etsplat reconstruct`")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--init", type=Path, help="steps from this mesh, in the units of the source")
    what.add_argument("--whole", type=Path, help="a whole run into this folder, over an earlier one")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--steps", type=int, default=40, help="of a turn")
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args()
    set_num_threads(options.threads)
    with one_torch_thread():
        if options.whole:
            begin = time.process_time()
            reconstruct(options.source, options.whole, ReconstructConfig.of(options.preset), overwrite=True)
            print(f"{time.process_time() - begin:.1f} s of the processor, {num_threads()} threads")
            return
        trainer = started(options.source, options.init, options.preset)
        times = turns(trainer, options.steps, options.turns)
    each = ", ".join(f"{ms:.1f}" for ms in times)
    print(f"{trainer.count:,} faces, {num_threads()} threads: {statistics.median(times):.2f} ms a step ({each})")


if __name__ == "__main__":
    main()
