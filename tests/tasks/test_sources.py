"""What comes after training finds the run's soup and the very photos that it was trained on."""

import json
import shutil
from dataclasses import replace

import pytest
import torch

import etsplat
from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from etsplat.data.close_ups import object_side
from etsplat.data.dataset import Dataset, Normalization
from etsplat.data.demo_object import demo_object
from etsplat.data.hull import bounding_sphere
from etsplat.data.load import load_dataset
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.loop import CheckpointEvent
from etsplat.tasks.opened_runs import open_run
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.scoring import evaluate_run
from etsplat.tasks.sources import load_source
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig
from etsplat.viewer import server
from helpers.captures import circle_poses, write_colmap, write_photo, write_views


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short run on half-size copies of photos; with the iterations of the soups seen at its checkpoints."""
    folder = tmp_path_factory.mktemp("trained")
    write_colmap(folder / "scene", [(64, 48)] * 9)
    for index in range(9):
        write_photo(folder / "scene" / "images_2" / f"{index:04d}.jpg", 32, 24, seed=index)
    config = TrainConfig.tiny().changed(
        {"iterations": 20, "output.checkpoint_every": 10, "output.evaluate_every": 0, "output.log_every": 10}
    )
    seen = []

    def look(event):
        if isinstance(event, CheckpointEvent):
            seen.append(TriangleSoup.load(folder / "run" / "soup.safetensors").notes["iteration"])

    result = train(folder / "scene", folder / "run", config, images="images_2", callbacks=[look])
    return folder, result, seen


def test_a_run_opens_with_its_soup_and_its_photos(trained):
    folder, result, _ = trained
    run = open_run(folder / "run")
    assert torch.equal(run.soup.vertices, result.soup.vertices)
    assert run.capture.images.sizes == [(32, 24)] * 9
    found = evaluate_run(run)
    assert found["psnr"] == pytest.approx(result.metrics["psnr"], abs=1e-3)
    assert found["ssim_opaque"] == pytest.approx(result.metrics["ssim_opaque"], abs=1e-3)


def test_every_checkpoint_comes_with_a_soup_to_look_at(trained):
    assert trained[2][:1] == ["10"]


def without_scene(folder, to):
    """A copy of the run whose scene is not where it was."""
    shutil.copytree(folder / "run", to)
    config = to / "config.json"
    config.write_text(config.read_text().replace(str(folder / "scene"), str(folder / "gone")))
    return to


@pytest.mark.usefixtures("command_line")
def test_a_scene_that_moved_is_named_with_an_option(trained, tmp_path):
    folder, _, _ = trained
    shutil.copytree(folder / "scene", tmp_path / "moved")
    without_scene(folder, tmp_path / "run")
    for command in ("eval", "render"):
        with pytest.raises(InputError, match=r"/gone has gone; name where it is now with --scene"):
            parse([command, str(tmp_path / "run")]).run([])
    assert len(open_run(tmp_path / "run", tmp_path / "moved").capture) == 9
    with pytest.raises(InputError, match=r"scene .*/mover: no such folder; did you mean .*/moved\?"):
        open_run(tmp_path / "run", tmp_path / "mover")


@pytest.mark.usefixtures("command_line")
def test_what_needs_no_photos_works_when_the_scene_has_gone(trained, tmp_path, capsys):
    """And says what is otherwise without them; nothing is of the soup itself."""
    folder, result, _ = trained
    run = without_scene(folder, tmp_path / "run")
    notes = {
        "safetensors": "",
        "etz": "in order of opacity",
        "html": "no photos on the page",
        "glb": "nothing is turned",
    }
    for kind, note in notes.items():
        assert parse(["export", str(run), "--out", str(tmp_path / f"out.{kind}"), "--min-opacity", "0"]).run([]) == 0
        said = capsys.readouterr().out
        assert (f"{folder / 'gone'} has gone: " in said) is bool(note)
        assert note in said
    assert torch.equal(TriangleSoup.load(run / "soup.safetensors").vertices, result.soup.vertices)
    with pytest.raises(InputError, match="has gone; name where it is now with --scene"):
        parse(["export", str(run), "--clean"]).run([])


@pytest.mark.parametrize(
    ("group", "name", "value", "message"),
    [
        ("config", "width", "800", "width: is '800'; it must be a whole number"),
        ("config", "width", {}, "width: is {}; it must be a whole number"),
        ("config", "width", -5, "width: is -5; it must be between 1 and 16384"),
        ("paths", "source", 5, "`paths.source` is 5, but must be a text or null"),
        ("paths", "images", ["images_2"], "`paths.images` is"),
        ("paths", "source", ..., "lacks `paths.source`"),
        ("config", "width", ..., "lacks `config.width`"),
    ],
)
def test_a_run_whose_config_is_damaged_is_named(tmp_path, trained, group, name, value, message):
    shutil.copytree(trained[0] / "run", tmp_path / "run")
    config = tmp_path / "run" / "config.json"
    record = json.loads(config.read_text())
    record[group][name] = value
    if value is ...:
        del record[group][name]
    config.write_text(json.dumps(record))
    with pytest.raises(InputError) as error:
        open_run(tmp_path / "run", trained[0] / "scene")
    assert str(error.value).startswith(f"{config}: ")
    assert message in str(error.value)


def test_a_run_is_no_scene(trained):
    with pytest.raises(InputError, match=r"run: none of .* choose the scene's folder that this run was made from"):
        load_dataset(trained[0] / "run")


def test_a_reconstruction_is_told_where_its_mesh_is(tmp_path):
    RunDirectory.create(tmp_path / "mesh", {"task": "reconstruct", "config": {}})
    with pytest.raises(InputError, match=r"mesh\.glb opens in any mesh viewer.*name a run of `etsplat train`"):
        open_run(tmp_path / "mesh")


@pytest.mark.parametrize("command", ["view", "eval", "render", "export"])
def test_a_mistyped_folder_is_answered_at_once_with_what_was_meant(tmp_path, command):
    meant = tmp_path / "runs" / "kitchen"
    meant.mkdir(parents=True)
    for given in (tmp_path / "runs" / "kichen", tmp_path / "rums" / "kitchen"):
        with pytest.raises(InputError) as raised:
            parse([command, str(given)]).run([])
        assert str(raised.value).startswith(f"{given}: no such file or folder; did you mean {meant}?")


def test_a_path_like_no_other_is_to_be_checked(tmp_path):
    for path in (tmp_path / "run", tmp_path / "no" / "where"):
        with pytest.raises(InputError, match=f"{path}: no such file or folder; check the path"):
            open_run(path)


def test_folders_without_a_soup_are_input_errors(tmp_path, trained):
    with pytest.raises(InputError, match="is not a run of etsplat"):
        open_run(tmp_path)
    shutil.copytree(trained[0] / "run", tmp_path / "run")
    (tmp_path / "run" / "soup.safetensors").unlink()
    with pytest.raises(InputError, match="got to a checkpoint"):
        open_run(tmp_path / "run")


def test_an_object_in_a_data_set_is_found_by_its_outlines():
    """In its own units; one that is in the unit sphere, or was moved by somebody, or has no outlines, stays."""
    views = photograph(demo_object(), 64, 64).in_input_units()
    assert load_source(views, ReconstructConfig.tiny()) == (views, [])
    far = views.renormalized(torch.tensor([-3.0, 1.0, -2.0], dtype=torch.float64), 0.1)
    far = replace(far, normalization=Normalization())
    found, notes = load_source(far, ReconstructConfig.tiny())
    assert isinstance(found, Dataset)
    center, radius = bounding_sphere(views)
    assert found.normalization.radius == pytest.approx(10 * radius, rel=0.1)
    expected = torch.tensor([30.0, -10.0, 20.0]) + 10 * center
    torch.testing.assert_close(found.normalization.center.float(), expected, rtol=0, atol=1.0)
    assert "the object is about (3" in notes[0]
    assert load_source(found, ReconstructConfig.tiny()) == (found, [])
    images = [image.clone() for image in far.images]
    images[far.train[2]][:] = 0
    with pytest.raises(InputError, match="its mask is empty"):
        load_source(replace(far, images=StoredPictures(images)), ReconstructConfig.tiny())
    opaque = replace(far, images=StoredPictures([image[..., :3] for image in far.images]))
    assert load_source(opaque, ReconstructConfig.tiny()) == (opaque, [])


def write_spoilt(folder, spoil):
    """A capture of the demo's object; `spoil` changes the pixels of its photos, and the data set comes back."""
    views = photograph(demo_object(), 64, 64, supersampling=2)
    images = [image.clone() for image in views.images]
    spoil(images, views)
    spoilt = replace(views, images=StoredPictures(images))
    write_views(folder, spoilt, views.train, "transforms_train.json")
    write_views(folder, spoilt, views.test, "transforms_test.json")
    return views


def without_lower_half(image):
    image[32:] = 0


def test_photos_whose_masks_contradict_the_others_are_left_out_and_named(tmp_path):
    """Half of one mask is lost: the hull would lose that half of the object, and so would the sphere about it."""
    views = write_spoilt(tmp_path, lambda images, views: without_lower_half(images[views.train[4]]))
    scene, notes = load_source(tmp_path, ReconstructConfig.tiny())
    names = [scene.names[index] for index in scene.train]
    wrong = f"images_{views.train[4]:03d}"
    assert wrong not in names
    assert (len(names), len(scene.test)) == (len(views.train) - 1, len(views.test))
    assert notes == [f"left out, since its mask or pose contradicts the others: {wrong}"]


def test_so_are_test_photos_by_which_a_good_result_would_be_called_poor(tmp_path):
    views = write_spoilt(tmp_path, lambda images, views: without_lower_half(images[views.test[4]]))
    scene, notes = load_source(tmp_path, ReconstructConfig.tiny())
    wrong = f"images_{views.test[4]:03d}"
    assert wrong not in [scene.names[index] for index in scene.test]
    assert (len(scene.train), len(scene.test)) == (len(views.train), len(views.test) - 1)
    assert notes == [f"left out, since its mask or pose contradicts the others: {wrong}"]


@pytest.mark.parametrize("kind", ["train", "test"])
def test_photos_whose_mask_is_empty_are_refused(tmp_path, kind):
    views = write_spoilt(tmp_path, lambda images, views: images[getattr(views, kind)[1]].zero_())
    with pytest.raises(InputError, match=rf"view images_{getattr(views, kind)[1]:03d}: its mask is empty"):
        load_source(tmp_path, ReconstructConfig.tiny())


def test_photos_whose_mask_ends_just_before_the_frame_are_cropped_and_named(tmp_path):
    """All lack what is left of a column, and their masks one pixel more."""
    views = photograph(demo_object(), 64, 64, supersampling=2)
    images = [image[:, 22:].clone() for image in views.images]
    for image in images:
        image[:, 0] = 0
    spoilt = replace(views, images=StoredPictures(images))
    camera = {"fl_x": float(views.Ks[0, 0, 0]), "cx": 10, "cy": 32, "w": 42, "h": 64}
    write_views(tmp_path, spoilt, views.train, "transforms_train.json", **camera)
    write_views(tmp_path, spoilt, views.test, "transforms_test.json", **camera)
    scene, notes = load_source(tmp_path, ReconstructConfig.tiny())
    cropped = [name for name, size in zip(scene.names, scene.images.sizes, strict=True) if size == (41, 64)]
    assert len(cropped) > len(scene) / 2
    assert notes[0] == f"cropped, since a mask ends along the frame just before it: {', '.join(cropped)}"
    assert all(float(scene.Ks[scene.names.index(name), 0, 2]) == 9 for name in cropped)


@pytest.mark.parametrize("refined", ["off", "poses"])
def test_an_object_that_is_small_in_its_photos_is_read_as_large_as_one_that_fills_them(tmp_path, refined):
    """Nine tenths of what the photos show is background."""
    views = photograph(demo_object(), 64, 64, supersampling=2)
    padded = [torch.nn.functional.pad(image, (0, 0, 66, 62, 66, 62)) for image in views.images]
    spoilt = replace(views, images=StoredPictures(padded))
    camera = {"fl_x": float(views.Ks[0, 0, 0]), "cx": 98, "cy": 98, "w": 192, "h": 192}
    write_views(tmp_path, spoilt, views.train, "transforms_train.json", **camera)
    write_views(tmp_path, spoilt, views.test, "transforms_test.json", **camera)
    config = replace(ReconstructConfig.tiny(), resolution=64, refine_cameras=refined)
    scene, notes = load_source(tmp_path, config)
    assert isinstance(scene, Dataset)
    close = refined == "off"
    assert notes == ["the object is small in the photos: they are cropped to it"] * close
    assert object_side(scene) == pytest.approx(object_side(views) / (1 if close else 3), abs=6)
    assert all(max(size) <= 90 for size in scene.images.sizes)
    torch.testing.assert_close(scene.normalization.center, torch.zeros(3), rtol=0, atol=0.02)
    if close:
        given = replace(spoilt, Ks=views.Ks + torch.tensor([[0, 0, 66], [0, 0, 66], [0, 0, 0]]))
        near, said = load_source(given, config)
        assert isinstance(near, Dataset)
        assert (len(set(near.images.sizes)), said) == (1, notes)


def test_another_scene_than_that_of_the_training_is_noticed(trained, tmp_path, capsys, monkeypatch):
    """Its numbers came to stand in the run's own report, without a word."""
    folder, _, _ = trained
    shutil.copytree(folder / "run", tmp_path / "run")
    shutil.copytree(folder / "scene", tmp_path / "moved")
    write_colmap(tmp_path / "other", [(64, 48)] * 9, poses=[pose.roll(1, 0) for pose in circle_poses(9)])
    shutil.copytree(tmp_path / "other" / "images", tmp_path / "other" / "images_2")
    asked = ["eval", str(tmp_path / "run"), "--scene"]
    assert not open_run(tmp_path / "run", tmp_path / "moved").other_scene
    with pytest.raises(InputError, match=r"other: is not the scene that .*run was trained on, .* with --out, or leave"):
        parse([*asked, str(tmp_path / "other")]).run([])
    assert not (tmp_path / "run" / "evaluation.json").exists()
    parse([*asked, str(tmp_path / "other"), "--out", str(tmp_path / "measured")]).run([])
    assert "on another scene than the run was trained on" in capsys.readouterr().out
    assert json.loads((tmp_path / "measured" / "evaluation.json").read_text())["other_scene"] is True
    monkeypatch.setattr(server, "serve", lambda *_: None)
    for command in (["render", "--width", "16", "--path", "photos", "--frames", "1", "--format", "frames"], ["view"]):
        for name, said in (("moved", False), ("other", True)):
            parse([*command, str(tmp_path / "run"), "--scene", str(tmp_path / name)]).run([])
            about = f"{name} is another scene than the run was trained on: cameras are those of its photos"
            assert (about in capsys.readouterr().out) == said
    written = etsplat.export(
        tmp_path / "run", tmp_path / "soup.glb", etsplat.ExportConfig(min_opacity=0.01), scene=tmp_path / "other"
    )
    assert written.notes == (
        "it is of another scene than the run was trained on: colours and what is seen are by its photos",
        "nothing is turned, since the cameras contradict each other about where up is: +y is up if it was before",
    )
