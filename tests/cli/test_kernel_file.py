"""`--method mine --kernel-file FILE`, and what a run keeps of a kernel: its table, never its code."""

import sys

import pytest
import torch

from etsplat.cli.main import main
from etsplat.core.kernels import KERNELS
from etsplat.io.kernel_files import table_of
from etsplat.io.tensors import read_tensors
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.reconstruct_config import ReconstructConfig

CODE = """
import etsplat, pathlib, torch

pathlib.Path("was_run").touch()
etsplat.register_kernel("plateau", lambda x, sigma: torch.sigmoid((1 - x) / ({width} * sigma)))
"""
OBJECT = ("demo", "object", "--preset", "tiny", "--out", "run", "--method", "plateau")
SCENE = ("demo", "scene", "--preset", "tiny", "--out", "run", "--method", "plateau", "--iterations", "20")


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    """A folder with the file, in which the command runs; what it registers is forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plateau.py").write_text(CODE.format(width=0.25))
    before = dict(KERNELS)
    yield
    forget(before)


def forget(before=None) -> None:
    """As a new process would be."""
    if before is None:
        KERNELS.pop("plateau")
    else:
        KERNELS.clear()
        KERNELS.update(before)


def etsplat(monkeypatch, capfd, *arguments) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["etsplat", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    output = capfd.readouterr()
    return int(ended.value.code or 0), " ".join((output.out + output.err).split())


@pytest.mark.parametrize("opaque_from", ["1.0", "0.5"])
def test_a_mesh_is_fitted_and_goes_on_without_the_file(monkeypatch, capfd, tmp_path, opaque_from):
    """Also from a checkpoint of the last steps, which draw the mesh opaque."""
    command = (*OBJECT, "--iterations", "30", "--drawing.opaque-from", opaque_from)
    status, said = etsplat(monkeypatch, capfd, *command, "--kernel-file", "plateau.py")
    assert status == 0, said
    (tmp_path / "was_run").unlink()
    table = table_of("plateau")
    tensors, metadata = read_tensors(tmp_path / "run" / "kernel.safetensors")
    assert metadata["name"] == "plateau"
    assert all(torch.equal(tensors[name], tensor) for name, tensor in table.to_tensors().items())
    checkpoint = max((tmp_path / "run" / "checkpoints").glob("*.safetensors"))
    assert "kernel.values" in read_tensors(checkpoint)[0]
    forget()
    status, said = etsplat(monkeypatch, capfd, *command, "--resume")
    assert status == 0, said
    assert table_of("plateau") == table
    assert not (tmp_path / "was_run").exists()
    forget()
    assert ReconstructConfig.from_file(tmp_path / "run" / "config.json").method == "plateau"
    assert table_of("plateau") == table


def test_a_soup_is_trained_and_opened_without_the_file(monkeypatch, capfd, tmp_path):
    status, said = etsplat(monkeypatch, capfd, *SCENE, "--kernel-file", "plateau.py")
    assert status == 0, said
    (tmp_path / "was_run").unlink()
    (tmp_path / "plateau.py").unlink()
    table = table_of("plateau")
    forget()
    status, said = etsplat(monkeypatch, capfd, "render", "run", "--out", "pictures")
    assert status == 0, said
    forget()
    soup = TriangleSoup.load(tmp_path / "run" / "soup.safetensors")
    assert soup.appearance.kernel == "plateau"
    assert table_of("plateau") == table
    assert not (tmp_path / "was_run").exists()


def test_another_kernel_of_the_same_name_is_refused(monkeypatch, capfd, tmp_path):
    """On resume, and where a soup is opened."""
    assert etsplat(monkeypatch, capfd, *SCENE, "--kernel-file", "plateau.py")[0] == 0
    forget()
    (tmp_path / "plateau.py").write_text(CODE.format(width=0.5))
    status, said = etsplat(monkeypatch, capfd, *SCENE, "--kernel-file", "plateau.py", "--resume")
    assert status == 2
    assert "another kernel is registered as 'plateau'" in said
    status, said = etsplat(monkeypatch, capfd, "render", "run", "--out", "pictures")
    assert status == 2
    assert "its kernel 'plateau' cannot be used (another kernel is registered" in said


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (None, "no such file"),
        ("x = 1", "registers no kernel"),
        ("1 / 0", "failed (ZeroDivisionError: division by zero)"),
        (CODE.format(width=0.0), "failed (ValueError: kernel 'plateau': "),
    ],
)
def test_files_that_cannot_be_used(monkeypatch, capfd, tmp_path, code, message):
    (tmp_path / "plateau.py").unlink()
    if code is not None:
        (tmp_path / "plateau.py").write_text(code)
    status, said = etsplat(monkeypatch, capfd, *OBJECT, "--kernel-file", "plateau.py")
    assert status == 2
    assert f"--kernel-file plateau.py: {message}" in said


def test_a_method_that_nobody_registered(monkeypatch, capfd):
    status, said = etsplat(monkeypatch, capfd, *OBJECT)
    assert status == 2
    assert "'plateau'" in said


def test_a_damaged_table_is_refused(monkeypatch, capfd, tmp_path):
    assert etsplat(monkeypatch, capfd, *OBJECT, "--iterations", "2", "--kernel-file", "plateau.py")[0] == 0
    forget()
    file = tmp_path / "run" / "kernel.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    status, said = etsplat(monkeypatch, capfd, *OBJECT, "--resume")
    assert status == 2
    assert "kernel.safetensors: is damaged" in said
