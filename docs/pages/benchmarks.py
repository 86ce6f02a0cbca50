"""The tables of docs/benchmarks.md and README.md, from those of research/results.md, cell by cell.

python -m docs.pages.benchmarks
"""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
PAGES = ("README.md", "docs/benchmarks.md")
_TABLE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end of table -->\n)", re.DOTALL)

Rows = Sequence[Sequence[str]]
"""Of a table: its heads, of which those that end with a colon are of numbers, then its rows."""


def value(results: str, section: str, row: Sequence[str], column: str, part: int = 0) -> str:
    """A cell as it stands in a table, bold or not.

    Args:
        results: text of research/results.md.
        section: the heading above the table.
        row: the first cells of the row, as many as tell it from others.
        column: the head of the column.
        part: which, of several numbers in a cell (a / b).

    Raises:
        LookupError: there is no such cell, or there are several.
    """
    _, found, rest = results.partition(f"\n### {section}\n")
    text = rest.partition("\n### ")[0].partition("\n## ")[0]
    cells = []
    for table in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
        heads, _, *rows = ([cell.strip() for cell in line.strip("|").split(" |")] for line in table.splitlines())
        if column in heads:
            place = heads.index(column)
            cells += [cells[place] for cells in rows if cells[: len(row)] == [*row]]
    if len(cells) != 1:
        raise LookupError(f"{section}: {len(cells) if found else 'no'} cells {' '.join(row)}, {column}")
    return cells[0].split(" / ")[part]


def tables(results: str) -> Mapping[str, Rows]:
    """Every table by its name."""
    mesh = partial(value, results, "Preset best: ten meshes at the paper's budget", ["mean"])
    peer = partial(value, results, "Gaussian peers without a GPU")
    kernel = partial(value, results, "The three kernels on six scenes", ["mean"])
    hull = value(results, "Preset best: the ten from the hull", ["mean"], "Chamfer")
    sphere, floor = mesh("Chamfer"), mesh("floor")
    bound, paper = (mesh("paper: V / ours", part) for part in (0, 1))
    elastic, gaussians = (f"{peer([name], 'PSNR')} dB, {peer([name], _SECONDS)} s" for name in ("elastic", "3dgs"))
    scenes = {name: (_beside(results, name, "ours"), _better(results, name)) for name in _CAPTURES}
    decibels = {name: [f"{number} dB" for number, _ in pair] for name, pair in scenes.items()}
    columns = ("PSNR", "SSIM", "primitives", _SECONDS)
    speed = {
        name: [_step(results, name, *of) for of in _STEPS] for name in ("etsplat", "Mitsuba 3.9.1", "PyTorch3D 0.7.9")
    }
    return {
        "measured": [
            ("measured", "etsplat:", "others:", "`python -m`"),
            (
                f"{_CHAMFER}, ten meshes of the paper",
                hull,
                f"{paper} the paper; {bound} its upper bound",
                "`studies.gallery`",
            ),
            ("fox, 80 pixels, 1,000 steps", elastic, f"{gaussians} gsplat 1.5.3 in PyTorch", "`studies.gsplat_on_cpu`"),
            *(
                (label, decibels[name][0], f"{decibels[name][1]} OpenSplat 1.1.5", "`studies.opensplat`")
                for name, label in (("banana", "banana, 200 pixels, equal seconds"), ("lund", "lund, the same"))
            ),
            (
                "forward and backward, 82,000 triangles, one thread",
                f"{speed['etsplat'][0]} ms",
                f"{speed['Mitsuba 3.9.1'][0]} ms Mitsuba 3.9.1",
                "`benchmarks.peers`",
            ),
        ],
        "objects": [
            ("method", f"{_CHAMFER}:", "whose number"),
            ("etsplat, preset best", hull, "ours, one seed"),
            ("the same from a sphere, as the paper", sphere.strip("*"), "ours, one seed"),
            ("Nvdiffrast-V, the paper's upper bound", bound, "the paper's"),
            ("elastic kernel of the paper", paper, "the paper's"),
            ("two samples of the true surface", floor, "the least that can be measured"),
        ],
        "opensplat": [
            ("capture", "etsplat: dB, seconds:", "OpenSplat 1.1.5: dB, seconds:"),
            *((name, *map(", ".join, pair)) for name, pair in scenes.items()),
        ],
        "gaussians": [
            ("method", *(f"{column.partition(',')[0]}:" for column in columns)),
            *((label, *(peer([name], column) for column in columns)) for name, label in _PEERS.items()),
        ],
        "kernels": [
            ("kernel", "PSNR:", "SSIM:"),
            *((name, kernel("PSNR", part), kernel("SSIM", part)) for part, name in enumerate(_KERNELS)),
        ],
        "speed": [
            ("renderer", *(f"{triangles} triangles, {pixels}:" for triangles, pixels in _STEPS)),
            *((name, *milliseconds) for name, milliseconds in speed.items()),
        ],
    }


_CHAMFER, _SECONDS = "Chamfer distance x 1000", "seconds, one thread"
_CAPTURES = ("banana", "family", "kitchen25", "lund")
_PEERS = {"elastic": "elastic triangles", "3dgs": "3D Gaussians", "2dgs": "2D Gaussians"}
_KERNELS = ("elastic", "bilateral", "single-sided")
_STEPS = (("81,920", "1024 x 1024"), ("5,120", "256 x 256"))


def _beside(results: str, capture: str, method: str) -> tuple[str, str]:
    """PSNR and seconds of a run beside OpenSplat, or of OpenSplat."""
    cell = partial(value, results, "OpenSplat on the CPU", [capture, method])
    return cell("PSNR"), cell("processor seconds")


def _step(results: str, renderer: str, triangles: str, pixels: str) -> str:
    """Processor milliseconds of forward and backward."""
    section = "Other differentiable renderers on the CPU"
    return value(results, section, [renderer, triangles, pixels], "processor ms")


def _better(results: str, capture: str) -> tuple[str, str]:
    """Those of the better one of OpenSplat's schedules."""
    both = [_beside(results, capture, f"OpenSplat, {which} schedule") for which in ("scaled", "its own")]
    return max(both, key=lambda numbers: float(numbers[0].strip("*")))


def filled(page: str, results: str) -> str:
    """A page with the tables that its marks name."""
    made = tables(results)
    return _TABLE.sub(lambda mark: mark[1] + _markdown(made[mark[2]]) + mark[3], page)


def _markdown(rows: Rows) -> str:
    """A table; numbers on the right."""
    rule = ["--:" if head.endswith(":") else "---" for head in rows[0]]
    lines = [[head.removesuffix(":") for head in rows[0]], rule, *rows[1:]]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    text = (ROOT / "research" / "results.md").read_text(encoding="utf-8")
    for page in (ROOT / name for name in PAGES):
        page.write_text(filled(page.read_text(encoding="utf-8"), text), encoding="utf-8")
