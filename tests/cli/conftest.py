"""The `etsplat` command in this process, since another one costs seconds."""

import subprocess
import sys
from pathlib import Path
from typing import cast

import pytest

from etsplat.cli.main import main
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import save_mesh
from tests.helpers.commands import Result, Run


@pytest.fixture
def etsplat(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Runs the command with the given arguments, in a folder if there is one; errors that are not handled raise."""

    def run(*arguments: str, cwd: Path | None = None) -> Result:
        capfd.readouterr()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["etsplat", *arguments])
            if cwd is not None:
                patch.chdir(cwd)
            with pytest.raises(SystemExit) as ended:
                main()
        output = capfd.readouterr()
        return subprocess.CompletedProcess(arguments, cast(int, ended.value.code), output.out, output.err)

    return run


@pytest.fixture
def sphere(tmp_path: Path) -> Path:
    """A small mesh file."""
    vertices, faces = icosphere(2)
    save_mesh(tmp_path / "sphere.ply", vertices, faces)
    return tmp_path / "sphere.ply"
