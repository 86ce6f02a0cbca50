"""Runs in a notebook: a line says how they go, and their results are pictures."""

import base64
import io
import re
from pathlib import Path

import numpy as np
from PIL import Image

from etsplat.tasks.notebook import notebook_callbacks, result_html

CELLS = (
    "import etsplat",
    """settings = {"resolution": 32, "iterations": 20, "output.log_every": 5, "output.chamfer_samples": 500}
etsplat.reconstruct("demo:owl", "owl", etsplat.ReconstructConfig.tiny().changed(settings))""",
    """settings = {"width": 32, "iterations": 20, "output.log_every": 5}
result = etsplat.train("demo:scene", "scene", etsplat.TrainConfig.tiny().changed(settings))
result""",
    """seen = []
again = etsplat.train("demo:scene", "scene", etsplat.TrainConfig.tiny().changed(settings), callbacks=[seen.append],
                      overwrite=True)
len(seen) > 4""",
)


def test_a_notebook_shows_progress_and_results(tmp_path: Path) -> None:
    """One line for each run, which ends with its length; then test views and the main numbers. Own callbacks alone."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    client = NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}})
    client.execute()
    for cell, counted in ((notebook.cells[1], "faces"), (notebook.cells[2], "triangles")):
        line, result = (output["data"] for output in cell.outputs if output["output_type"] != "stream")
        assert re.fullmatch(r"20 iterations in [\d.]+ s", line["text/plain"])
        assert re.search(rf"PSNR [\d.]+ dB .*{counted} [\d,]+ ", result["text/html"])
        (encoded,) = re.findall(r'src="data:image/png;base64,([^"]+)"', result["text/html"])
        with Image.open(io.BytesIO(base64.b64decode(encoded))) as picture:
            assert np.asarray(picture).std() > 5
    (answer,) = notebook.cells[3].outputs
    assert answer["data"]["text/plain"] == "True"


def test_nothing_is_shown_elsewhere() -> None:
    """There is no cell to write under."""
    assert notebook_callbacks() == []


def test_a_result_without_pictures_has_its_numbers(tmp_path: Path) -> None:
    """No test views, or a folder that has gone; what was not measured is left out, and nothing is taken for markup."""
    html = result_html(tmp_path / "<b>", {"psnr": None, "faces": 1280, "seconds": 1.25}, "mesh")
    assert html == f"<p>faces 1,280 · time 1.2 s<br><code>{tmp_path}/&lt;b&gt;</code></p>"
