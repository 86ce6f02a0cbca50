"""Tables of a result file of benchmarks.rasterizer on the screen, or the first of them in a document.

python -m benchmarks.tables benchmarks/results/FILE.json --into docs/performance.md

puts the times between the lines `<!-- results -->` and `<!-- end of results -->`.
"""

import argparse
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table as RichTable

BEGIN, END = "<!-- results -->", "<!-- end of results -->"


@dataclass
class Table:
    """Cells as text; the first column is a name, the others are numbers."""

    title: str
    columns: list[str]
    rows: list[list[str]]

    def markdown(self) -> str:
        """For a document."""
        right = ["---" if i == 0 else "--:" for i in range(len(self.columns))]
        lines = [self.columns, right, *self.rows]
        return f"{self.title}\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"

    def rich(self) -> RichTable:
        """For a terminal."""
        table = RichTable(title=self.title, title_justify="left")
        for i, column in enumerate(self.columns):
            table.add_column(column, justify="left" if i == 0 else "right")
        for row in self.rows:
            table.add_row(*row)
        return table


def label(entry: dict[str, Any]) -> list[str]:
    return [entry["scene"], entry["instruction_set"], str(entry["threads"])]


def times(entries: list[dict[str, Any]]) -> Table:
    rows = []
    for e in entries:
        ms, ratio = e["milliseconds"], e.get("ratio")
        rows.append(
            [
                *label(e),
                f"{ms['median']:.1f}",
                f"{ms['low']:.1f}-{ms['high']:.1f}",
                f"{ms['best']:.1f}",
                f"{e['processor']['median']:.1f}" if "processor" in e else "",
                e["yardstick"]["name"] if ratio else "",
                f"{e['yardstick']['median']:.1f}" if ratio else "",
                f"{ratio['median']:.2f}" if ratio else "",
                f"{ratio['low']:.2f}-{ratio['high']:.2f}" if ratio else "",
            ]
        )
    columns = ["scene", "instructions", "threads", "ms", "quartiles", "best", "processor", "in turn with", "its ms"]
    columns += ["ratio", "of each turn"]
    return Table("Forward + backward through the public API, and what ran in turn with it", columns, rows)


def stages(entries: list[dict[str, Any]]) -> Table:
    rows = []
    for e in entries:
        rows.append(
            [
                *label(e),
                *(f"{e['stages'][name]['median']:.2f}" for name in e["stages"]),
                f"{e['outside_stages']:.2f}",
                f"{100 * e['serial']['stages']:.1f} %",
                f"{100 * e['serial']['all']:.1f} %",
            ]
        )
    columns = ["scene", "instructions", "threads", *(entries[0]["stages"] if entries else [])]
    columns += ["around them", "serial in stages", "serial in all"]
    return Table("Milliseconds of each stage, and the serial part of the whole time", columns, rows)


def work(entries: list[dict[str, Any]]) -> Table:
    rows = []
    for e in entries:
        use, share, kernel = e["lane_utilisation"], e["kernel_share"], e["kernel_nanoseconds"]
        memory = e.get("memory", {})
        rows.append(
            [
                *label(e),
                f"{e['counts']['useful'] / 1e6:.2f}",
                f"{e['nanoseconds_per_useful_pair']:.2f}",
                f"{100 * use['forward']:.0f} / {100 * use['backward']:.0f} %",
                f"{kernel['value']:.1f} / {kernel['gradient']:.1f}",
                f"{100 * share['forward']:.0f} / {100 * share['backward']:.0f} %",
                *(f"{memory[key]:.0f}" if memory.get(key) else "" for key in ("held_mib", "grown_mib")),
            ]
        )
    columns = ["scene", "instructions", "threads", "10^6 useful pairs", "ns per useful pair", "lanes used"]
    columns += ["tight loop, ns per vector", "of its peak", "MiB held", "MiB grown"]
    return Table("Work (two numbers: forward / backward)", columns, rows)


def scaling(entries: list[dict[str, Any]]) -> Table:
    """Of the runs on the first instruction set with the most threads; growth against the row above."""
    if not entries:
        return Table("", [], [])
    first = entries[0]["instruction_set"]
    threads = max(e["threads"] for e in entries)
    chosen = [e for e in entries if e["instruction_set"] == first and e["threads"] == threads]
    rows = []
    for before, e in zip([None, *chosen], chosen, strict=False):
        counts, ms = e["counts"], e["milliseconds"]["median"]
        vectors = counts["forward_vectors"] + counts["backward_vectors"]
        growth = ["", "", ""]
        if before is not None and _family(before["scene"]) == _family(e["scene"]):
            old = before["counts"]
            growth = [
                f"{e['triangles'] / before['triangles']:.2f}",
                f"{counts['pairs'] / old['pairs']:.2f}",
                f"{ms / before['milliseconds']['median']:.2f}",
            ]
        rows.append(
            [
                e["scene"],
                f"{e['triangles']:,}",
                f"{counts['pairs']:,}",
                f"{vectors:,}",
                f"{ms:.1f}",
                f"{1e6 * ms / e['triangles']:.0f}",
                f"{1e6 * ms / counts['pairs']:.1f}",
                f"{1e6 * ms / vectors:.2f}",
                " / ".join(growth) if growth[0] else "",
            ]
        )
    columns = ["scene", "triangles", "(triangle, tile) pairs", "vectors", "ms", "ns per triangle", "ns per pair"]
    columns += ["ns per vector", "growth of triangles / pairs / time"]
    return Table(f"Time against work, {first}, {threads} threads", columns, rows)


def _family(scene: str) -> str:
    """The name without numbers."""
    return re.sub(r"\d", "", scene)


def all_tables(results: dict[str, Any]) -> list[Table]:
    entries = results["results"]
    return [table(entries) for table in (times, stages, work, scaling)]


def markdown(results: dict[str, Any], source: str) -> str:
    """The times, and where they come from."""
    m = results["machine"]
    head = (
        f"`{results['command']}`, {m['date'][:10]}, commit {m['commit']}, {m['cpu']}, {m['cores']} cores, "
        f"load {m['load_average']} before, {results['load_average_after']} after, torch {m['torch']}; `{source}`.\n"
    )
    return f"{head}\n{times(results['results']).markdown()}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--into", type=Path, help="document whose results are replaced")
    options = parser.parse_args()
    results = json.loads(options.file.read_text(encoding="utf-8"))
    if options.into is None:
        for table in all_tables(results):
            Console(width=150).print(table.rich())
        return
    text = options.into.read_text(encoding="utf-8")
    if BEGIN not in text or END not in text:
        raise SystemExit(f"{options.into}: no lines {BEGIN} and {END} to put the results between")
    before, rest = text.split(BEGIN, 1)
    after = rest.split(END, 1)[1]
    body = markdown(results, options.file.name)
    options.into.write_text(f"{before}{BEGIN}\n{body}{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
