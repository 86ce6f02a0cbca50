"""Speed of the GPU rasterizer: event-timed on a device, with the floor of every kernel by counting.

python -m benchmarks.gpu                          every scene; writes benchmarks/results/gpu_<date>_<commit>.json
python -m benchmarks.gpu --host                   host time of a step alone: needs no GPU
python -m benchmarks.gpu --count sphere6          the counts alone, by the tests' shim: needs no GPU, minutes

Work is counted from a render's own buffers: slots ((triangle, tile) pairs), pairs of a slot and a sub-tile of 8x4
pixels in which something was drawn, bytes that each kernel must move. Floors are for the machine named in `--peaks`.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from benchmarks import gpu_reconstruct, gpu_scenes, gpu_timing, gpu_train, machine
from benchmarks.gpu_floors import PEAKS, Work, floors
from benchmarks.tables import Table

RESULTS = Path(__file__).parent / "results"


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scene", nargs="+", default=list(gpu_scenes.NAMES), help="as in benchmarks.scenes, and soup4m"
    )
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--peaks", choices=list(PEAKS), default="H100")
    parser.add_argument("--count", metavar="SCENE", help="count the work of one scene without a GPU")
    parser.add_argument("--host", action="store_true", help="time what a step costs outside of kernels, without a GPU")
    parser.add_argument("--json", type=Path, help="default: benchmarks/results/gpu_<date>_<commit>.json")
    return parser.parse_args(arguments)


def floor_table(name: str, work: Work, peaks: str, measured: dict[str, float]) -> Table:
    rows = []
    for floor in floors(work, PEAKS[peaks]):
        took = measured.get(floor.kernel)
        rows.append(
            [
                floor.kernel,
                str(floor.launches),
                f"{floor.bytes / 1e6:.1f}",
                f"{1e3 * floor.memory_ms:.1f}",
                f"{1e3 * floor.instruction_ms:.1f}",
                floor.bound,
                f"{1e3 * took:.1f}" if took else "",
                f"{100 * floor.ms / took:.0f} %" if took else "",
            ]
        )
    columns = ["kernel", "launches", "MB", "memory us", "instructions us", "bound by", "measured us", "of it the floor"]
    return Table(f"{name}: kernels of one step and their floors on {peaks}", columns, rows)


def time_table(results: dict[str, dict[str, Any]]) -> Table:
    rows = []
    for name, entry in results.items():
        for what, ms in entry["milliseconds"].items():
            rows.append([name, what, f"{ms['median']:.3f}", f"{ms['low']:.3f}-{ms['high']:.3f}"])
    return Table("Event-timed milliseconds", ["scene", "what", "median", "quartiles"], rows)


def kernel_table(preset: str, kernels: dict[str, float]) -> Table:
    rows = [[name, f"{1e3 * ms:.1f}"] for name, ms in sorted(kernels.items(), key=lambda item: -item[1])[:30]]
    return Table(f"Kernels of a training step, preset {preset}", ["kernel", "us a step"], rows)


def main(arguments: list[str] | None = None) -> None:
    options = parse(arguments)
    console = Console(width=150)
    if options.host:
        milliseconds = gpu_timing.host_milliseconds(gpu_scenes.load("sphere2", "cpu"), 20 * options.repeats)
        console.print(f"{milliseconds:.3f} ms of host time per forward and backward")
        return
    if options.count:
        work = gpu_timing.count_without_gpu(gpu_scenes.load(options.count, "cpu"))
        console.print(work)
        console.print(floor_table(options.count, work, options.peaks, {}).rich())
        return
    if not torch.cuda.is_available():
        raise SystemExit("no GPU: --count counts the work without one")
    results, tables = {}, []
    for name in options.scene:
        scene = gpu_scenes.load(name, "cuda")
        entry = gpu_timing.measure(scene, options.repeats)
        results[name] = entry
        tables.append(floor_table(name, Work(**entry["work"]), options.peaks, entry["kernels"]))
    tables.append(time_table(results))
    device = torch.device("cuda")
    reconstruct = gpu_reconstruct.step_milliseconds(device)
    train = {preset: gpu_train.step_milliseconds(device, preset) for preset in ("quick", "paper")}
    tables += [kernel_table(preset, entry["kernels"]) for preset, entry in train.items()]
    description = {**machine.description(), "gpu": torch.cuda.get_device_name(), "cuda": torch.version.cuda}
    name = f"gpu_{description['date'][:10]}_{description['commit'].rstrip('+')}.json"
    path = options.json or RESULTS / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        json.dumps(
            {"machine": description, "results": results, "reconstruct_step": reconstruct, "train_step": train}, indent=1
        )
        + "\n",
        encoding="utf-8",
    )
    for table in tables:
        console.print()
        console.print(table.rich())
    step = f"{reconstruct['milliseconds']:.3f} ms at {reconstruct['faces']:,} faces, 1024 x 1024"
    console.print(f"a whole reconstruction step: {step}", highlight=False)
    for preset, entry in train.items():
        step = f"{entry['milliseconds']:.3f} ms at {entry['triangles']:,} triangles, {entry['size']}"
        console.print(f"a whole training step, preset {preset}: {step}", highlight=False)
    console.print(f"written to {path}", highlight=False)


if __name__ == "__main__":
    main()
