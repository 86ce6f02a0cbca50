"""The numbers that the benchmarks report mean what they say."""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import etsplat
from benchmarks import (
    contention,
    determinism,
    floaters,
    gpu,
    gpu_floors,
    gpu_forms,
    gpu_peer,
    gpu_reconstruct,
    gpu_scenes,
    gpu_timing,
    gpu_train,
    measure,
    opaque_errors,
    opaque_mesh,
    peers,
    rasterizer,
    reconstruct_stages,
    scenes,
    tables,
    workers,
)
from benchmarks.measure import native_state
from benchmarks.prototype import Prototype
from etsplat import _native, rasterize
from etsplat.core.cameras import Cameras
from etsplat.data.demo_scene import demo_scene
from etsplat.data.photos import Photo
from etsplat.engines.cuda.program import Program
from etsplat.engines.reference.rasterize import to_screen
from etsplat.engines.threads import one_torch_thread
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.tasks.train_config import TrainConfig
from helpers.captures import small_demo_scene
from helpers.scenes import mesh


def render(scene):
    return rasterize(**{**scene, "vertices": scene["vertices"].requires_grad_()})


@pytest.mark.sanitize
def test_useful_pairs_are_the_pixels_in_which_triangles_are_drawn(rng):
    """One triangle: the pixels with alpha; its copy behind it draws in the same ones; vectors hold 16 pixels."""
    triangle = torch.tensor([[[-0.5, -0.4, 3.0], [0.6, -0.3, 3.0], [0.1, 0.7, 3.0]]])
    camera = torch.eye(4)[None], torch.tensor([[[60.0, 0, 40.0], [0, 60.0, 30.0], [0, 0, 1]]])
    drawn = []
    for copies in (1, 2):
        vertices = triangle.repeat(copies, 1, 1).requires_grad_()
        out = rasterize(
            vertices,
            face_colors=torch.ones(copies, 3),
            opacities=torch.full((copies,), 0.5),
            sigma=torch.tensor(0.5),
            cameras=Cameras(*camera, 83, 61),
        )
        counts = _native.count_tiles(state=native_state(out))
        assert counts.backward_vectors <= counts.forward_vectors
        assert counts.drawn <= 16 * counts.backward_vectors
        assert counts.pairs == native_state(out).num_pairs
        assert copies * int((out.alpha > 0).sum()) == counts.drawn
        drawn.append(counts.drawn)
    assert drawn[1] == 2 * drawn[0] > 0


@pytest.mark.sanitize
@pytest.mark.parametrize("options", [{}, {"outputs": ("depth", "median_depth", "distortion")}])
def test_counting_changes_nothing(options, rng):
    out = render({**mesh(rng), **options})
    before = out.alpha.clone()
    state = out.alpha.grad_fn.constants[0].states[0]
    counts = [_native.count_tiles(state=state) for _ in range(2)]
    assert counts[0].drawn == counts[1].drawn > 0
    assert torch.equal(out.alpha, before)


def test_stages_add_up_and_their_parallel_part_is_no_larger(rng):
    out = render(mesh(rng))
    out.color.sum().backward()
    for wall, parallel in native_state(out).stage_seconds.values():
        assert 0 <= parallel <= wall < 60


@pytest.mark.parametrize("instruction_set", _native.available_instruction_sets())
def test_a_tight_loop_takes_time_and_derivatives_more(instruction_set):
    before = _native.instruction_set()
    try:
        _native.set_instruction_set(instruction_set)
        times = _native.time_kernel(kernel=2, sigma=0.5)
    finally:
        _native.set_instruction_set(before)
    assert 0.1 < times.value < 1e4
    assert 0.1 < times.gradient < 1e4


def test_the_benchmark_writes_its_results_and_the_document_takes_them(tmp_path, monkeypatch):
    """A tiny scene from the command line to the table in a document."""
    before = _native.num_threads(), torch.get_num_threads()
    result, document = tmp_path / "result.json", tmp_path / "document.md"
    options = ["--scene", "soup100", "--threads", "1", "--repeats", "1", "--no-prototype", "--no-memory"]
    try:
        rasterizer.main([*options, "--json", str(result)])
    finally:
        _native.set_num_threads(before[0])
        torch.set_num_threads(before[1])
    entry = json.loads(result.read_text())["results"][0]
    assert entry["triangles"] == 100
    assert entry["counts"]["useful"] > 0
    assert entry["nanoseconds_per_useful_pair"] > 0
    assert 0 < entry["processor"]["median"] <= 1.1 * entry["milliseconds"]["high"]
    document.write_text(f"before\n{tables.BEGIN}\nold\n{tables.END}\nafter\n")
    monkeypatch.setattr("sys.argv", ["tables", str(result), "--into", str(document)])
    tables.main()
    text = document.read_text()
    assert "soup100" in text
    assert "old" not in text
    assert text.startswith("before\n")
    assert text.endswith("after\n")


def test_work_of_the_gpu_engine_is_counted_by_the_shim():
    """The slots of a small scene are the pairs that the CPU engine makes of it, and every floor is positive."""
    scene = gpu_scenes.load("sphere1", "cpu")
    work = gpu_timing.count_without_gpu(scene)
    state = native_state(scenes.load("sphere1").render())
    assert work.slots == state.num_pairs
    assert work.slots >= work.hit_slots > 0
    assert 8 * work.hit_slots >= work.hit_pairs >= work.hit_slots
    assert all(floor.ms > 0 for floor in gpu_floors.floors(work, gpu_floors.PEAKS["H100"]))


def test_work_of_tiles_adds_up_and_their_other_loop_exchanges_nothing():
    """What `gpu_forms` counts by tiles, against the counts of the whole picture; and the loop that it compiles."""
    work, tiles = gpu_forms.counted(gpu_scenes.load("sphere1", "cpu"))
    assert len(tiles.slots) == work.tiles
    assert int(tiles.slots.sum()) == work.hit_slots
    assert int(tiles.pairs.sum()) == work.hit_pairs
    kept, changed = (kind("raster_backward.cu").source for kind in (Program, gpu_forms.InRegisters))
    assert kept.count("sum_sixteen(") == changed.count("sum_sixteen(") + 1


def test_host_time_is_measured_without_kernels():
    assert gpu_timing.host_milliseconds(gpu_scenes.load("sphere1", "cpu"), 2) > 0


def test_a_reconstruction_step_is_timed(simt):
    """After the subdivision, over the last steps."""
    result = gpu_reconstruct.step_milliseconds(torch.device("cpu"), resolution=24, start_level=1, faces=120, steps=3)
    assert result["faces"] == 120
    assert result["milliseconds"] > 0


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_a_training_step_is_timed(simt, preset):
    """With the losses of the preset; the statistics of every step are among its kernels."""
    result = gpu_train.step_milliseconds(torch.device("cpu"), preset, size=(24, 16), triangles=40, steps=2)
    assert result["milliseconds"] > 0
    assert simt.launches.count("soup_statistics") == 8
    assert simt.launches.count("normal_backward") == (8 if preset == "paper" else 0)


def test_the_peer_on_gpus_sees_the_scene_from_the_same_camera():
    """Corners of a scene by its matrices, for rows, and by ours: in its pixels the middle of the first one is 0."""
    scene = gpu_peer.separate("sphere2", "cpu")
    _, full, tan_x, _ = gpu_peer.matrices(scene.viewmats[0], scene.Ks[0], 1024, 1024)
    corners = scene.vertices.detach()
    clip = torch.cat([corners, torch.ones_like(corners[..., :1])], dim=-1) @ full
    theirs = ((clip[..., :2] / clip[..., 3:] + 1) * 1024 - 1) / 2
    ours, _ = to_screen(corners, scene.viewmats[0], scene.Ks[0])
    torch.testing.assert_close(theirs + 0.5, ours, rtol=0, atol=1e-3)
    assert tan_x == pytest.approx(512 / float(scene.Ks[0, 0, 0]))


def test_the_peer_on_gpus_gets_what_is_drawn(simt, monkeypatch):
    """Each triangle with corners and a softness of its own, in its layout; a stand-in draws by our rasterizer."""
    scene = gpu_peer.separate("sphere1", "cpu")
    scene.cotangent = scene.cotangent[:, :32, :32].contiguous()
    scene.Ks = scene.Ks / 32 + torch.diag(torch.tensor([0.0, 0.0, 31 / 32]))

    class Rasterizer:
        def __init__(self, settings):
            assert (settings["image_width"], settings["image_height"]) == (32, 32)

        def __call__(self, triangles_points, opacities, sigma, colors_precomp, number_of_points, **_):
            given = {"opacities": opacities[:, 0], "sigma": sigma[:, 0], "face_colors": colors_precomp}
            views = {"viewmats": scene.viewmats, "Ks": scene.Ks, "width": 32, "height": 32}
            with etsplat.engine("cuda"):
                out = rasterize(triangles_points.view(-1, 3, 3), **given, **views, **gpu_peer.THEIRS)
            return out.color[0].permute(2, 0, 1), torch.ones(number_of_points, dtype=torch.int32)

    package = SimpleNamespace(TriangleRasterizationSettings=dict, TriangleRasterizer=Rasterizer)
    monkeypatch.setitem(sys.modules, "diff_triangle_rasterization", package)
    peer = gpu_peer.Peer(scene)
    picture, drawn = peer.picture()
    assert torch.equal(picture, scene.render().color[0])
    assert drawn.all()
    gpu_timing.step(scene)
    peer.step()
    theirs = peer._given["triangles_points"].grad
    torch.testing.assert_close(theirs.view(-1, 3, 3), scene.vertices.grad, rtol=0, atol=0)


def test_the_benchmark_says_that_there_is_no_gpu(monkeypatch):
    monkeypatch.setattr(gpu.torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match="no GPU: --count counts the work without one"):
        gpu.main([])


def test_kernels_are_listed_by_their_time():
    rows = gpu.kernel_table("quick", {"short": 0.001, "long": 2.0}).rows
    assert rows == [["long", "2000.0"], ["short", "1.0"]]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_the_gpu_run_stops_where_there_is_no_gpu(tmp_path):
    """Before it builds anything, with one line."""
    script = Path(__file__).parent.parent / "benchmarks" / "gpu_run.sh"
    environment = {**os.environ, "PYTHON": sys.executable, "OUT": str(tmp_path)}
    result = subprocess.run(["bash", str(script)], capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 1
    assert result.stderr.strip() == "no GPU that torch can use"
    assert result.stdout == ""


def test_off_the_path_counts_what_a_photo_shows():
    """Unmoved, a camera sees its photo, and all that is in it counts where that photo was trained on; where that of
    the other side was, less does, or it is left out. Moved half as near it looks at the same point."""
    scene = demo_scene(32, 24)
    viewmats = scene.viewmats.clone()
    viewmats[1] = viewmats[0]
    near = replace(scene, viewmats=viewmats, train=[1], test=[0])
    (still,) = floaters.off_path(near, (0.0, 0.0, 0.0))
    assert float(still.counts.float().mean()) > 0.99
    assert float((still.truth - scene.images[0].float() / 255).abs().mean()) < 1e-3
    opposite = list(floaters.off_path(replace(near, train=[10]), (0.0, 0.0, 0.0)))
    assert all(float(view.counts.float().mean()) < float(still.counts.float().mean()) for view in opposite)

    (moved,) = floaters.off_path(near, (0.0, 0.0, 0.5))
    step = moved.camera.centers[0] - still.camera.centers[0]
    torch.testing.assert_close(torch.nn.functional.normalize(step, dim=0), still.camera.viewmats[0, 2, :3])
    torch.testing.assert_close(moved.camera.viewmats[0, 2, :3], still.camera.viewmats[0, 2, :3])


def test_rough_photos_are_off_by_a_tenth_of_a_degree_and_as_bright_as_they_were():
    scene = demo_scene(32, 24)
    rough = floaters.rough(scene)
    turned = rough.viewmats[:, :3, :3] @ scene.viewmats[:, :3, :3].mT
    angles = turned.diagonal(dim1=1, dim2=2).sum(dim=1).sub(1).div(2).clamp(-1, 1).arccos().rad2deg()
    assert 0.1 < float(angles[scene.train].mean()) < 0.25  # of three axes
    assert torch.equal(rough.viewmats[scene.test], scene.viewmats[scene.test])
    before, after = (torch.stack([each.images[i].float() for i in scene.train]).mean() for each in (scene, rough))
    assert float(after / before) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize(("last", "status"), [("abc", 0), ("abd", 1)])
def test_runs_that_differ_are_told(monkeypatch, capsys, last, status):
    """Equal hashes of each command end with status 0; one other among its runs, on any number of threads, with 1."""
    found = iter([("xyz",)] * 4 + [("abc",), ("abc",), ("abc",), (last,)])
    monkeypatch.setattr(determinism, "hashes", lambda *_: next(found))
    monkeypatch.setattr(sys, "argv", ["determinism", "--runs", "2"])
    with pytest.raises(SystemExit) as end:
        determinism.main()
    assert end.value.code == status
    assert f"| 2 | 2 | `{last}` |" in capsys.readouterr().out


def test_opaque_meshes_are_compared_from_the_same_soup(tmp_path):
    """Which is made once: what the mesh starts from is found where it was kept, and the mesh has the same bits."""
    own = small_demo_scene()
    capture = own.renormalized(own.frame.center, own.frame.radius)
    config = TrainConfig.tiny().changed({"iterations": 40, "max_triangles": 800})
    first, _ = opaque_mesh.fitted(capture, config, tmp_path / "soup")
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.safetensors")}
    again, _ = opaque_mesh.fitted(capture, config, tmp_path / "soup")
    assert kept
    assert kept == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.safetensors")}
    assert torch.equal(first.vertices, again.vertices)
    assert torch.equal(first.colors, again.colors)


def test_photos_are_asked_of_points_that_they_show():
    """A wall, and a triangle that hides its left from one of two cameras: there the other's colour alone counts."""
    corners = [[-9.0, -9, 3], [9, -9, 3], [0, 20, 3], [-0.9, -0.5, 1], [-0.1, -0.5, 1], [-0.5, 0.7, 1]]
    wall = TriangleMesh.from_mesh(
        torch.tensor(corners), torch.arange(6).view(2, 3), colors=0.5, opacity=None, sigma=None
    )
    beside = torch.eye(4)
    beside[0, 3] = -1.0
    photos = []
    for value, viewmat in ((0.2, torch.eye(4)), (0.6, beside)):
        camera = Cameras(viewmat[None], torch.tensor([[[20.0, 0, 20], [0, 20, 20], [0, 0, 1]]]), 40, 40)
        pixels = torch.cat([torch.full((1, 3, 40, 40), value), torch.ones(1, 1, 40, 40)], dim=1)
        drawn = rasterize_opaque(wall.vertices.detach(), faces=wall.faces, cameras=camera)
        photos.append((Photo(pixels, viewmat, camera.Ks[0], camera.centers[0]), drawn))
    assert opaque_errors.photos_showing(wall, [drawn for _, drawn in photos]).tolist() == [2, 1, -1]
    points = torch.tensor([[-1.5, 0.0, 3.0], [1.5, 0.0, 3.0], [0.0, 0.0, -3.0]])
    count, mean, variance = opaque_errors.colors_in(photos, points)
    assert count.tolist() == [1, 2, 0]
    assert torch.allclose(mean[:2, 0], torch.tensor([0.6, 0.4]))
    assert torch.allclose(variance[1], torch.tensor(0.08))


def test_workers_are_as_fast_as_one_process_that_draws_so_much_slower():
    """What a run on several nodes of memory is asked by; every part of a step is measured on a real one."""
    arguments = argparse.Namespace(scene=None, triangles=300, width=32, views=2)
    with one_torch_thread():
        found = workers.measure(*workers.start(arguments))
    assert all(value > 0 for value in found.values()), found
    for nodes, views, cores in ((2, 2, 8), (4, 16, 4)):
        slower = workers.break_even(found, views, nodes, cores)
        slowed = {**found, "view": slower * found["view"]}
        apart = workers.computed(found, views, nodes, cores)
        assert workers.computed(slowed, views, 1, nodes * cores) == pytest.approx(apart)


def test_peers_draw_the_scene_of_the_rasterizers_own_benchmark(capsys):
    """With the camera that other renderers are given, at any size; what draws another picture is no peer."""
    given = peers.subject(2, scenes.SIZE)
    vertices = given.vertices.clone().requires_grad_()
    picture, scene = peers.ours(given, 1)(vertices), scenes.load("sphere2")
    assert torch.equal(picture, scene.render().color[0].detach())
    assert vertices.grad is not None
    peers.main(["--peers", "--level", "1", "--size", "32", "--turns", "1", "--warm", "0"])
    assert re.search(
        r"^\| etsplat \| 80 \| 32 x 32 \| 1 \| \d+ \| 1\.0 \| \d+ \| 0\.0000 \|$", capsys.readouterr().out, re.M
    )


def test_peers_that_draw_another_picture_are_refused(monkeypatch):
    def grey(vertices):
        vertices.sum().backward()
        return torch.full((32, 32, 3), 0.5)

    monkeypatch.setitem(peers.PEERS, "mitsuba", lambda given, threads: grey)
    with pytest.raises(SystemExit, match="mitsuba drew another picture"):
        peers.main(["--peers", "mitsuba", "--level", "1", "--size", "32", "--turns", "1", "--warm", "0"])


def test_stages_of_a_run_exist_and_each_second_is_counted_once(monkeypatch):
    for name in chain.from_iterable(reconstruct_stages.STAGES.values()):
        owner, attribute = reconstruct_stages.place_of(name)
        assert callable(getattr(owner, attribute)), name
    now = iter([0.0, 1.0, 3.0, 7.0])
    monkeypatch.setattr("time.process_time", lambda: next(now))
    clock = reconstruct_stages.StageClock()
    clock.timed("steps", clock.timed("guard", lambda: None))()
    assert clock.seconds["steps"] == 5.0
    assert clock.seconds["guard"] == 2.0


@pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="asks the state of a process in /proc, which is not here"
)
def test_the_second_copy_rests_in_quiet_turns_and_draws_in_the_others():
    expected, found = [True, False, True, False], []

    with contention.second_copy("sphere1", 1) as copy:

        def halted():
            return Path(f"/proc/{copy.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"

        def turn():
            """The copy changes when it is scheduled next."""
            last = time.monotonic() + 20
            while halted() != expected[len(found)] and time.monotonic() < last:
                time.sleep(0.01)
            found.append(halted())
            return [float(len(found))]

        quiet, beside = contention.quiet_and_beside(copy, 2, {"turn": turn})["turn"]
    assert found == expected
    assert (quiet, beside) == (2.0, 3.0)  # medians of 1, 3 and 2, 4
    assert copy.returncode is not None


@pytest.mark.skipif(len(_native.available_instruction_sets()) < 2, reason="the processor has one instruction set alone")
def test_a_narrower_instruction_set_is_compared_with_the_widest_in_turn(monkeypatch):
    widest, *_, narrow = _native.available_instruction_sets()
    used = []
    monkeypatch.setattr(measure, "repetition", lambda scene, timings: used.append(_native.instruction_set()))
    scene, before = scenes.load("sphere1"), _native.instruction_set()
    _native.set_instruction_set(narrow)
    try:
        name, turn = measure.yardstick(scene, 1, narrow, Prototype(wanted=False))
        turn()
        measure.one_turn(scene)
    finally:
        _native.set_instruction_set(before)
    assert name == widest
    assert set(used[: len(used) // 2]) == {widest}
    assert set(used[len(used) // 2 :]) == {narrow}
    assert measure.yardstick(scene, 1, widest, Prototype(wanted=False)) is None
