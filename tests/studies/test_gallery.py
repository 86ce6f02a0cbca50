"""The gallery: its page says what the runs came to, the worst first, in one file, and nothing is done twice."""

import base64
import io
import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.photograph import FIELD_OF_VIEW, photograph
from etsplat.geometry.icosphere import icosphere
from etsplat.io.images import to_8_bit
from etsplat.io.mesh_files import MeshFile, load_mesh, save_mesh
from etsplat.io.run_directory import RunDirectory
from etsplat.metrics.geometry import geometry_metrics
from studies.gallery import Gallery
from studies.objects.quality import HULL, Row, summarize, worst_first
from studies.objects.subjects import find_subjects

SIZE = 48
SETTINGS = f"iterations=20,resolution={SIZE},max_faces=1000,start.shape=auto,output.chamfer_samples=2000"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of meshes with a ball, and a capture of an egg, whose surface is beside the inputs, in its world."""
    folder = tmp_path_factory.mktemp("inputs")
    vertices, faces = icosphere(2)
    (folder / "meshes").mkdir()
    save_mesh(folder / "meshes" / "ball.ply", 3 * vertices, faces)
    egg = vertices * torch.tensor([0.7, 1.0, 0.6])
    scale, place = 2.0, torch.tensor([5.0, -3.0, 1.0])
    write_capture(folder / "captures" / "egg", MeshFile(egg, faces), scale, place)
    save_mesh(folder / "egg.obj", scale * egg + place, faces)
    return folder


def write_capture(folder: Path, mesh: MeshFile, scale: float, place: torch.Tensor) -> None:
    """A mesh of the unit frame as a Blender scene: its pictures, and cameras in a world of another scale and place."""
    views = photograph(mesh, SIZE, SIZE, supersampling=2)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
    for name, chosen in (("train", views.train), ("test", views.test)):
        (folder / name).mkdir(parents=True)
        frames = []
        for index in chosen:
            pose = views.viewmats[index].inverse() @ flip
            pose[:3, 3] = scale * pose[:3, 3] + place
            alpha = views.images[index][..., 3:].float()
            color = views.images[index][..., :3].float() / alpha.clamp_min(1e-6)
            pixels = to_8_bit(torch.cat([color, alpha], dim=-1)).numpy()
            Image.fromarray(pixels).save(folder / name / f"{index}.png")
            frames.append({"file_path": f"./{name}/{index}", "transform_matrix": pose.tolist()})
        document = {"camera_angle_x": math.radians(FIELD_OF_VIEW), "frames": frames}
        (folder / f"transforms_{name}.json").write_text(json.dumps(document))


@pytest.fixture(scope="module")
def made(inputs: Path) -> Path:
    """The gallery of both, before the egg's surface is known."""
    return make(inputs)


def make(inputs: Path) -> Path:
    """Runs the command."""
    sources = [str(inputs / "meshes"), str(inputs / "captures")]
    options = ["--inputs", *sources, "--out", str(inputs / "out"), "--preset", "tiny", "--set", SETTINGS, "--jobs", "1"]
    assert Gallery.parse(options).run(options) == 0
    return inputs / "out"


def rows_of(out: Path) -> dict[tuple[str, str], dict]:
    """Those of results.json, by object and variant."""
    rows = json.loads((out / "results.json").read_text())["rows"]
    return {(row["object"], row["variant"]): row for row in rows}


def test_the_page_has_the_numbers_of_the_runs(made: Path) -> None:
    """Of each run: those of its metrics.json, in JSON as they are, in Markdown and on the page rounded."""
    page, markdown, rows = (made / "gallery.html").read_text(), (made / "results.md").read_text(), rows_of(made)
    assert list(rows) == [("ball", "default"), ("ball", HULL), ("egg", "default"), ("egg", HULL)]
    for name in ("ball", "egg"):
        metrics, row = RunDirectory(made / "runs" / name / "default").read_metrics(), rows[name, "default"]
        assert {key: row[key] for key in ("chamfer", "silhouette_iou", "psnr_mesh", "seconds")} == {
            key: metrics[key] for key in ("chamfer", "silhouette_iou", "psnr_mesh", "seconds")
        }
        assert row["verdict"] == metrics["judgement"]["verdict"]
        for text in (f"{metrics['psnr_mesh']:.2f}", f"{metrics['silhouette_iou']:.4f}"):
            assert f"<td>{text}</td>" in page
            assert f"| {text} |" in markdown
    chamfer = RunDirectory(made / "runs" / "ball" / "default").read_metrics()["chamfer"]
    assert f"<td>{1e3 * chamfer:.3f}</td>" in page
    assert (rows["ball", "default"]["true_parts"], rows["ball", "default"]["true_holes"]) == (1, 0)
    assert rows["ball", "default"]["right"] is True


def test_the_page_needs_nothing_else(made: Path) -> None:
    """Its pictures are in it, whole, and differ; it names no other file and no address."""
    page = (made / "gallery.html").read_text()
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(sources) == 2 * 4  # truth or photo, in light, normals, hull
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert len(set(sources)) == len(sources)
    for source in sources:
        Image.open(io.BytesIO(base64.b64decode(source.partition(",")[2]))).load()
    assert not re.search(r"https?:|url\(|@import|<script|<link", page)
    assert page.index("<h3>ball</h3>") < page.index("<h3>egg</h3>")


def test_without_a_known_surface_there_is_a_row(made: Path) -> None:
    """It has no Chamfer distance and no true parts; its picture of the truth is a photo."""
    row = rows_of(made)["egg", "default"]
    assert [row[key] for key in ("chamfer", "chamfer_exact", "true_parts", "right")] == [None] * 4
    assert row["silhouette_iou"] > 0.5
    assert 'alt="a test photo"' in (made / "gallery.html").read_text()


def test_a_surface_beside_the_photos_is_measured_against_and_nothing_runs_again(inputs: Path, made: Path) -> None:
    """The second time files of runs and hulls stay; the egg has the distances of its meshes in the capture's world."""
    kept = [*made.glob("runs/*/*/metrics.json"), *made.glob("hulls/*/hull.json")]
    times = [path.stat().st_mtime_ns for path in kept]
    assert len(kept) == 4
    surface = inputs / "captures" / "egg" / "mesh.obj"
    shutil.copy(inputs / "egg.obj", surface)
    try:
        rows = rows_of(make(inputs))
    finally:
        surface.unlink()
    assert [path.stat().st_mtime_ns for path in kept] == times
    truth, found = load_mesh(inputs / "egg.obj"), load_mesh(rows["egg", "default"]["mesh"])
    expected = geometry_metrics(found.vertices, found.faces, truth.vertices, truth.faces, samples=2000)
    assert rows["egg", "default"]["chamfer"] == expected.chamfer
    assert rows["egg", "default"]["chamfer_exact"] == expected.chamfer_exact
    assert rows["egg", HULL]["chamfer_exact"] < 5e-3  # so it lies where the surface is
    assert rows["egg", HULL]["silhouette_iou"] > 0.9
    assert rows["egg", HULL]["right"] is True


ROW = Row("a", "x", 0, "mesh.ply", 1e-3, 1e-3, 0.9, 30.0, 0.5, 1, 0, 1, 0, True, 10.0, "good on test views")


def test_objects_are_sorted_and_summed_up_by_their_worst() -> None:
    """The largest Chamfer distance of any seed decides, then the lowest IoU; the hull decides nothing."""
    rows = [
        ROW,
        replace(ROW, seed=1, chamfer=5e-3, silhouette_iou=0.8, right=False, verdict="poor: holes"),
        replace(ROW, object="b", chamfer=4e-3),
        replace(ROW, object="c", chamfer=None, silhouette_iou=0.7, right=None),
        replace(ROW, object="d", chamfer=None, silhouette_iou=0.6, right=None),
        replace(ROW, object="b", variant=HULL, seed=None, chamfer=9e-3, psnr_mesh=None, verdict=None),
    ]
    assert worst_first(rows) == ["a", "b", "d", "c"]
    ours, hull = summarize(rows)
    chamfer, iou = ours.amounts["chamfer"], ours.amounts["silhouette_iou"]
    assert chamfer is not None
    assert iou is not None
    assert (chamfer.mean, chamfer.worst, chamfer.object) == (pytest.approx(3.5), pytest.approx(5), "a")
    assert chamfer.spread == pytest.approx(math.sqrt(8))
    assert (iou.worst, iou.object) == (0.6, "d")
    assert (ours.right, ours.compared, ours.good, ours.judged) == (2, 3, 4, 5)
    assert (hull.amounts["psnr_mesh"], hull.judged) == (None, 0)


def test_inputs_are_captures_or_meshes(inputs: Path, tmp_path: Path) -> None:
    """A capture itself may be named; names that do not fit are told."""
    egg = inputs / "captures" / "egg"
    subjects = find_subjects([inputs / "meshes", egg], ["egg", "ball"])
    assert [(subject.name, subject.source.name) for subject in subjects] == [("egg", "egg"), ("ball", "ball.ply")]
    with pytest.raises(InputError, match=r"egg and .*egg have the same name"):
        find_subjects([egg, inputs / "captures"], [])
    with pytest.raises(InputError, match="none is named cup; there are ball"):
        find_subjects([inputs / "meshes"], ["cup"])
    with pytest.raises(InputError, match=r"inputs .*nowhere: no such folder"):
        find_subjects([tmp_path / "nowhere"], [])
