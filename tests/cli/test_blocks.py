"""`etsplat train --blocks`: from a folder to one run that the other commands take."""

import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.opened_runs import SoupRun
from etsplat.viewer import server
from helpers.captures import write_colmap
from helpers.commands import Run, assert_one_line_error

SHORT = ("--preset", "tiny", "--iterations", "6", "--max-triangles", "300", "--width", "32")


def test_a_folder_is_trained_in_blocks_resumed_and_taken_by_other_commands(
    tmp_path: Path, etsplat: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser")
    scene, out = tmp_path / "scene", tmp_path / "run"
    write_colmap(scene, [(32, 24)] * 10, points=200)
    train = ("train", str(scene), "--out", str(out), *SHORT, "--blocks", "2x1")
    done = etsplat(*train)
    assert done.returncode == 0, done.stderr
    assert "2 blocks of " in done.stdout
    assert "block 1_0, 2 of 2" in done.stdout
    assert (out / "blocks" / "0_0" / "metrics.json").is_file()
    assert "--blocks 2x1" in (out / "report.html").read_text(encoding="utf-8")
    before = (out / "soup.safetensors").read_bytes()
    again = etsplat(*train, "--resume")
    assert again.returncode == 0, again.stderr
    assert (out / "soup.safetensors").read_bytes() == before
    evaluated = etsplat("eval", str(out))
    assert evaluated.returncode == 0, evaluated.stderr
    exported = etsplat("export", str(out), "--out", str(tmp_path / "soup.ply"), "--min-opacity", "0.05")
    assert exported.returncode == 0, exported.stderr
    assert (tmp_path / "soup.ply").is_file()
    drawn = etsplat("render", str(out))
    assert drawn.returncode == 0, drawn.stderr
    assert len(list((out / "renders").rglob("*.png"))) == 2  # of ten photos every eighth
    seen: list[TriangleSoup] = []

    def look(run: SoupRun, host: str, port: int, width: int, announce: Callable[[int], None]) -> None:
        """In the place of serving until Ctrl-C."""
        viewer = server.Viewer(run, host, port, width)
        try:
            with urllib.request.urlopen(f"http://{host}:{viewer.port}", timeout=10) as page:
                assert b"<html" in page.read().lower()
            seen.append(run.soup)
        finally:
            viewer.close()

    monkeypatch.setattr(server, "serve", look)
    viewed = etsplat("view", str(out), "--port", "8953")
    assert viewed.returncode == 0, viewed.stderr
    assert torch.equal(seen[0].vertices, TriangleSoup.load(out / "soup.safetensors").vertices)


def test_what_is_wrong_with_blocks_is_said_in_a_line(tmp_path: Path, etsplat: Run) -> None:
    scene = tmp_path / "scene"
    write_colmap(scene, [(32, 24)] * 4, points=0)
    train = ("train", str(scene), "--out", str(tmp_path / "run"), *SHORT)
    assert_one_line_error(etsplat(*train, "--blocks", "2by1"), "blocks: is 2by1; it must be columns and rows")
    assert_one_line_error(etsplat(*train, "--blocks", "2x1"), "the capture has none; train it without --blocks")
    assert not (tmp_path / "run").exists()
