"""The examples in docstrings of public names: they run as they stand, and give what stands below them."""

import doctest
import inspect
from pathlib import Path

import pytest
import torch

import etsplat
from etsplat.core.kernels import KERNELS
from etsplat.engines import choice

FINDER = doctest.DocTestFinder(recurse=False)
EXAMPLES = {
    name: found
    for name in etsplat.__all__
    for found in FINDER.find(inspect.unwrap(getattr(etsplat, name)), name, module=False, globs={})
    if found.examples
}
AFTER = {"reconstruct": ("ReconstructResult", "write_report", "texture_mesh"), "train": ("TrainResult", "export")}
"""Whose examples go on with the run that another one made."""


def test_every_public_name_has_an_example() -> None:
    """In its own docstring: that of a class is not its base's."""
    assert sorted(set(etsplat.__all__) - set(EXAMPLES)) == []


@pytest.mark.parametrize("name", [name for name in EXAMPLES if not any(name in names for names in AFTER.values())])
def test_an_example_gives_what_it_says(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an empty folder, with `torch` and `etsplat`; then those that go on with it, with its names."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(choice, "_engines", dict(choice._engines))
    names = {"torch": torch, "etsplat": etsplat}
    report: list[str] = []
    for example in (EXAMPLES[one] for one in (name, *AFTER.get(name, ()))):
        example.globs = names
        doctest.DocTestRunner(verbose=False).run(example, out=report.append, clear_globs=False)
    KERNELS.pop("smooth_step", None)  # what one of them registers is nobody else's
    assert not report, "".join(report)
