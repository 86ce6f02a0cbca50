"""The page of what the GPU's kernels are compiled to, of the times that this implies, and of those measured.

python -m benchmarks.gpu_page docs/gpu_kernels.md benchmarks/results/gpu_2026-11-27_COMMIT.json

takes what `python -m benchmarks.gpu` wrote on an H200, needs no GPU itself, and puts its tables between the lines
`<!-- results -->` and `<!-- end of results -->`. It needs what benchmarks.gpu_code needs.
"""

import argparse
import json
from pathlib import Path

from benchmarks import machine
from benchmarks.gpu_code import Kernel, kernels, label
from benchmarks.gpu_floors import PEAKS, Work, floors
from benchmarks.gpu_programs import PROGRAMS
from benchmarks.tables import BEGIN, END, Table
from etsplat.engines.cuda.compile import import_nvrtc, nvrtc_version

DEVICES = {"H200": "sm_90", "RTX 4090": "sm_89"}
MEASURED = "H200"
# By `python -m benchmarks.gpu --count`, minutes by the shim; what is visible of the soup to 0.2 %, from its bytes.
WORK = {
    "sphere6": Work(81_920, 81_920, 40_962, 184_873, 171_851, 389_227, 1024 * 1024, 64 * 64, 3),
    "soup4m": Work(4_000_000, 3_684_000, 0, 6_085_017, 2_633_325, 4_641_906, 1237 * 822, 78 * 52, 3),
}


def code_table() -> Table:
    """Every kernel on every device."""
    rows = []
    for program in PROGRAMS:
        found = [kernels(program, architecture) for architecture in DEVICES.values()]
        for of_devices in zip(*found, strict=True):
            rows.append(
                [label(program), of_devices[0].name, *(cell for kernel in of_devices for cell in _cells(kernel))]
            )
    names = ("registers", "KiB shared", "occupancy", "instructions", "a pair")
    columns = [f"{name}, {device}" for device in DEVICES for name in names]
    return Table("What each kernel is compiled to", ["program", "kernel", *columns], rows)


def _cells(kernel: Kernel) -> list[str]:
    assert kernel.local == 0, f"{kernel.name} uses local memory"
    shared, pair = f"{kernel.shared / 1024:.1f}", str(kernel.pair or "")
    return [str(kernel.registers), shared, f"{100 * kernel.occupancy:.0f} %", str(kernel.instructions), pair]


def time_table(scene: str, measured: dict[str, float]) -> Table:
    """The least time of each kernel of forward and backward on every device, beside the milliseconds that it took."""
    rows, totals = [], dict.fromkeys(DEVICES, 0.0)
    for of_devices in zip(*(floors(WORK[scene], PEAKS[device]) for device in DEVICES), strict=True):
        first = of_devices[0]
        cells = [first.kernel, str(first.launches), f"{first.bytes / 1e6:.1f}"]
        for device, floor in zip(DEVICES, of_devices, strict=True):
            totals[device] += floor.ms
            cells += [f"{1e3 * floor.memory_ms:.1f}", f"{1e3 * floor.instruction_ms:.1f}"]
        took = measured.get(first.kernel)
        rows.append([*cells, f"{1e3 * took:.1f}" if took else ""])
    least = [cell for ms in totals.values() for cell in ("", f"{1e3 * ms:.0f}")]
    rows.append(["the larger of both, in all", "", "", *least, f"{1e3 * sum(measured.values()):.0f}, with torch's"])
    columns = [f"{what}, us, {device}" for device in DEVICES for what in ("memory", "instructions")]
    names = ["kernel", "launches", "MB", *columns, f"measured, us, {MEASURED}"]
    return Table(f"{scene}: the least times of forward and backward", names, rows)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("results", type=Path, help="of `python -m benchmarks.gpu`")
    options = parser.parse_args(arguments)
    page, results = options.page, json.loads(options.results.read_text(encoding="utf-8"))
    on, took = results["machine"], {name: entry["kernels"] for name, entry in results["results"].items()}
    if MEASURED not in on["gpu"]:
        raise SystemExit(f"{options.results} is of an {on['gpu']}: the page has a column for an {MEASURED}")
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    about = machine.description()
    version = ".".join(map(str, nvrtc_version(import_nvrtc())))
    command = f"`python -m benchmarks.gpu_page {page} {options.results}`"
    head = f"{command}, {about['date'][:10]}, commit {about['commit']}, NVRTC {version}. Measured: {on['gpu']},"
    head += f" {on['date'][:10]}, torch {on['torch']}, commit {on['commit']}."
    tables = "\n".join(
        table.markdown() for table in (code_table(), *(time_table(scene, took[scene]) for scene in WORK))
    )
    page.write_text(f"{before}{BEGIN}\n{head}\n\n{tables}{END}{rest.partition(END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    main()
