"""Where the processor time of a whole reconstruction goes: seconds of each stage, with report and pictures.

python -m benchmarks.reconstruct_stages demo:owl --out runs/stages
python -m benchmarks.reconstruct_stages data/famous/armadillo.obj --out runs/stages --preset quick
"""

import argparse
import functools
import importlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import etsplat
from benchmarks.machine import cpu_model, load_average
from etsplat.engines.threads import num_threads, set_num_threads

STAGES = {
    "photographs or photos, normalization": ["tasks.reconstruct:load_source", "tasks.reconstruct:make_subject"],
    "start: sphere or hull": ["tasks.starts:start_shape"],
    "start: hull": ["tasks.starts:plain_hull"],
    "start: false handles": ["tasks.cut_hulls:without_false_handles"],
    "start: lids": ["tasks.cut_hulls:without_lids"],
    "start: hollows": ["tasks.cut_hulls:open_hollows"],
    "start: walls": ["tasks.cut_hulls:between_walls", "tasks.cut_hulls:between_plain_walls"],
    "start: cut hulls": ["tasks.cut_hulls:visual_hull"],
    "start: a coarse soup": ["tasks.cut_hulls:seen_through"],
    "start: flat sides": ["tasks.cut_hulls:with_flat_sides", "tasks.starts:with_flat_sides"],
    "start: untangling": ["tasks.starts:untangle"],
    "steps": ["optim.stepper:Stepper.advance"],
    "guard": ["optim.trainer:Trainer._loss"],
    "edits: untangling": ["optim.strategies:untangle"],
    "edits: lids": ["tasks.reconstruct:lids()"],
    "edits: what no photo sees": ["tasks.reconstruct:unseen_vertices()"],
    "edits: the rest": ["optim.trainer:Trainer.refine"],
    "scores on the way": ["tasks.scoring:Scorer.cheap"],
    "watched photos": ["optim.watch:Watch.observe", "optim.watch:Watch.outcome"],
    "checkpoints": ["optim.drive:save_checkpoint"],
    "files of the mesh": ["model.triangle_mesh:TriangleMesh.save"],
    "scores at the end": ["tasks.scoring:Scorer.full"],
    "verdict: a hull": [
        "tasks.reconstruct:expect_photos",
        "tasks.judgement:expect_photos",
        "tasks.reconstruct:finer_shape",
    ],
    "verdict: photos": [
        "tasks.reconstruct:looked_at",
        "tasks.reconstruct:contradicted",
        "tasks.reconstruct:plain_share",
        "tasks.reconstruct:unseen_share",
        "tasks.reconstruct:cut_off",
    ],
    "verdict: the input mesh": ["tasks.reconstruct:closed_hollows"],
    "verdict: the rest": ["tasks.reconstruct:_judge"],
    "texture": ["tasks.reconstruct:_texture"],
    "report": ["report.html:write_report"],
}
"""By stage, the functions that it is spent in; with "()", what they return."""


def place_of(name: str) -> tuple[Any, str]:
    """What has a function of `STAGES` as its attribute, and the attribute's name."""
    module, path = name.removesuffix("()").split(":")
    *owners, attribute = path.split(".")
    return functools.reduce(getattr, owners, importlib.import_module(f"etsplat.{module}")), attribute


class StageClock:
    """Processor time by stage: of a function of a stage, less what functions of stages within it took."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._open: list[float] = []

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with its time counted."""

        @functools.wraps(function)
        def call(*args: Any, **known: Any) -> Any:
            self._open.append(0.0)
            begin = time.process_time()
            try:
                return function(*args, **known)
            finally:
                spent = time.process_time() - begin
                self.seconds[stage] += spent - self._open.pop()
                if self._open:
                    self._open[-1] += spent

        return call

    def install(self) -> None:
        """Puts the clock around all functions of `STAGES`."""
        for stage, names in STAGES.items():
            for name in names:
                owner, attribute = place_of(name)
                function = self.timed(stage, getattr(owner, attribute))
                setattr(owner, attribute, self._making(stage, function) if name.endswith("()") else function)

    def _making(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args: self.timed(stage, function(*args))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="as of `etsplat reconstruct`, or demo:owl")
    parser.add_argument("--out", type=Path, required=True, help="a folder for the run, in the place of an earlier one")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    set_num_threads(options.threads)
    config = etsplat.ReconstructConfig.of(options.preset)
    if options.iterations:
        config = config.changed({"iterations": options.iterations})
    clock = StageClock()
    clock.install()
    begin = time.process_time()
    result = etsplat.reconstruct(options.source, options.out, config, overwrite=True)
    importlib.import_module("etsplat.report.html").write_report(options.out)
    whole = time.process_time() - begin
    print(f"{cpu_model()}, load {load_average()}, {num_threads()} threads: {whole:.1f} s of the processor")
    print(result.verdict)
    found = {name: result.metrics.get(name) for name in ("chamfer", "chamfer_exact", "psnr", "psnr_mesh")}
    print(", ".join(f"{name} {value:.3g}" for name, value in found.items() if value is not None))
    for stage in STAGES:
        print(f"{clock.seconds[stage]:8.2f}  {stage}")
    print(f"{whole - sum(clock.seconds.values()):8.2f}  the rest")


if __name__ == "__main__":
    main()
