"""`python -m benchmarks.determinism`: the same run several times, on one thread and on two, by hashes of its results.

Each run is a process of its own. The tables have the first digits of SHA-256 of its results: equal digits, equal bytes.
Prints Markdown, and ends with status 1 where runs differ.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.machine import commit, cpu_model

RUNS = {
    "reconstruct": (
        [
            "reconstruct demo:owl --preset tiny --out run",
            "export run --texture 512 --faces 800 --lods 1 --normals",
        ],
        ("mesh.ply", "mesh.glb", "textured.glb", "textured_lod1.glb"),
    ),
    "train": (
        [
            "train demo:scene --preset tiny --asset --out run",
            "export run --format html",
            "export run --out run/seen.ply",
        ],
        ("soup.safetensors", "opaque.glb", "soup.html", "seen.ply"),
    ),
}
"""By name: commands, and the files of the folder "run" that are compared."""


def hashes(commands: list[str], files: tuple[str, ...], threads: int) -> tuple[str, ...]:
    """SHA-256 of each file after commands on so many threads."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "ETSPLAT_NUM_THREADS": str(threads)}
    with tempfile.TemporaryDirectory() as folder:
        for command in commands:
            program = [sys.executable, "-c", "from etsplat.cli import main; main()", *command.split()]
            silent = subprocess.DEVNULL
            subprocess.run(program, cwd=folder, env=environment, check=True, stdout=silent, stderr=silent)
        return tuple(hashlib.sha256((Path(folder) / "run" / name).read_bytes()).hexdigest()[:12] for name in files)


def main() -> None:
    """Runs all and prints the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=5, help="of each command on each number of threads")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--names", nargs="+", choices=RUNS, default=list(RUNS))
    options = parser.parse_args()
    differing = False
    print(f"`python -m benchmarks.determinism`, commit {commit()}, {cpu_model()}.\n")
    for name in options.names:
        commands, files = RUNS[name]
        print(*(f"`etsplat {command}`" for command in commands), sep=", ", end="\n\n")
        _row("threads", "run", *files)
        _row(*["---"] * (2 + len(files)))
        found = []
        for threads in options.threads:
            for run in range(options.runs):
                found.append(hashes(commands, files, threads))
                _row(threads, run + 1, *(f"`{digest}`" for digest in found[-1]))
        differing |= len(set(found)) > 1
        print()
    sys.exit(differing)


def _row(*cells: object) -> None:
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


if __name__ == "__main__":
    main()
