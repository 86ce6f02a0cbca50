"""Speed of the CPU rasterizer: forward + backward at 1024 x 1024 through the public API with autograd.

python -m benchmarks.rasterizer                              every scene, one thread and all
python -m benchmarks.rasterizer --scene sphere6 --instruction-set all --repeats 10

Spheres are compared with the prototype (`prototype.py`), where that is there: it is built into build/bench and
run in turn with the engine, so that both see the same moods of the machine. A turn is three timed repetitions of each.
Scenes with colours at the vertices ("sphere6-vertex") are compared with themselves under constant colours, in turn too,
and those with a kernel that is registered from Python ("sphere6-registered") with themselves under the built-in one.
What else is drawn on a narrower instruction set is compared with itself on the widest.
Counters, memory and the serial part are described in research/performance.md.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks import machine, scenes, tables
from benchmarks.measure import measure, use
from benchmarks.prototype import Prototype
from etsplat import _native

RESULTS = Path(__file__).parent / "results"


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sets = _native.available_instruction_sets()
    parser.add_argument("--threads", type=int, nargs="+", default=sorted({1, machine.cores()}), help="default: 1, all")
    parser.add_argument("--repeats", type=int, default=5, help="turns of three repetitions")
    parser.add_argument("--scene", nargs="+", default=list(scenes.NAMES), help="see benchmarks.scenes")
    parser.add_argument(
        "--instruction-set", choices=[*sets, "all"], help="default: the widest, and the others on sphere6"
    )
    parser.add_argument("--no-prototype", action="store_true", help="measure the engine alone")
    parser.add_argument("--no-memory", action="store_true", help="leave out the growth of a fresh process")
    parser.add_argument("--json", type=Path, help="default: benchmarks/results/rasterizer_<date>_<commit>.json")
    return parser.parse_args(arguments)


def plan(options: argparse.Namespace) -> list[tuple[str, list[str]]]:
    """Instruction sets, and the scenes to measure on each."""
    widest, *others = _native.available_instruction_sets()
    if options.instruction_set is None:
        few = [scene for scene in options.scene if scene.startswith("sphere6")]
        return [(widest, options.scene), *((name, few) for name in others)]
    chosen = [widest, *others] if options.instruction_set == "all" else [options.instruction_set]
    return [(name, options.scene) for name in chosen]


def run(options: argparse.Namespace, prototype: Prototype, console: Console) -> list[dict[str, Any]]:
    entries = []
    for instruction_set, names in plan(options):
        for name in names:
            scene = scenes.load(name)
            for threads in options.threads:
                use(threads, instruction_set)
                with_memory = not options.no_memory and threads == max(options.threads)
                entry = measure(scene, threads, instruction_set, options.repeats, prototype, with_memory)
                entries.append(entry)
                ratio = f", {entry['ratio']['median']:.2f} of {entry['yardstick']['name']}" if "ratio" in entry else ""
                ms = entry["milliseconds"]["median"]
                console.print(f"{name} {instruction_set} {threads} threads: {ms:.1f} ms{ratio}", highlight=False)
    return entries


def main(arguments: list[str] | None = None) -> None:
    options = parse(arguments)
    console = Console(width=150)
    prototype = Prototype(wanted=not options.no_prototype)
    if prototype.program is None:
        console.print(f"not compared with the prototype: {prototype.reason}")
    results: dict[str, Any] = {
        "machine": machine.description(),
        "command": " ".join(["python -m benchmarks.rasterizer", *(sys.argv[1:] if arguments is None else arguments)]),
        "prototype": "" if prototype.program else prototype.reason,
    }
    results["results"] = run(options, prototype, console)
    results["load_average_after"] = machine.load_average()
    for table in tables.all_tables(results):
        console.print()
        console.print(table.rich())
    name = f"rasterizer_{results['machine']['date'][:10]}_{results['machine']['commit'].rstrip('+')}.json"
    path = options.json or RESULTS / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    console.print(f"written to {path}", highlight=False)


if __name__ == "__main__":
    main()
