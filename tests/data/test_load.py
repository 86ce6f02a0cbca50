import json
import re
import shutil
import tracemalloc

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data import formats
from etsplat.data.load import load_dataset
from etsplat.data.photo_intake import list_photos
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import load_source
from helpers.captures import circle_poses, write_colmap, write_photo, write_transforms

SIZES = [(40, 30), (30, 40), (20, 20)] * 3


def project(capture, points, view):
    camera = capture.cameras[view]
    p = points @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
    q = p @ camera.Ks[0].T
    return q[:, :2] / q[:, 2:]


def test_every_view_keeps_its_own_size_camera_and_8_bit_pixels(tmp_path):
    write_colmap(tmp_path, SIZES)
    capture = load_dataset(tmp_path)
    assert [(camera.width, camera.height) for camera in capture.cameras] == SIZES
    for index, (image, (width, height)) in enumerate(zip(capture.images, SIZES, strict=True)):
        stored = np.array(Image.open(tmp_path / "images" / f"{index:04d}.jpg"))
        assert torch.equal(image, torch.from_numpy(stored))
        assert capture.cameras[index].Ks[0, :2, 2].tolist() == [width / 2 + 1, height / 2]
    assert (capture.test, len(capture.train)) == ([0, 8], 7)
    assert capture.points.shape == (20, 3)
    assert 0.1 < float(capture.point_colors.mean()) < 0.9


def test_images_wider_than_1600_shrink_to_it_and_width_shrinks_further(tmp_path):
    write_colmap(tmp_path, [(1640, 820), (1600, 800)])
    capture = load_dataset(tmp_path)
    assert capture.images.sizes == [(1600, 800), (1600, 800)]
    torch.testing.assert_close(capture.Ks[0, 0, 0], torch.tensor(1600.0, dtype=torch.float64))
    assert load_dataset(tmp_path, width=100).images.sizes == [(100, 50)] * 2
    assert load_dataset(tmp_path, width=5000).images.sizes == [(1640, 820), (1600, 800)]


def test_a_folder_of_smaller_copies_with_other_endings_is_used_on_request(tmp_path):
    write_colmap(tmp_path, [(40, 30)] * 3)
    for index in range(3):
        write_photo(tmp_path / "images_2" / f"{index:04d}.PNG", 20, 15, seed=index)
    capture = load_dataset(tmp_path, images="images_2")
    assert capture.images.sizes == [(20, 15)] * 3
    torch.testing.assert_close(capture.Ks[0, 0, 0], torch.tensor(20.0, dtype=torch.float64))
    with pytest.raises(InputError, match="no folder images_8"):
        load_dataset(tmp_path, images="images_8")


@pytest.mark.parametrize(("scale", "center"), [(1000.0, 0.0), (0.001, 0.0), (1.0, 5e6)])
def test_normalized_has_extent_1_whatever_the_units_and_sees_the_same_pixels(tmp_path, scale, center):
    """Also for a scene with coordinates as maps have them, which float32 could not hold to a pixel."""
    poses = circle_poses(9, center=(center, 0.0, -center), radius=3 * scale)
    write_colmap(tmp_path, [(40, 30)] * 9, poses=poses, points=0)
    capture = load_dataset(tmp_path)
    unit = capture.normalized()
    assert unit.extent == pytest.approx(1.0, rel=1e-6)
    assert float(unit.centers[unit.train].mean(dim=0).abs().max()) < 1e-6
    points = torch.tensor([[0.1, 0.0, 0.05], [0.0, -0.1, 0.0]], dtype=torch.float64)
    world = unit.normalization.invert(points)
    viewmat, K = capture.viewmats[3], capture.Ks[3]
    q = (world @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    torch.testing.assert_close(project(unit, points.float(), 3), (q[:, :2] / q[:, 2:]).float(), atol=1e-3, rtol=0)


def test_cameras_at_one_place_leave_the_units_alone(tmp_path):
    pose = circle_poses(1)[0]
    write_colmap(tmp_path, [(16, 12)] * 3, poses=[pose] * 3)
    capture = load_dataset(tmp_path)
    assert capture.extent == 1.0
    assert capture.normalized().normalization.radius == 1.0


def test_a_set_larger_than_memory_is_streamed_with_the_same_pixels(tmp_path):
    write_colmap(tmp_path, [(40, 30)] * 9)
    whole = load_dataset(tmp_path)
    streamed = load_dataset(tmp_path, memory=3 * 40 * 30 * 2)
    assert (whole.images.streamed, streamed.images.streamed) == (False, True)
    streamed.images.expect([5, 6])
    for index in (5, 6, 0, 8, 5, 1):
        assert torch.equal(streamed.images[index], whole.images[index])
        assert len(streamed.images._kept) <= 2


def test_1300_views_load(tmp_path):
    write_transforms(tmp_path, 1300, width=8, height=6)
    capture = load_dataset(tmp_path)
    assert (len(capture), len(capture.test), capture.images.sizes[7]) == (1300, 163, (8, 6))


def test_the_fingerprint_follows_the_content_of_every_photo_and_mask(tmp_path):
    """A copy has the same, however old its files are; another pixel in any photo or mask changes it."""
    write_colmap(tmp_path / "a", [(40, 30)] * 4)
    for index in range(4):
        write_photo(tmp_path / "a" / "masks" / f"{index:04d}.png", 40, 30)
    shutil.copytree(tmp_path / "a", tmp_path / "b", copy_function=shutil.copy)
    first = load_dataset(tmp_path / "a", preload=False).fingerprint()
    assert load_dataset(tmp_path / "b", memory=1).fingerprint() == first
    for file in ("images/0003.jpg", "masks/0002.png"):
        write_photo(tmp_path / "b" / file, 40, 30, seed=99)
        changed = load_dataset(tmp_path / "b").fingerprint()
        assert changed != first
        first = changed


def test_masks_are_found_whatever_the_capitals_of_their_ending(tmp_path):
    """An image's own name with another ending, or with one added."""
    write_transforms(tmp_path, 3)
    for name in ("0000.PNG", "0001.JPG", "0002.png.PNG"):
        write_photo(tmp_path / "masks" / name, 16, 12)
    masks = load_dataset(tmp_path).images
    assert all(masks.mask(index) is not None for index in range(3))


def test_transparent_images_are_premultiplied_and_masks_come_apart(tmp_path):
    write_transforms(tmp_path / "rgba", 3, channels=4)
    capture = load_dataset(tmp_path / "rgba")
    image = capture.images[1]
    assert image.shape == (12, 16, 4)
    assert bool((image[..., :3] <= image[..., 3:]).all())
    assert capture.images.mask(1) is None
    assert capture.points is None
    write_transforms(tmp_path / "masked", 3)
    for index in range(3):
        write_photo(tmp_path / "masked" / "masks" / f"{index:04d}.png", 16, 12)
    masked = load_dataset(tmp_path / "masked", width=8)
    assert masked.images[1].shape == (6, 8, 3)
    assert masked.images.mask(1).shape == (6, 8)


def test_points_of_ply_file_path_are_read(tmp_path):
    write_transforms(tmp_path, 3, ply_file_path="points.ply")
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    header += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    (tmp_path / "points.ply").write_text(header + "1 2 3 255 0 51\n4 5 6 0 0 0\n")
    capture = load_dataset(tmp_path)
    assert capture.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    torch.testing.assert_close(capture.point_colors[0], torch.tensor([1.0, 0.0, 0.2]))


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", [1000, 2**40, 10**15 - 1])
def test_points_beyond_their_file_take_no_memory(tmp_path, kind, count):
    write_transforms(tmp_path, 3, ply_file_path="points.ply")
    head = f"ply\nformat {kind} 1.0\nelement vertex {count}\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "points.ply").write_bytes(f"{head}end_header\n".encode() + b"0 0 0\n" * 20)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"points\.ply: (is cut short|vertex cannot be read)"):
            load_dataset(tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ("float x float y float z float x", "'x' occurs more than once"),
        ("float x float y", "lacks the property z"),
        ("float x float y float z list uchar int odd", "cannot read `property list"),
    ],
)
def test_points_without_places_are_refused_by_the_name_of_their_file(tmp_path, properties, message):
    write_transforms(tmp_path, 3, ply_file_path="points.ply")
    lines = "".join(f"property {line}\n" for line in re.findall(r"(?:list \w+ )?\w+ \w+", properties))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 2\n{lines}end_header\n"
    (tmp_path / "points.ply").write_bytes(head.encode() + bytes(200))
    with pytest.raises(InputError, match=rf"points\.ply: {message}|points\.ply: .*{message}"):
        load_dataset(tmp_path)


def test_extra_photos_are_noted_unused_cameras_ignored_and_points_may_be_missing(tmp_path):
    write_colmap(tmp_path, [(16, 12)] * 4, points=0)
    write_photo(tmp_path / "images" / "unregistered.jpg", 50, 50)
    cameras = tmp_path / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text() + "77 PINHOLE 9 9 5 5 4 4\n")
    capture = load_dataset(tmp_path)
    assert len(capture) == 4
    assert capture.points is None
    assert capture.notes == ("1 of 5 photos have no pose and are left out",)
    (tmp_path / "sparse" / "0" / "points3D.txt").write_text("# nothing\n")
    assert load_dataset(tmp_path).points is None


def _truncate(folder):
    path = folder / "images" / "0002.jpg"
    path.write_bytes(path.read_bytes()[:200])


def _shrink(folder):
    """Whose ratio of sides says nothing."""
    write_photo(folder / "images" / "0002.jpg", 1, 1)


def _points(number):
    return lambda folder: (folder / "sparse" / "0" / "points3D.txt").write_text(f"1 0 0 {number} 0 0 0\n")


def _pose(number):
    """The first image's, with another number for each of its 7."""
    row = f"1 {' '.join([number] * 7)} 1 0000.jpg"
    return lambda folder: (folder / "sparse" / "0" / "images.txt").write_text(f"{row}\n\n")


def _name(name):
    return lambda folder: (folder / "sparse" / "0" / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 {name}\n\n")


def _camera(line):
    return lambda folder: (folder / "sparse" / "0" / "cameras.txt").write_text(
        "".join(f"{index} {line}\n" for index in range(9))
    )


def _resize(folder):
    write_photo(folder / "images" / "0002.jpg", 16, 16)


@pytest.mark.parametrize("memory", [None, 1])  # kept, and streamed
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_truncate, r"0002\.jpg"),
        (_resize, "0002.jpg is 16x16, but its camera is for 16x12"),
        (_shrink, "0002.jpg is 1x1, but its camera is for 16x12"),
        (_points("1e308"), "has points farther away than"),
        (_pose("1e308"), "not finite"),
        (_pose("nan"), "not finite"),
        (_pose("1e30"), "0000.jpg has a pose or camera with numbers beyond"),
        (_name("x" * 300), "is no file name"),
        (_name("x/.."), "1 of 1 images are missing"),
        (_camera("PINHOLE 16 12 1e308 1e308 8 6"), "numbers beyond"),
        (_camera("PINHOLE 16 12 nan 10 8 6"), "not positive"),
        (_camera("PINHOLE 16 12 10 10 8 inf"), "numbers beyond"),
        (_camera(f"PINHOLE {10**400} 12 10 10 8 6"), "has no size"),
        (_camera("PINHOLE 16 0 10 10 8 6"), "has no size"),
        (_camera("NONE 16 12 10 10 8 6"), "unknown camera model NONE; run `colmap image_undistorter`"),
        (_camera("PINHOLE 16 12 10 10 8"), "malformed"),
        (lambda folder: (folder / "images" / "0001.jpg").unlink(), "1 of 4 images are missing"),
        (lambda folder: (folder / "sparse" / "0" / "points3D.txt").write_text("1 2 x"), "malformed line"),
        (lambda folder: (folder / "sparse" / "0" / "images.txt").write_text(""), "no registered image"),
    ],
)
def test_damaged_captures_are_one_line_input_errors(tmp_path, damage, message, memory):
    write_colmap(tmp_path, [(16, 12)] * 4)
    damage(tmp_path)
    with pytest.raises(InputError, match=message) as raised:
        load_dataset(tmp_path, memory=memory)
    assert "\n" not in str(raised.value)


def test_one_image_and_repeated_images_are_input_errors(tmp_path):
    write_colmap(tmp_path / "one", [(16, 12)])
    with pytest.raises(InputError, match="at least 2"):
        load_dataset(tmp_path / "one")
    write_transforms(tmp_path / "twice", 3)
    path = tmp_path / "twice" / "transforms.json"
    document = json.loads(path.read_text())
    document["frames"][2] = document["frames"][1]
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"2 frames have the image images/0001\.png"):
        load_dataset(tmp_path / "twice")


def test_a_folder_of_photos_is_told_how_to_find_its_cameras(tmp_path):
    write_photo(tmp_path / "a.jpg", 16, 12)
    with pytest.raises(InputError, match="etsplat data sfm"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("scene", ["kitchen25", "lego_blender"])
def test_the_shared_captures_load(shared_data, scene):
    capture = load_dataset(shared_data / "scenes" / scene, width=80)
    assert all(width == 80 for width, _ in capture.images.sizes)
    assert (capture.points is None) == (scene == "lego_blender")


def test_a_layout_of_ones_own_is_one_module(tmp_path, monkeypatch):
    """It is found by being there, comes in its rank, and is named where no layout fits."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "poses_txt.py").write_text(
        """
import torch
from etsplat.data.frames import Frame, Listing

MARK, RANK = "poses.txt", 0


def recognises(folder):
    return (folder / "poses.txt").is_file()


def list_frames(folder, wanted):
    frames = []
    for line in (folder / "poses.txt").read_text().splitlines():
        name, focal, z = line.split()
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[2, 3] = float(z)
        K = torch.tensor([[float(focal), 0, 8], [0, float(focal), 6], [0, 0, 1]], dtype=torch.float64)
        frames.append(Frame(name, folder / name, None, viewmat, K, (16, 12)))
    return Listing(frames)
"""
    )
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(tmp_path / "code")])
    write_transforms(tmp_path / "scene", 3)
    (tmp_path / "scene" / "poses.txt").write_text("images/0001.png 20 3\nimages/0002.png 30 4\n")
    dataset = load_dataset(tmp_path / "scene", width=8)
    assert (dataset.names, dataset.train, dataset.test) == (["images_0001", "images_0002"], [1], [0])
    assert dataset.Ks[1, 0].tolist() == [15, 0, 4]
    assert dataset.images.sizes == [(8, 6)] * 2
    with pytest.raises(InputError, match=r"none of poses\.txt, transforms\.json, sparse/, .* in it"):
        load_dataset(tmp_path / "code")


def test_masks_count_as_transparency_or_say_what_to_ignore(tmp_path):
    """The same folder as an object and as a scene; photos of an object may have different sizes, too."""
    write_colmap(tmp_path, SIZES)
    for index, (width, height) in enumerate(SIZES):
        write_photo(tmp_path / "masks" / f"{index:04d}.png", width, height, seed=100 + index)
    scene = load_dataset(tmp_path)
    whole = load_dataset(tmp_path, masks_as="alpha", memory=40 * 30 * 16 * 2)
    assert whole.images.streamed
    assert (scene.has_masks, whole.has_masks) == (False, True)
    assert torch.equal(scene.Ks, whole.Ks)
    for index, (width, height) in enumerate(SIZES):
        photo, mask = scene.images[index].float() / 255, scene.images.mask(index).float() / 255
        assert (scene.images[index].dtype, whole.images[index].dtype) == (torch.uint8, torch.float32)
        assert whole.images[index].shape == (height, width, 4)
        assert whole.images.mask(index) is None
        torch.testing.assert_close(whole.images[index][..., 3], mask, atol=1 / 255, rtol=0)
        torch.testing.assert_close(whole.images[index][..., :3], photo * mask[..., None], atol=1 / 255, rtol=0)
    assert whole.fingerprint() == load_dataset(tmp_path, masks_as="alpha").fingerprint()


def test_masks_of_half_the_size_are_enlarged_as_transparency_too(tmp_path):
    write_transforms(tmp_path, 3)
    for index in range(3):
        write_photo(tmp_path / "masks" / f"{index:04d}.png", 8, 6, seed=index)
    scene, whole = load_dataset(tmp_path), load_dataset(tmp_path, masks_as="alpha")
    for index in range(3):
        mask = scene.images.mask(index).float() / 255
        torch.testing.assert_close(whole.images[index][..., 3], mask, atol=1 / 255, rtol=0)
    write_photo(tmp_path / "masks" / "0001.png", 8, 8)
    with pytest.raises(InputError, match=r"0001\.png: is 8x8, its image is 16x12; resize the mask"):
        load_dataset(tmp_path, masks_as="alpha")


def test_a_folder_that_is_called_nearly_as_that_of_masks_is_noted(tmp_path):
    write_colmap(tmp_path, [(16, 12)] * 3)
    write_photo(tmp_path / "mask" / "0001.png", 16, 12)
    found = load_dataset(tmp_path)
    assert found.images.mask(1) is None
    assert found.notes[0].startswith("mask/ is not read: call it masks/")
    shutil.copytree(tmp_path / "images", tmp_path / "masks")
    assert load_dataset(tmp_path).notes == ()


def test_a_part_of_a_scene_and_what_it_lies_in_say_which_folder_is_meant(tmp_path, monkeypatch):
    scene = tmp_path / "scan" / "dense"
    write_colmap(scene, [(16, 12)] * 3)
    (scene / "keyframes" / "cameras").mkdir(parents=True)
    for part in ("sparse", "sparse/0", "images", "keyframes"):
        with pytest.raises(InputError, match=rf"choose the scene's folder: did you mean {scene}\?"):
            load_dataset(scene / part)
    with pytest.raises(InputError, match=rf"did you mean {scene}\?"):
        load_dataset(tmp_path / "scan")
    monkeypatch.chdir(scene / "images")
    with pytest.raises(InputError, match=rf"did you mean {scene}\?"):
        load_dataset(".")


@pytest.mark.parametrize("name", ["cap.zip", "scan.r3d", "scan.tar.gz"])
def test_archives_are_to_be_unpacked(tmp_path, name):
    (tmp_path / name).write_bytes(b"PK")
    for read in (load_dataset, list_photos, lambda path: load_source(path, ReconstructConfig())):
        with pytest.raises(InputError, match=f"{name}: is an archive; unpack it and name the folder"):
            read(tmp_path / name)
