"""The examples run as they are, at their smallest, and so does the code of the documents; from public names alone."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors.torch import load_file

import etsplat

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PACKAGES = {"etsplat", "torch", "numpy", "matplotlib"}
ONE_SCREEN = 72
"""Lines."""

SMALLEST: dict[str, tuple[list[str], str]] = {
    "01_fit_one_triangle.py": (["--steps", "6"], "triangle.png"),
    "02_depth_and_normals.py": (["--size", "48"], "views.png"),
    "03_own_kernel.py": (["--preset", "tiny"], "runs/plateau/kernel.png"),
    "04_own_loss.py": (["--iterations", "4"], "symmetry.png"),
    "05_own_strategy.py": (["--iterations", "8"], "strategy.png"),
    "06_scene_and_path.py": (["--iterations", "6", "--width", "32"], "runs/scene/path.png"),
    "07_camera_refinement.py": (["--steps", "2"], "cameras.png"),
    "08_object_soup.py": (["--iterations", "6"], "soup.png"),
}
"""By example: what makes it small, and the picture that it then writes."""


def run(program: list[str], folder: Path) -> str:
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    command = [sys.executable, *program]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout


def code_of(document: str, containing: str) -> str:
    blocks = re.findall(r"^```python\n(.*?)^```$", (ROOT / document).read_text(encoding="utf-8"), re.S | re.M)
    (found,) = (block for block in blocks if containing in block)
    return found


def assert_shows_something(picture: Path) -> None:
    with Image.open(picture) as image:
        assert np.asarray(image.convert("RGB")).std() > 5


def test_every_example_is_listed() -> None:
    """A new example is run too."""
    assert [path.name for path in EXAMPLES] == sorted(SMALLEST)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_uses_public_names_alone(path: Path) -> None:
    """Nothing but the standard library, torch, numpy, matplotlib, and what `import etsplat` lists; on one screen."""
    source = path.read_text(encoding="utf-8")
    assert len(source.splitlines()) <= ONE_SCREEN
    for node in ast.walk(ast.parse(source)):
        modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for module in modules:
            assert module.split(".")[0] in PACKAGES | sys.stdlib_module_names
            assert module == "etsplat" or not module.startswith("etsplat")
        assert not (isinstance(node, ast.ImportFrom) and node.module == "etsplat")
        if isinstance(node, ast.Attribute):
            owner = node.value.id if isinstance(node.value, ast.Name) else ""
            assert owner != "etsplat" or node.attr in etsplat.__all__
            assert owner == "self" or not node.attr.startswith("_") or node.attr.endswith("__")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(path: Path, tmp_path: Path) -> None:
    """It ends well, says something, and its picture shows something."""
    options, picture = SMALLEST[path.name]
    assert run([str(path), *options], tmp_path)
    assert_shows_something(tmp_path / picture)


def test_the_loop_of_the_documents_runs(tmp_path: Path) -> None:
    """docs/library.md: twenty lines that end with a mesh and a picture that is more than the start's."""
    code = code_of("docs/library.md", "photometric_loss")
    assert float(run(["-c", code], tmp_path)) > 15  # dB
    assert_shows_something(tmp_path / "view.png")
    assert len(etsplat.load_mesh(tmp_path / "owl.glb").faces) == 1280


def test_photos_in_memory_are_a_data_set(tmp_path: Path) -> None:
    """docs/library.md: what stands there runs as it stands."""
    assert run(["-c", code_of("docs/library.md", "StoredPictures(")], tmp_path) == ""


def test_the_patience_of_the_documents_runs(tmp_path: Path) -> None:
    """docs/library.md: a run that a callback ends."""
    run(["-c", code_of("docs/library.md", "trainer.stop()\n")], tmp_path)


def test_the_trainer_of_the_documents_runs(tmp_path: Path) -> None:
    """docs/library.md: the same in fewer lines, with a term and a strategy."""
    printed = run(["-c", code_of("docs/library.md", "SubdivideAndUntangle")], tmp_path)
    assert "iterations in" in printed
    assert etsplat.TriangleMesh.load(tmp_path / "owl.glb").count > 1280


def test_state_goes_to_a_file_and_to_another_model(tmp_path: Path) -> None:
    """docs/library.md: of one's own loop; and a checkpoint has it as the page says."""
    same = "print(again.count, again.vertices.equal(mesh.vertices), adam.step_count)"
    assert run(["-c", code_of("docs/library.md", "torch.save(") + same], tmp_path).split() == ["320", "True", "1"]


def test_a_job_of_the_documents_runs_and_can_be_ended(tmp_path: Path) -> None:
    """docs/library.md: a service, whose output is bytes and a sentence."""
    code = code_of("docs/library.md", "mesh_of(")
    late = "try:\n    mesh_of(photos, seconds=0)\nexcept TooLongError as error:\n    print('ended:', error)"
    assert run(["-c", code.rpartition("glb, verdict")[0] + late], tmp_path).startswith("ended: ")
    written, verdict = run(["-c", f"{code}print(len(glb), verdict)"], tmp_path).split(maxsplit=1)
    assert int(written) > 1000
    assert verdict.startswith(("good", "poor"))


def test_the_call_of_the_readme_runs(tmp_path: Path) -> None:
    """As it stands: it leaves nothing to its readers."""
    code = code_of("README.md", "etsplat.rasterize(")
    printed = run(["-c", f"{code}\nprint(float(vertices.grad.abs().sum()))"], tmp_path)
    assert float(printed) > 0


def test_the_pieces_of_ones_own_of_the_documents_run(tmp_path: Path) -> None:
    """docs/extending.md: a kernel, on the command line too; a loss; a strategy that takes away two tenths."""
    page = "docs/extending.md"
    kernel = code_of(page, "register_kernel(")
    (tmp_path / "plateau.py").write_text(kernel)
    shorter = code_of(page, '"method"').replace('{"method"', '{"iterations": 4, "method"')
    run(["-c", kernel + shorter], tmp_path)
    (command,) = re.findall("^    etsplat (.* --kernel-file .*)$", (ROOT / page).read_text(encoding="utf-8"), re.M)
    run(["-m", "etsplat", *command.split(), "--iterations", "4", "--overwrite"], tmp_path)
    assert (tmp_path / "runs" / "plateau" / "mesh.glb").is_file()
    loss = code_of(page, "Custom(").replace("fit(100", "fit(4")
    printed = run(["-c", loss + code_of(page, "class Thin") + "print(soup.count)"], tmp_path)
    assert printed.splitlines()[-1] == "1620"
    assert run(["-c", code_of(page, "class Grow")], tmp_path).split() == ["551"]
    checkpoint = load_file(max((tmp_path / "runs" / "grown" / "checkpoints").iterdir()))
    assert (len(checkpoint["model.vertices"]), len(checkpoint["strategy.weight"])) == (551, 551)


def test_the_notebook_runs(tmp_path: Path) -> None:
    """At its smallest: a result, a curve and four views of the mesh."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(ROOT / "examples" / "owl.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs for cell in code), "it is kept without outputs"
    sizes = "RESOLUTION, ITERATIONS, FACES = 200, 2000, 10_000"
    assert sizes in code[1].source
    code[1].source = code[1].source.replace(sizes, "RESOLUTION, ITERATIONS, FACES = 32, 20, 2000")
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    assert (tmp_path / "runs" / "owl" / "mesh.glb").is_file()
    assert "PSNR" in code[1].outputs[-1]["data"]["text/html"]
    assert all("image/png" in cell.outputs[-1]["data"] for cell in code[2:])
