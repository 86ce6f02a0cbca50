"""Finds what differs between the results of two runs: tensors, files, pixels and numbers, bit for bit."""

import json
import math
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from safetensors.numpy import load_file

from .names import CLOCKS, FILES, HISTORY, METRICS, TENSORS, Names

Differences = list[str]
"""One text each: what differs, and by how much. Empty if every bit is the same."""


def compare_runs(base: Path, here: Path) -> dict[str, Differences]:
    """All that differs between two finished runs, under "parameters", "images" and "history"."""
    return {
        "parameters": [*_results(base, here), *_last_checkpoints(base, here)],
        "images": [*_images(base, here)],
        "history": [
            *numbers(
                _json_lines(base / "history.jsonl"), _json_lines(here / "history.jsonl"), HISTORY, "history.jsonl"
            ),
            *numbers(_json(base / "metrics.json"), _json(here / "metrics.json"), METRICS, "metrics.json"),
        ],
    }


def tensors(base: Mapping[str, np.ndarray], here: Mapping[str, np.ndarray], where: str) -> Iterator[str]:
    """What differs between two sets of tensors, by name."""
    pairs, unmatched = matched(base, here, TENSORS, where)
    yield from unmatched
    for name, first, second in pairs:
        if difference := array_difference(_without_clock(name, first), _without_clock(name, second)):
            yield f"{where}: {name}: {difference}"


def numbers(base: Any, here: Any, names: Names, where: str) -> Iterator[str]:
    """What differs between two values of JSON; keys are names, floats are compared by their bits."""
    if isinstance(base, dict) and isinstance(here, dict):
        pairs, unmatched = matched(base, here, names, where)
        yield from unmatched
        for name, first, second in pairs:
            if name not in names.rounded or not math.isclose(first, second, rel_tol=1e-12):
                yield from numbers(first, second, names, f"{where}: {name}")
    elif isinstance(base, list) and isinstance(here, list):
        if len(base) != len(here):
            yield f"{where}: {len(base)} entries in BASE, {len(here)} here"
        for index, (first, second) in enumerate(zip(base, here, strict=False)):
            yield from numbers(first, second, names, f"{where}[{index}]")
    elif isinstance(base, float) and isinstance(here, float):
        if struct.pack("<d", base) != struct.pack("<d", here):
            yield f"{where}: {base!r} in BASE, {here!r} here"
    elif type(base) is not type(here) or base != here:
        yield f"{where}: {base!r} in BASE, {here!r} here"


def array_difference(base: np.ndarray, here: np.ndarray) -> str | None:
    """How two arrays differ, in words; None if every bit is the same. Zeros of two signs differ, equal NaN do not."""
    if base.dtype != here.dtype or base.shape != here.shape:
        return f"{base.dtype}{list(base.shape)} in BASE, {here.dtype}{list(here.shape)} here"
    width = base.dtype.itemsize
    bits = [np.ascontiguousarray(array).reshape(-1).view(np.uint8).reshape(-1, width) for array in (base, here)]
    differing = np.flatnonzero((bits[0] != bits[1]).any(axis=1))
    if not len(differing):
        return None
    place = [int(i) for i in np.unravel_index(differing[0], base.shape)] if base.ndim else []
    first, second = base.reshape(-1)[differing], here.reshape(-1)[differing]
    gap = np.abs(first.astype(np.float64) - second.astype(np.float64)).max()
    return (
        f"{len(differing)} of {base.size} differ, by {gap:.3g} at most; first {place}: "
        f"{first[0]!s} in BASE, {second[0]!s} here"
    )


def _results(base: Path, here: Path) -> Iterator[str]:
    """Of the files that a run is made for."""
    for kind in ("mesh.ply", "mesh.obj", "mesh.glb", "soup.safetensors"):
        first, second = base / kind, here / FILES.here(kind)
        if first.exists() != second.exists():
            yield f"{kind}: only {'in BASE' if first.exists() else 'here'}"
        elif first.exists() and kind.endswith(".safetensors"):
            yield from tensors(load_file(first), load_file(second), kind)
        elif first.exists():
            contents = [np.frombuffer(path.read_bytes(), np.uint8) for path in (first, second)]
            if difference := array_difference(*contents):
                yield f"{kind}: bytes: {difference}"


def _last_checkpoints(base: Path, here: Path) -> Iterator[str]:
    first, second = last_checkpoint(base), last_checkpoint(here)
    if first.name != second.name:
        yield f"last checkpoint: {first.name} in BASE, {second.name} here"
    yield from tensors(load_file(first), load_file(second), first.name)


def last_checkpoint(run: Path) -> Path:
    """The newest checkpoint of a run, which has one."""
    return max((run / "checkpoints").glob("step_*.safetensors"))


def _images(base: Path, here: Path) -> Iterator[str]:
    files = [{f"test/{path.name}": path for path in (run / "test").glob("*.png")} for run in (base, here)]
    if not files[0]:
        yield "test/: no images in BASE"
    pairs, unmatched = matched(files[0], files[1], FILES, "images")
    yield from unmatched
    for name, first, second in pairs:
        if difference := array_difference(_pixels(first), _pixels(second)):
            yield f"{name}: pixels: {difference}"


def _pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def matched(
    base: Mapping[str, Any], here: Mapping[str, Any], names: Names, where: str
) -> tuple[list[tuple[str, Any, Any]], Differences]:
    """(name here, value in BASE, value here) of all that both have, and a text for each that one of them lacks."""
    known = {names.here(name): (name, value) for name, value in base.items() if name not in names.ignored | names.gone}
    pairs = [(name, value, here[name]) for name, (_, value) in known.items() if name in here]
    lacking = [f"{where}: {old}: not here as {name}" for name, (old, _) in known.items() if name not in here]
    new = [name for name in here if name not in known and name not in names.ignored | names.added]
    return pairs, [*lacking, *(f"{where}: {name}: not in BASE" for name in new)]


def _without_clock(name: str, tensor: np.ndarray) -> np.ndarray:
    return np.delete(tensor, CLOCKS[name]) if name in CLOCKS else tensor


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _json_lines(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
