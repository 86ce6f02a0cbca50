import json
import math

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.demo_object import demo_object
from etsplat.data.hull import bounding_sphere
from etsplat.data.load import load_dataset
from etsplat.data.photograph import photograph
from etsplat.io.images import save_image
from helpers.captures import write_transforms, write_views
from helpers.photos import upright_picture, write_phone_photo


def load_transforms(folder, width=None):
    return load_dataset(folder, masks_as="alpha", width=width)


def stack(views):
    """(B, H, W, 4) of all photos."""
    return torch.stack(list(views.images))


@pytest.fixture(scope="module")
def truth():
    return photograph(demo_object(), 40, 40, elevations=(-30.0, 20.0), azimuths=5, supersampling=2)


def transposed(document):
    return torch.tensor(document["frames"][2]["transform_matrix"]).T.tolist()


def rewrite(folder, change):
    """Loads transforms.json, lets `change` edit it, writes it back."""
    document = json.loads((folder / "transforms.json").read_text())
    change(document)
    (folder / "transforms.json").write_text(json.dumps(document))


@pytest.fixture
def scene(tmp_path, truth):
    write_views(tmp_path, truth, range(10), "transforms.json")
    return tmp_path


def test_blender_layout_returns_the_cameras_and_premultiplied_images(tmp_path, truth):
    write_views(tmp_path, truth, range(7), "transforms_train.json")
    write_views(tmp_path, truth, range(7, 10), "transforms_test.json")
    views = load_transforms(tmp_path)
    torch.testing.assert_close(views.viewmats, truth.viewmats, atol=1e-5, rtol=0)
    torch.testing.assert_close(views.Ks, truth.Ks, atol=1e-3, rtol=0)
    torch.testing.assert_close(stack(views), stack(truth), atol=2.1 / 255, rtol=0)
    assert (views.train, views.test) == (list(range(7)), [7, 8, 9])
    assert views.names[3] == "images_003"
    assert views.has_masks


@pytest.mark.parametrize(("beside", "tested"), [([], 1), (["val"], 2), (["val", "test"], 3)])
def test_blender_s_photos_for_validation_are_for_testing_where_no_others_are(tmp_path, truth, beside, tested):
    """They were passed over, and every 8th photo for training tested."""
    write_views(tmp_path, truth, range(5), "transforms_train.json")
    for name in beside:
        write_views(tmp_path, truth, range(5, 7) if name == "val" else range(7, 10), f"transforms_{name}.json")
    views = load_transforms(tmp_path)
    assert len(views.test) == tested
    assert len(views.train) == (5 if beside else 4)


def test_nerfstudio_intrinsics_scale_with_the_files_and_the_requested_width(scene, truth):
    """fl, cx, cy belong to w x h; files of half that size, loaded at half theirs again, quarter them."""

    def change(document):
        del document["camera_angle_x"]
        document |= {"fl_x": 100.0, "fl_y": 110.0, "cx": 41.0, "cy": 39.0, "w": 80, "h": 80, "k1": 0.0}

    rewrite(scene, change)
    views = load_transforms(scene, width=20)
    expected = torch.tensor([[25, 0, 10.25], [0, 27.5, 9.75], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(views.Ks, expected.expand(10, 3, 3))
    assert stack(views).shape == (10, 20, 20, 4)
    torch.testing.assert_close(stack(views).mean(), stack(truth).mean(), atol=0.01, rtol=0)


def test_split_is_every_eighth_by_name_or_as_the_file_says(scene):
    assert load_transforms(scene).test == [0, 8]
    names = [f"./images/{k:03d}" for k in range(10)]
    rewrite(scene, lambda d: d.update(train_filenames=names[2:], test_filenames=names[:2]))
    views = load_transforms(scene)
    assert (views.test, views.train) == ([0, 1], list(range(2, 10)))
    assert views.notes == ()


@pytest.mark.parametrize("tests", [{"test_filenames": []}, {}])
def test_photos_for_validation_are_for_testing_where_no_others_are(scene, tests):
    names = [f"./images/{k:03d}" for k in range(10)]
    rewrite(scene, lambda d: d.update(train_filenames=names[3:], val_filenames=names[:3], **tests))
    views = load_transforms(scene)
    assert (views.test, views.train, views.notes) == ([0, 1, 2], list(range(3, 10)), ())
    rewrite(scene, lambda d: d.update(test_filenames=names[:1]))
    views = load_transforms(scene)
    assert (views.test, views.train) == ([0], list(range(3, 10)))
    assert views.notes == ("2 of 10 photos are named neither for training nor for testing and are left out",)


@pytest.mark.parametrize("key", ["test_filenames", "val_filenames"])
def test_photos_for_testing_alone_leave_all_others_for_training(scene, key):
    """Others were tested in their place, and these trained on, without a word."""
    rewrite(scene, lambda d: d.update({key: [f"./images/{k:03d}" for k in (3, 4)]}))
    views = load_transforms(scene)
    assert (views.test, views.train) == ([3, 4], [0, 1, 2, 5, 6, 7, 8, 9])


def test_photos_for_both_are_said_to_be_trained_on(scene):
    names = [f"./images/{k:03d}" for k in range(10)]
    rewrite(scene, lambda d: d.update(train_filenames=names, test_filenames=names[:3]))
    views = load_transforms(scene)
    assert (views.test, len(views.train)) == ([], 10)
    assert views.notes == ("3 photos are named for training and for testing: they are trained on, not tested",)


@pytest.mark.parametrize("tests", [{}, {"val_filenames": []}])
def test_photos_for_training_alone_are_said_to_be_passed_over(scene, tests):
    rewrite(scene, lambda d: d.update(train_filenames=[f"./images/{k:03d}" for k in range(9)], **tests))
    views = load_transforms(scene)
    assert views.test == [0, 8]
    assert views.notes == ("train_filenames is without test_filenames: every 8th of all photos is tested",)


def test_null_says_nothing_and_camera_models_may_be_in_small_letters(scene):
    """As programs write what they do not know; both were refused."""
    before = load_transforms(scene)
    rewrite(scene, lambda d: d.update(cx=None, k1=None, w=None, camera_model="pinhole"))
    rewrite(scene, lambda d: d["frames"][0].update(camera_angle_x=None, mask_path=None))
    assert torch.equal(load_transforms(scene).Ks, before.Ks)


@pytest.mark.parametrize("said", [{"w": 80}, {"h": 80}])
def test_one_side_alone_says_what_the_intrinsics_are_for(scene, said):
    """The photos are 40 pixels wide."""
    rewrite(scene, lambda d: d.update(fl_x=100.0, cx=41.0, cy=39.0, **said))
    assert load_transforms(scene).Ks[0].tolist() == [[50, 0, 20.5], [0, 50, 19.5], [0, 0, 1]]


def test_intrinsics_without_a_size_are_for_the_photos_that_the_file_names(scene, truth):
    """Whichever copies of these are used."""
    for index in range(10):
        (scene / "images_2").mkdir(exist_ok=True)
        save_image(scene / "images_2" / f"{index:03d}.png", truth.images[index][::2, ::2])
    rewrite(scene, lambda d: d.update(fl_x=100.0))
    assert load_transforms(scene).Ks[0, 0, 0] == 100
    assert load_dataset(scene, images="images_2").Ks[0, 0, 0] == 50
    (scene / "images" / "000.png").unlink()
    with pytest.raises(InputError, match="images/000 has neither w nor h, and the photo that it names is missing"):
        load_dataset(scene, images="images_2")


@pytest.mark.parametrize(
    ("said", "size"),
    [
        ({"fl_x": 30.0}, (40, 24)),
        ({"camera_angle_x": 1.2}, (40, 24)),
        ({"fl_x": 30.0, "cx": 12.0, "cy": 20.0}, (24, 40)),
        ({"fl_x": 30.0, "cx": 20.0, "cy": 12.0}, (40, 24)),
        ({"camera_angle_x": 1.0, "camera_angle_y": 1.4}, (24, 40)),
    ],
)
def test_photos_on_their_side_are_turned_where_intrinsics_without_a_size_mean_them_upright(tmp_path, said, size):
    """As phones store them; a note says so where the intrinsics do not tell."""
    write_transforms(tmp_path, 4)
    document = json.loads((tmp_path / "transforms.json").read_text())
    frames = [{key: own[key] for key in ("file_path", "transform_matrix")} for own in document["frames"]]
    for frame in frames:
        frame["file_path"] = frame["file_path"].replace(".png", ".jpg")
        write_phone_photo(tmp_path / frame["file_path"], upright_picture(24, 40), orientation=6)
    (tmp_path / "transforms.json").write_text(json.dumps({**said, "frames": frames}))
    views = load_dataset(tmp_path)
    assert views.images.sizes == [size] * 4
    assert views.images[0].shape[:2] == size[::-1]
    assert views.Ks[0, :2, 2].tolist() == [size[0] / 2, size[1] / 2]
    told = [note for note in views.notes if note.startswith("4 of 4 photos lie on their side")]
    assert len(told) == (len(said) == 1)


def test_a_radial_camera_without_distortion_is_a_pinhole(scene):
    before = load_transforms(scene)
    rewrite(scene, lambda d: d.update(camera_model="SIMPLE_RADIAL", k1=0.0))
    assert torch.equal(load_transforms(scene).Ks, before.Ks)


def test_masks_come_from_mask_path_or_a_masks_folder(scene, truth):
    for index in range(10):
        save_image(scene / "images" / f"{index:03d}.png", truth.images[index][..., :3])
    assert not load_transforms(scene).has_masks
    (scene / "masks").mkdir()
    for index in range(10):
        save_image(scene / "masks" / f"{index:03d}.png", truth.images[index][..., 3:])
    torch.testing.assert_close(stack(load_transforms(scene))[..., 3], stack(truth)[..., 3], atol=1 / 255, rtol=0)
    (scene / "masks").rename(scene / "silhouettes")
    rewrite(
        scene,
        lambda d: [f.update(mask_path=f["file_path"].replace("images", "silhouettes") + ".png") for f in d["frames"]],
    )
    torch.testing.assert_close(stack(load_transforms(scene))[..., 3], stack(truth)[..., 3], atol=1 / 255, rtol=0)


def test_the_bounding_sphere_brings_the_object_into_the_unit_sphere(scene, truth):
    views = load_transforms(scene)
    views = views.renormalized(*bounding_sphere(views))
    vertices = views.normalization.apply(truth.normalization.apply(demo_object().vertices))
    assert 0.7 < float(vertices.norm(dim=1).max()) <= 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(k1=0.01), r"lens distortion \(k1\).*etsplat data undistort"),
        (lambda d: d["frames"][3].update(p2=-0.2), r"003 has lens distortion \(p2\)"),
        (lambda d: d.update(camera_model="OPENCV_FISHEYE"), "OPENCV_FISHEYE camera; run `etsplat data undistort"),
        (lambda d: d.update(frames=[]), "no list `frames`"),
        (lambda d: d.pop("frames"), "no list `frames`"),
        (lambda d: d.update(frames=d["frames"][:1]), "at least 2"),
        (lambda d: d["frames"][2].pop("file_path"), "without `file_path`"),
        (lambda d: d["frames"][2].update(file_path="images/absent"), "1 of 10 images are missing"),
        (lambda d: d["frames"][2].pop("transform_matrix"), "002 has no transform_matrix of 16"),
        (lambda d: d["frames"][2].update(transform_matrix=[[1, 2], [3]]), "no transform_matrix of 16"),
        (lambda d: d["frames"][2]["transform_matrix"][0].__setitem__(0, float("nan")), "no transform_matrix of 16"),
        (lambda d: d["frames"][2].update(transform_matrix=torch.diag(torch.tensor([2.0, 2, 2, 1])).tolist()), "scales"),
        (
            lambda d: d["frames"][2].update(transform_matrix=transposed(d)),
            r"002 has .* last row is not 0 0 0 1; .*trans",
        ),
        (lambda d: d.pop("camera_angle_x"), "neither fl_x, K nor camera_angle_x"),
        (lambda d: d.update(fl_x=-3), "not positive"),
        (lambda d: d.update(fl_x="wide"), "not a number"),
        (lambda d: d.update(w=80, h=40), "its camera is for 80x40"),
        (lambda d: d.update(w=float("nan"), h=40), "has the size nanx40"),
        (lambda d: d.update(w=40, h=float("inf")), "has the size 40xinf"),
        (lambda d: d.update(w=0), "has the size 0; correct w and h"),
        (lambda d: d.update(camera_model="EQUIRECTANGULAR"), "has a EQUIRECTANGULAR camera, which is not read; export"),
        (lambda d: d.update(camera_model="SIMPLE_RADIAL", k1=0.1), r"lens distortion \(k1\).*etsplat data undistort"),
        (lambda d: d.update(w=10**400, h=40), "w = 1000.*not a number"),
        (lambda d: d.update(k1=10**400), "k1 = 1000.*not a number"),
        (lambda d: d.update(fl_x=10**400), "fl_x = 1000.*not a number"),
        (lambda d: d.update(fl_x=1e308), "numbers beyond"),
        (lambda d: d.update(fl_x=1e-308), "not positive"),
        (lambda d: d.update(cx=-1e308), "numbers beyond"),
        (lambda d: d.update(camera_angle_x=0), "camera_angle_x = 0, not an angle"),
        (lambda d: d.update(camera_angle_x=float("nan")), "camera_angle_x = nan"),
        (lambda d: d.update(camera_angle_x=10**400), "camera_angle_x = 1000"),
        (lambda d: d["frames"][2].update(transform_matrix=[[10**400] * 4] * 4), "no transform_matrix of 16"),
        (lambda d: d["frames"][2]["transform_matrix"][0].__setitem__(3, 1e308), "002 has .* numbers beyond"),
        (lambda d: d["frames"][2].update(file_path="/"), "'/' leads out"),
        (lambda d: d["frames"][2].update(file_path="a" * 300), "is no file name"),
        (lambda d: d["frames"][2].update(mask_path="a" * 300), "is no file name"),
        (lambda d: d.update(ply_file_path="./"), "is no file name"),
        (lambda d: d.update(ply_file_path=[7]), "is not a file name"),
        (lambda d: d.update(train_filenames=["x"], test_filenames=["y"]), "names none of the frames"),
        (lambda d: d.update(test_filenames=["y"]), r"test_filenames names none of the frames; correct or remove it"),
        (
            lambda d: d.update(train_filenames=["images/000"], val_filenames=["y"]),
            "val_filenames names none of the frames",
        ),
    ],
)
def test_unusable_descriptions_are_one_line_input_errors(scene, change, message):
    rewrite(scene, change)
    with pytest.raises(InputError, match=message) as raised:
        load_transforms(scene)
    assert "\n" not in str(raised.value)


def test_broken_files_are_input_errors(scene, truth):
    (scene / "images" / "004.png").write_bytes((scene / "images" / "004.png").read_bytes()[:60])
    with pytest.raises(InputError, match=r"004\.png"):
        load_transforms(scene)
    (scene / "transforms.json").write_text('{"frames": [')
    with pytest.raises(InputError, match="not valid JSON"):
        load_transforms(scene)
    for deep in ("[" * 100_000, '{"frames":' * 100_000, "9" * 5000):
        (scene / "transforms.json").write_text(deep)
        with pytest.raises(InputError, match="not valid JSON"):
            load_transforms(scene)
    (scene / "transforms.json").write_text("[]")
    with pytest.raises(InputError, match="JSON object"):
        load_transforms(scene)


def test_masks_that_are_missing_or_of_another_size_are_input_errors(scene, truth):
    (scene / "masks").mkdir()
    for index in range(9):
        save_image(scene / "masks" / f"{index:03d}.png", truth.images[index][..., 3:])
    with pytest.raises(InputError, match=r"no mask for image 009\.png"):
        load_transforms(scene)
    save_image(scene / "masks" / "009.png", torch.zeros(20, 30, 1))
    with pytest.raises(InputError, match="resize the mask"):
        load_transforms(scene)
    (scene / "masks" / "009.png").unlink()
    save_image(scene / "masks" / "009_mask.png", truth.images[9][..., 3:])  # as Metashape calls it
    assert load_transforms(scene).has_masks


def test_folders_without_a_scene_are_input_errors(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        load_dataset(tmp_path / "absent")
    (tmp_path / "mesh.obj").write_text("")
    with pytest.raises(InputError, match=r"mesh\.obj: is a file; name the scene's folder"):
        load_dataset(tmp_path / "mesh.obj")
    with pytest.raises(InputError, match="choose the scene's folder"):
        load_dataset(tmp_path)
    with pytest.raises(InputError, match=r"none of transforms\.json"):
        load_transforms(tmp_path)


def test_the_shared_lego_loads_with_its_published_split(shared_data):
    views = load_transforms(shared_data / "scenes" / "lego_blender", width=50)
    assert stack(views).shape == (125, 50, 50, 4)
    assert (len(views.train), len(views.test)) == (100, 25)
    assert float(views.Ks[0, 0, 0]) == pytest.approx(0.5 * 50 / math.tan(0.6911112070083618 / 2))


def test_a_file_in_a_subfolder_that_leads_out_of_it_says_where_to_move_it(scene):
    """Its photos were called missing, by a path that nobody had written. There it is read."""

    def lead_out(document):
        for frame in document["frames"]:
            frame["file_path"] = f"../{frame['file_path'].removeprefix('./')}"

    rewrite(scene, lead_out)
    (scene / "poses").mkdir()
    (scene / "transforms.json").rename(scene / "poses" / "transforms.json")
    with pytest.raises(InputError, match=r"names '\.\./images.*outside of its folder.*; move transforms\.json to"):
        load_transforms(scene / "poses")
    (scene / "poses" / "transforms.json").rename(scene / "transforms.json")
    assert len(load_transforms(scene).images) == 10


def test_a_frame_may_have_a_matrix_of_intrinsics(scene, truth):
    """As captures of people have it, in the place of the numbers."""

    def change(document):
        del document["camera_angle_x"]
        for frame in document["frames"]:
            frame["K"] = [[30.0, 0, 21.0], [0, 31.0, 19.5], [0, 0, 1]]

    rewrite(scene, change)
    torch.testing.assert_close(
        load_transforms(scene).Ks[0], torch.tensor([[30.0, 0, 21.0], [0, 31.0, 19.5], [0, 0, 1]]).double()
    )
    rewrite(scene, lambda document: document["frames"][0]["K"][0].__setitem__(1, 3.0))
    with pytest.raises(InputError, match="has skew"):
        load_transforms(scene)


def test_masks_of_nearly_the_photo_s_size_are_spoken_of(scene, truth):
    """As where photos were freed of distortion, which crops them a little, and their masks were not."""
    (scene / "masks").mkdir()
    for index in range(10):
        mask = torch.nn.functional.pad(truth.images[index][..., 3], (1, 1, 1, 1))
        save_image(scene / "masks" / f"{index:03d}.png", mask[..., None])
    assert any("is 42x42, its photo 40x40" in note for note in load_transforms(scene).notes)
    for index in range(10):
        mask = truth.images[index][..., 3].repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)
        save_image(scene / "masks" / f"{index:03d}.png", mask[..., None])
    assert load_transforms(scene).notes == ()
