"""The examples in docstrings of public names: they run as they stand, and give what stands below them."""

import doctest
import inspect
from pathlib import Path

import pytest
import torch

import etsplat
from etsplat.core.kernels import KERNELS

FINDER = doctest.DocTestFinder(recurse=False)
EXAMPLES = {
    name: found
    for name in etsplat.__all__
    for found in FINDER.find(inspect.unwrap(getattr(etsplat, name)), name, module=False, globs={})
    if found.examples
}


def test_what_people_begin_with_has_an_example() -> None:
    """Those that the first pages name."""
    first = {"rasterize", "Cameras", "look_at", "intrinsics", "TriangleMesh", "photograph", "icosphere", "Adam"}
    first |= {"photometric_loss", "mesh_energies", "register_kernel", "Custom", "psnr", "ssim", "engine", "save_mesh"}
    assert first <= set(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_gives_what_it_says(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an empty folder, with `torch` and `etsplat`."""
    monkeypatch.chdir(tmp_path)
    report: list[str] = []
    example = EXAMPLES[name]
    example.globs = {"torch": torch, "etsplat": etsplat}
    failed, _ = doctest.DocTestRunner(verbose=False).run(example, out=report.append, clear_globs=True)
    KERNELS.pop("smooth_step", None)  # what one of them registers is nobody else's
    assert not failed, "".join(report)
