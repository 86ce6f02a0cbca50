"""Runs with depth maps and dense clouds, by the functions that the command line calls."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import etsplat
from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.io.georeference import Georeference
from etsplat.io.ply_tables import encode_ply
from etsplat.optim.loop import NoteEvent
from etsplat.tasks.depths import trusted_depths, unit_of_maps, wanted_depths, with_shown_points
from etsplat.tasks.sources import with_cloud
from helpers.captures import write_colmap
from helpers.depths import ball_with_depths

TRAIN = etsplat.TrainConfig.tiny("object").changed({"iterations": 40, "exposure": "off", "output.evaluate_every": 0})
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def garbage(depth, view):
    """Another smooth surface in every photo."""
    rng = torch.Generator().manual_seed(view)
    field = torch.nn.functional.interpolate(torch.rand((1, 1, 4, 4), generator=rng), depth.shape, mode="bilinear")
    return torch.where(depth > 0, 2 + 2 * field[0, 0], 0.0)


def write_ball(folder, *, change=lambda depth, view: depth, named=False, unit=1.0):
    """In nerfstudio's layout, with depth maps that the file names, or in depths/."""
    ball = ball_with_depths(32, 8, change)
    frames = []
    (folder / "images").mkdir(parents=True)
    for index, name in enumerate(ball.names):
        etsplat.save_image(folder / "images" / f"{name}.png", ball.images[index])
        path = folder / ("maps" if named else "depths") / f"{name}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, ball.images.depth(index).numpy() / unit)
        pose = torch.linalg.inv(ball.viewmats[index]) @ FLIP
        frame = {"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()}
        frames.append({**frame, **({"depth_file_path": f"maps/{name}.npy"} if named else {})})
    K = ball.Ks[0]
    about = {"fl_x": float(K[0, 0]), "cx": 16.0, "cy": 16.0, "w": 32, "h": 32, "frames": frames}
    about |= {"depth_unit_scale_factor": unit} if named else {}
    (folder / "transforms.json").write_text(json.dumps(about))
    return ball


@pytest.mark.parametrize("named", [False, True])
def test_depth_maps_are_found_beside_photos(tmp_path, named):
    """In depths/, or where transforms.json names them, in its unit; only where they are wanted."""
    ball = write_ball(tmp_path, named=named, unit=0.25 if named else 1.0)
    found, without = load_dataset(tmp_path, depths=True), load_dataset(tmp_path)
    assert found.images.with_depth == frozenset(range(len(ball)))
    for index in range(len(ball)):
        assert torch.allclose(found.images.depth(index), ball.images.depth(index))
        assert without.images.depth(index) is None
    assert found.fingerprint() != without.fingerprint()
    other = load_dataset(tmp_path, depths=True, depth_unit=3.0)
    assert torch.allclose(other.images.depth(0) * (0.25 if named else 1) / 3, ball.images.depth(0))
    assert other.fingerprint() != found.fingerprint()


def test_a_folder_of_maps_may_be_named_and_lack_some(tmp_path):
    write_ball(tmp_path)
    (tmp_path / "depths").rename(tmp_path / "elsewhere")
    next((tmp_path / "elsewhere").glob("*.npy")).unlink()
    assert not load_dataset(tmp_path, depths=True).images.with_depth
    assert len(load_dataset(tmp_path, depths=tmp_path / "elsewhere").images.with_depth) == 15
    with pytest.raises(InputError, match=r"depths .*gone: no such folder"):
        load_dataset(tmp_path, depths=tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"depths .*empty: has no map for any photo; call them like their photos"):
        load_dataset(tmp_path, depths=tmp_path / "empty")


def test_it_is_told_how_many_photos_have_a_map_where_not_all_have_one(tmp_path):
    """Nothing said so where a folder was half copied; of photos for testing no map is needed."""
    write_ball(tmp_path)
    found = load_dataset(tmp_path, depths=True)
    maps = sorted((tmp_path / "depths").glob("*.npy"))
    for index in found.test:
        maps[index].unlink()
    assert load_dataset(tmp_path, depths=True).notes == found.notes == ()
    for index in found.train[:5]:
        maps[index].unlink()
    assert load_dataset(tmp_path, depths=True).notes == ("9 of 14 photos for training have a depth map",)
    assert load_dataset(tmp_path).notes == ()


def test_a_folder_of_depths_that_are_not_read_is_said(tmp_path):
    """Of another kind or name: they were passed over without a word."""
    write_colmap(tmp_path, [(16, 12)] * 4)
    assert load_dataset(tmp_path, depths=True).notes == ()
    (tmp_path / "depth").mkdir()
    for image in (tmp_path / "images").iterdir():
        np.savez(tmp_path / "depth" / f"{image.stem}.npz", np.ones((12, 16)))
    said = "depth/ has no map for any photo: call them like their photos, a.png (16 bits), a.npy or a.exr"
    assert load_dataset(tmp_path, depths=True).notes == (said,)
    assert load_dataset(tmp_path).notes == ()


def test_maps_of_another_shape_are_refused(tmp_path):
    write_ball(tmp_path)
    np.save(next((tmp_path / "depths").glob("*.npy")), np.ones((32, 20)))
    with pytest.raises(InputError, match="is 20x32, its image is 32x32; resize or crop the map"):
        load_dataset(tmp_path, depths=True)


def test_a_run_uses_right_maps_and_wrong_ones_change_no_bit(tmp_path):
    """Of the soup; the run says so either way."""
    soups, said = {}, {}
    for kind, change in (("right", lambda depth, view: depth), ("wrong", garbage)):
        folder, notes = tmp_path / kind, []
        write_ball(folder, change=change)
        for setting in ("auto", "off"):
            result = etsplat.train(
                folder, tmp_path / f"{kind}_{setting}", TRAIN.changed({"loss.depth": setting}), callbacks=[notes.append]
            )
            soups[kind, setting] = result.soup.vertices
            if setting == "auto":
                said[kind] = result.metrics["depth_used"]
        told = " ".join(str(note) for note in notes if isinstance(note, NoteEvent))
        assert ("depth maps: not used" in told) == (kind == "wrong")
    assert said == {"right": "l1", "wrong": None}
    assert torch.equal(soups["wrong", "auto"], soups["wrong", "off"])
    assert not torch.equal(soups["right", "auto"], soups["right", "off"])


def test_the_unit_of_maps_is_found_by_what_they_show_of_each_other():
    """From a tenth beside it; not of garbage, and not of photos from nearly one place, which agree in any."""
    ball = ball_with_depths(change=lambda depth, view: depth / 4)
    found = unit_of_maps(ball, ball.train, 4.4)
    assert found == pytest.approx(4, rel=0.005)
    assert unit_of_maps(ball_with_depths(change=garbage), ball.train, 1.0) is None
    still = replace(ball, viewmats=ball.viewmats[:1].expand_as(ball.viewmats))
    assert unit_of_maps(still, still.train, 4.0) is None


def test_maps_in_a_wrong_unit_are_used_as_depths_where_it_is_found():
    """By points, near what they say."""
    told = []
    ball = ball_with_depths(change=lambda depth, view: 1000 * depth)
    trust = trusted_depths(ball, "auto", 10, told.append)
    assert trust is not None
    assert trust.kind == "l1"
    assert trust.unit == pytest.approx(0.001, rel=0.005)
    assert "they are multiplied by it" in str(told[0])
    right = trusted_depths(ball_with_depths(), "auto", 10, told.append)
    assert right is not None
    assert (right.kind, right.unit) == ("l1", 1)


@pytest.mark.parametrize("setting", ["pearson", "auto"])
def test_a_resumed_run_ends_with_the_same_bits(tmp_path, setting):
    """Stopped after the maps were compared with the soup, and before; or where it began at what they show."""
    write_ball(tmp_path / "scene")
    config = TRAIN.changed({"loss.depth": setting, "loss.depth_from": 15_000, "output.checkpoint_every": 10})

    class StopError(Exception):
        pass

    def stop_at(iteration):
        def callback(event):
            if type(event).__name__ == "CheckpointEvent" and event.iteration == iteration:
                raise StopError

        return callback

    whole = etsplat.train(tmp_path / "scene", tmp_path / "whole", config, callbacks=[lambda event: None])
    for iteration in (10, 30):
        out = tmp_path / str(iteration)
        with pytest.raises(StopError):
            etsplat.train(tmp_path / "scene", out, config, callbacks=[stop_at(iteration)])
        again = etsplat.train(tmp_path / "scene", out, config, callbacks=[lambda event: None], resume=True)
        assert torch.equal(again.soup.vertices, whole.soup.vertices)
        assert again.metrics["depth_used"] == whole.metrics["depth_used"]


def test_a_capture_without_points_begins_at_what_right_maps_show():
    """On the surface, in colours of the photos, whatever the unit; random points stay where maps are wrong."""
    for scale in (1, 1000):
        ball = replace(ball_with_depths(change=lambda depth, view, scale=scale: scale * depth), exact_points=None)
        given, told = ball_with_depths().exact_points, []
        trust = trusted_depths(replace(ball, exact_points=given if scale > 1 else None), "auto", 10, told.append)
        found = with_shown_points(ball, trust, 600, told.append)
        assert found.exact_points is not None
        assert found.point_colors is not None
        assert 150 < len(found.exact_points) <= 300
        assert (found.exact_points.norm(dim=1) - 1).abs().median() < 0.01
        assert "depth maps: starting from" in str(told[-1])
        assert with_shown_points(ball, trust, 2, told.append) is ball
    wrong = replace(ball_with_depths(change=garbage), exact_points=None)
    assert with_shown_points(wrong, trusted_depths(wrong, "auto", 10, told.append), 600, told.append) is wrong
    assert with_shown_points(ball, None, 600, told.append) is ball
    pointed = ball_with_depths()
    assert with_shown_points(pointed, trusted_depths(pointed, "auto", 10, told.append), 600, told.append) is pointed


def test_a_mesh_uses_right_maps_and_wrong_ones_change_no_bit(tmp_path):
    """As a soup."""
    meshes, used = {}, {}
    for kind, change in (("right", lambda depth, view: depth), ("wrong", garbage)):
        write_ball(tmp_path / kind, change=change)
        for setting in ("auto", "off"):
            config = etsplat.ReconstructConfig.tiny().changed(
                {"iterations": 20, "regularization.depth": setting, "drawing.opaque_from": 0.8}
            )
            out = tmp_path / f"{kind}_{setting}"
            result = etsplat.reconstruct(tmp_path / kind, out, config, callbacks=[lambda event: None])
            meshes[kind, setting], used[kind, setting] = result.mesh.vertices, result.metrics.get("depth_used")
    assert used == {("right", "auto"): "l1", ("right", "off"): None, ("wrong", "auto"): None, ("wrong", "off"): None}
    assert torch.equal(meshes["wrong", "auto"], meshes["wrong", "off"])
    assert not torch.equal(meshes["right", "auto"], meshes["right", "off"])


@pytest.mark.parametrize(("opaque_from", "used"), [(0.8, "l1"), (1.0, None)])
def test_maps_are_not_blamed_for_what_opaque_pictures_are_worth(tmp_path, monkeypatch, opaque_from, used):
    """Photos kept aside fall where triangles become opaque: maps are dropped only if they did so while soft."""

    def falling(_watch, _model, iteration):
        return {"watched_loss": 0.1, "watched_psnr": 30.0 if iteration <= 16 else 20.0}

    monkeypatch.setattr("etsplat.optim.watch.Watch.observe", falling)
    write_ball(tmp_path / "ball")
    changes = {"iterations": 20, "regularization.depth": "auto", "watch": 4, "output.evaluate_every": 2}
    config = etsplat.ReconstructConfig.tiny().changed({**changes, "drawing.opaque_from": opaque_from})
    result = etsplat.reconstruct(tmp_path / "ball", tmp_path / "run", config, callbacks=[lambda event: None])
    assert result.metrics["depth_used"] == used


def test_opaque_triangles_say_that_they_leave_maps_out(tmp_path):
    """A note of those that the capture has; those that are named are refused."""
    write_ball(tmp_path)
    changes = {"iterations": 2, "method": "raster-face", "regularization.depth": "auto"}
    config = etsplat.ReconstructConfig.tiny().changed(changes)
    notes = []
    etsplat.reconstruct(tmp_path, tmp_path / "run", config, callbacks=[notes.append])
    assert any("depth maps: method raster-face has no use for them" in str(note) for note in notes)
    for given in ({"depths": tmp_path / "depths"}, {"depth_unit": 0.001}):
        with pytest.raises(InputError, match=f"{next(iter(given))}: has no effect with method raster-face"):
            etsplat.reconstruct(tmp_path, tmp_path / "other", config, **given)


def test_settings_that_would_do_nothing_are_refused():
    assert wanted_depths(None, None, "off") is False
    assert wanted_depths(None, None, "auto") is True
    for arguments, why in (
        (("maps", None, "off"), "depths: has no effect"),
        ((None, 0.001, "off"), "depth_unit: has no effect"),
        ((None, -1.0, "auto"), "must be positive"),
    ):
        with pytest.raises(InputError, match=why):
            wanted_depths(*arguments)
    ball = ball_with_depths(azimuths=2)
    assert trusted_depths(ball, "off", 1, lambda event: None) is None


def test_a_run_starts_from_a_dense_cloud(tmp_path):
    """What photos speak for of it; a cloud in another frame is refused."""
    ball = write_ball(tmp_path)
    assert ball.exact_points is not None
    places = np.concatenate([ball.exact_points.numpy(), np.random.default_rng(0).uniform(-3, 3, (200, 3))])
    for name, moved in (("good.ply", places), ("bad.ply", places + 50)):
        table = np.empty(len(places), [(axis, "f4") for axis in "xyz"])
        for axis, values in zip("xyz", moved.T, strict=True):
            table[axis] = values
        (tmp_path / name).write_bytes(encode_ply({"vertex": table}))
    notes = []
    config = TRAIN.changed({"pixels_per_triangle": None, "loss.depth": "off"})
    etsplat.train(tmp_path, tmp_path / "run", config, init_points=tmp_path / "good.ply", callbacks=[notes.append])
    assert any("good.ply: starting from" in str(note) for note in notes)
    with pytest.raises(InputError, match="align them first"):
        etsplat.train(tmp_path, tmp_path / "other", config, init_points=tmp_path / "bad.ply")


def test_a_dense_cloud_is_no_sparser_a_start_than_the_points_it_replaces(tmp_path):
    """Small photos allow few triangles, and their capture has more points than that, all of which would start."""
    ball = write_ball(tmp_path)
    assert ball.exact_points is not None
    table = np.ascontiguousarray(ball.exact_points.numpy()).view([(axis, np.float64) for axis in "xyz"])[:, 0]
    (tmp_path / "dense.ply").write_bytes(encode_ply({"vertex": table}))
    own = ball.exact_points[:120]
    scene = replace(load_dataset(tmp_path), exact_points=own, point_colors=torch.zeros(len(own), 3))
    with pytest.raises(InputError, match="align them first"):  # of so few nothing can start
        with_cloud(replace(scene, exact_points=None, point_colors=None), tmp_path / "dense.ply", 60)
    started, _ = with_cloud(scene, tmp_path / "dense.ply", 60)
    assert started.exact_points is not None
    assert 100 <= len(started.exact_points) <= 120


def test_a_cloud_is_in_the_world_where_the_scene_says_how_it_lies_there(tmp_path):
    """As laser scans are, whose coordinates are those of maps."""
    ball = write_ball(tmp_path)
    assert ball.exact_points is not None
    Georeference((500_000.0, 5_400_000.0, 300.0), 0.5).write(tmp_path)
    table = np.empty(len(ball.exact_points), [(axis, "f8") for axis in "xyz"])
    for axis, local, origin in zip("xyz", ball.exact_points.numpy().T, (500_000, 5_400_000, 300), strict=True):
        table[axis] = origin + 0.5 * local  # doubles have a nanometre there
    (tmp_path / "scan.ply").write_bytes(encode_ply({"vertex": table}))
    scene, note = with_cloud(load_dataset(tmp_path), tmp_path / "scan.ply", 10_000)
    assert "starting from" in note
    assert scene.exact_points is not None
    off = torch.cdist(scene.exact_points, ball.exact_points).amin(dim=1)
    assert float(off.max()) < 1e-6
