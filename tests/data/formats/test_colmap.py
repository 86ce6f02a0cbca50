import struct
import tracemalloc

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.demo_object import demo_object
from etsplat.data.hull import bounding_sphere
from etsplat.data.load import load_dataset
from etsplat.data.photograph import photograph
from etsplat.io.images import save_image
from helpers.captures import quaternion, write_colmap

NAMES = [f"photo {k:02d}.png" for k in range(10)]


def load_colmap(folder, masks=None, width=None):
    return load_dataset(folder, masks_as="alpha", masks=masks, width=width)


def stack(views):
    """(B, H, W, 4) of all photos."""
    return torch.stack(list(views.images))


@pytest.fixture(scope="module")
def truth():
    return photograph(demo_object(), 40, 30, elevations=(-30.0, 20.0), azimuths=5, supersampling=2)


def write_scene(folder, views, binary, model=("PINHOLE", 1), distortion=0.01):
    """One camera per image; its numbers double those of the images, which are half-size copies."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (folder / "images").mkdir()
    K, (W, H) = 2 * views.Ks[0], [2 * side for side in views.images.sizes[0]]
    params = [float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])]
    if model[0] == "SIMPLE_PINHOLE":
        params = params[1:]
    elif model[0] == "SIMPLE_RADIAL":
        params = [*params[1:], distortion]
    camera_bytes, image_bytes = struct.pack("<Q", 1), struct.pack("<Q", len(views))
    camera_text, image_text = "# cameras\n", "# images\n"
    camera_bytes += struct.pack(f"<iiQQ{len(params)}d", 3, model[1], W, H, *params)
    camera_text += f"3 {model[0]} {W} {H} {' '.join(repr(p) for p in params)}\n"
    for index in reversed(range(len(views))):  # files need not be in the order of names
        viewmat, name = views.viewmats[index], NAMES[index]
        save_image(folder / "images" / name, views.images[index][..., :3])
        pose = [*quaternion(viewmat[:3, :3]), *viewmat[:3, 3].tolist()]
        points = [(1.0, 2.0, -1), (3.0, 4.5, 7)] if index % 2 else []
        image_bytes += struct.pack("<I7dI", index, *pose, 3) + name.encode() + b"\0" + struct.pack("<Q", len(points))
        image_bytes += b"".join(struct.pack("<ddq", *point) for point in points)
        image_text += (
            f"{index} {' '.join(repr(p) for p in pose)} 3 {name}\n{' '.join(f'{a} {b} {c}' for a, b, c in points)}\n"
        )
    if binary:
        (sparse / "cameras.bin").write_bytes(camera_bytes)
        (sparse / "images.bin").write_bytes(image_bytes)
    else:
        (sparse / "cameras.txt").write_text(camera_text)
        (sparse / "images.txt").write_text(image_text)


def write_masks(folder, views):
    folder.mkdir()
    for name, image in zip(NAMES, views.images, strict=True):
        save_image(folder / f"{name}.png", image[..., 3:])


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
@pytest.mark.parametrize("model", [("PINHOLE", 1), ("SIMPLE_PINHOLE", 0)], ids=lambda model: model[0])
def test_cameras_images_names_and_split_return(tmp_path, truth, binary, model):
    write_scene(tmp_path, truth, binary, model)
    views = load_colmap(tmp_path)
    torch.testing.assert_close(views.viewmats, truth.viewmats, atol=1e-5, rtol=0)
    torch.testing.assert_close(views.Ks, truth.Ks)
    torch.testing.assert_close(stack(views)[..., :3], stack(truth)[..., :3], atol=1 / 255, rtol=0)
    assert views.test == [0, 8]
    assert views.names == [name.removesuffix(".png") for name in NAMES]
    assert not views.has_masks


def test_masks_are_found_beside_the_images_or_where_told(tmp_path, truth):
    write_scene(tmp_path / "scene", truth, True)
    write_masks(tmp_path / "elsewhere", truth)
    told = load_colmap(tmp_path / "scene", tmp_path / "elsewhere")
    torch.testing.assert_close(stack(told)[..., 3], stack(truth)[..., 3], atol=1 / 255, rtol=0)
    (tmp_path / "elsewhere").rename(tmp_path / "scene" / "masks")
    assert torch.equal(stack(load_colmap(tmp_path / "scene")), stack(told))
    unit = told.renormalized(*bounding_sphere(told))
    vertices = unit.normalization.apply(truth.normalization.apply(demo_object().vertices))
    assert float(vertices.norm(dim=1).max()) <= 1


def test_an_object_without_masks_says_what_to_add(tmp_path, truth):
    write_scene(tmp_path, truth, True)
    with pytest.raises(InputError, match="add a folder masks/"):
        bounding_sphere(load_colmap(tmp_path))


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
def test_distorted_cameras_name_the_undistorter(tmp_path, truth, binary):
    write_scene(tmp_path, truth, binary, ("SIMPLE_RADIAL", 2))
    with pytest.raises(InputError, match=r"SIMPLE_RADIAL.*colmap image_undistorter"):
        load_colmap(tmp_path)


def test_a_lens_that_distorts_by_nothing_is_none(tmp_path, truth):
    """COLMAP writes its usual model for photos without distortion, too."""
    write_scene(tmp_path, truth, True, ("SIMPLE_RADIAL", 2), distortion=0.0)
    assert load_colmap(tmp_path).Ks[0, 0, 0] == pytest.approx(float(truth.Ks[0, 1, 1]))


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.99])
def test_binary_files_cut_anywhere_are_input_errors(tmp_path, truth, name, part):
    write_scene(tmp_path, truth, True)
    path = tmp_path / "sparse" / "0" / name
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * part)])
    with pytest.raises(InputError, match=rf"{name}.*cut short"):
        load_colmap(tmp_path)


@pytest.mark.parametrize("count", [10**6, 2**40, 2**64 - 1])
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_counts_beyond_the_file_take_no_memory(tmp_path, truth, name, count):
    """Of records, and of the key points of an image and the track of a point."""
    write_scene(tmp_path, truth, True)
    sparse = tmp_path / "sparse" / "0"
    track = struct.pack("<QQ3d3Bd", 2, 1, 0, 0, 0, 9, 9, 9, 0) + struct.pack("<Q", count) + bytes(8)
    (sparse / "points3D.bin").write_bytes(track)
    data = (sparse / name).read_bytes()
    if name == "images.bin":
        (sparse / "points3D.bin").unlink()
        name_end = data.index(b"\0", 8 + struct.calcsize("<I7dI")) + 1
        files = [struct.pack("<Q", count) + data[8:], data[:name_end] + struct.pack("<Q", count) + data[name_end + 8 :]]
    else:
        files = [struct.pack("<Q", count) + data[8:]] + [data] * (name == "points3D.bin")
    for content in files:
        (sparse / name).write_bytes(content)
        tracemalloc.start()
        try:
            with pytest.raises(InputError, match=rf"{name}.*cut short"):
                load_colmap(tmp_path)
            assert tracemalloc.get_traced_memory()[1] < 1 << 20
        finally:
            tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("cameras.txt", "3 PINHOLE", "three PINHOLE"),
        ("cameras.txt", "3 PINHOLE 80 60", "3 PINHOLE"),
        ("images.txt", "9 ", "9 x "),
        ("images.txt", " 3 photo 09.png", ""),
    ],
)
def test_malformed_text_lines_are_quoted(tmp_path, truth, name, old, new):
    write_scene(tmp_path, truth, False)
    path = tmp_path / "sparse" / "0" / name
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=rf"{name}: malformed line"):
        load_colmap(tmp_path)


def test_missing_parts_are_input_errors(tmp_path, truth):
    (tmp_path / "sparse").mkdir()
    with pytest.raises(InputError, match=r"no sparse/0/cameras\.bin"):
        load_colmap(tmp_path)
    (tmp_path / "sparse").rmdir()
    write_scene(tmp_path, truth, True)
    with pytest.raises(InputError, match=r"masks .*: no such folder"):
        load_colmap(tmp_path, tmp_path / "absent")
    with pytest.raises(
        InputError, match=r"masks auto: no such folder; `etsplat data masks SCENE --out SCENE/masks` makes"
    ):
        load_colmap(tmp_path, "auto")  # an option of `data sfm`
    (tmp_path / "images" / NAMES[4]).unlink()
    with pytest.raises(InputError, match=rf"1 of 10 images are missing.*{NAMES[4]}"):
        load_colmap(tmp_path)
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    with pytest.raises(InputError, match=r"images\.txt: no such file"):
        load_colmap(tmp_path)


def test_photos_in_another_folder_of_the_scene_are_offered(tmp_path, truth):
    """As 3DGS lays them out: they were called missing."""
    write_scene(tmp_path, truth, True)
    (tmp_path / "images").rename(tmp_path / "input")
    with pytest.raises(
        InputError, match=r"10 of 10 images are missing .*they are in input/, which images=.input. takes"
    ):
        load_colmap(tmp_path)
    assert len(load_dataset(tmp_path, images="input")) == 10


@pytest.mark.parametrize(("scene", "count"), [("fountain-P11", 11), ("lund", 27), ("fox", 50)])
def test_the_shared_captures_load(shared_data, scene, count):
    views = load_colmap(shared_data / "scenes" / scene, width=64)
    assert len(views) == count
    assert {width for width, _ in views.images.sizes} == {64}
    rotation = views.viewmats[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand(count, 3, 3), atol=1e-5, rtol=0)


def test_the_shared_lego_has_the_same_cameras_in_both_layouts(shared_data):
    """The COLMAP copy was made from the Blender scene; poses agree view by view."""
    colmap = load_colmap(shared_data / "scenes" / "lego", width=16)
    blender = load_dataset(shared_data / "scenes" / "lego_blender", width=16)
    index = blender.names.index("train_r_7")
    other = colmap.names.index("train_007")
    torch.testing.assert_close(colmap.viewmats[other], blender.viewmats[index], atol=1e-4, rtol=0)


def test_of_several_models_the_one_with_the_most_images_is_read_and_noted(tmp_path, truth):
    """COLMAP's mapper numbers them as it makes them. Those that cannot be read count for nothing."""
    write_scene(tmp_path, truth, True)
    whole, sparse = load_colmap(tmp_path), tmp_path / "sparse"
    (sparse / "0").rename(sparse / "1")
    alone = load_colmap(tmp_path)
    assert (alone.names, alone.notes) == (whole.names, ())
    write_colmap(tmp_path / "other", [(80, 60)] * 3)
    (tmp_path / "other" / "sparse" / "0").rename(sparse / "0")
    (sparse / "10").mkdir()
    (sparse / "10" / "cameras.bin").write_bytes(b"")
    found = load_colmap(tmp_path)
    assert found.names == whole.names
    assert torch.equal(found.viewmats, whole.viewmats)
    assert found.notes == ("3 models in sparse/: 1, which has the most images, is read, and no other",)


MODELS = {
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, 12),
    "SIMPLE_DIVISION": (12, 1),
    "DIVISION": (13, 1),
    "SIMPLE_FISHEYE": (14, 0),
    "FISHEYE": (15, 0),
    "EUCM": (16, 2),
}
"""Numbers of COLMAP's newer camera models, and of their parameters beside focal lengths and principal point."""


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
@pytest.mark.parametrize("model", MODELS)
def test_newer_camera_models_are_named_with_the_remedy(tmp_path, truth, model, binary):
    write_scene(tmp_path, truth, True)
    number, count = MODELS[model]
    params = [80.0] * (1 if "SIMPLE" in model else 2) + [40.0, 30.0] + [0.1] * count
    sparse = tmp_path / "sparse" / "0"
    (sparse / "cameras.bin").write_bytes(struct.pack(f"<QiiQQ{len(params)}d", 1, 3, number, 80, 60, *params))
    if not binary:
        (sparse / "cameras.bin").unlink()
        (sparse / "cameras.txt").write_text(f"3 {model} 80 60 {' '.join(map(str, params))}\n")
    with pytest.raises(InputError, match=rf" a {model} camera with lens distortion; run `etsplat data undistort"):
        load_colmap(tmp_path)


def test_cameras_all_around_and_unknown_ones_say_what_to_do(tmp_path, truth):
    write_scene(tmp_path, truth, True)
    path = tmp_path / "sparse" / "0" / "cameras.bin"
    path.write_bytes(struct.pack("<QiiQQ2d", 1, 3, 17, 80, 60, 80.0, 60.0))
    with pytest.raises(InputError, match="has an EQUIRECTANGULAR camera, which is not read; make perspective pictures"):
        load_colmap(tmp_path)
    path.write_bytes(struct.pack("<QiiQQ2d", 1, 3, 18, 80, 60, 80.0, 60.0))
    with pytest.raises(InputError, match="unknown camera model 18; run `colmap image_undistorter`"):
        load_colmap(tmp_path)


EDITS = {
    "byte order mark": lambda text: "\ufeff" + text,
    "end": lambda text: text + "\n\n",
    "head": lambda text: text.replace("# images\n", "# images\n\n"),
    "stripped": lambda text: "".join(f"{line}\n" for line in text.splitlines() if line),
    "no key points": lambda text: "".join(f"{line}\n" for line in text.splitlines() if "photo" in line),
    "numbers as names": lambda text: "".join(
        f"{line.replace('photo ', '').replace('.png', '')}\n" for line in text.splitlines() if "photo" in line
    ),
}


@pytest.mark.parametrize("edit", EDITS)
def test_texts_that_were_edited_have_the_same_images(tmp_path, truth, edit):
    """Empty lines of key points may be left out, others added."""
    write_scene(tmp_path, truth, False)
    whole = load_colmap(tmp_path)
    if edit == "numbers as names":
        for name in NAMES:
            (tmp_path / "images" / name).rename(tmp_path / "images" / name.removeprefix("photo "))
    for name in ("cameras.txt", "images.txt") if edit == "byte order mark" else ("images.txt",):
        path = tmp_path / "sparse" / "0" / name
        path.write_text(EDITS[edit](path.read_text()), encoding="utf-8")
    found = load_colmap(tmp_path)
    assert [name[-2:] for name in found.names] == [name[-2:] for name in whole.names]
    assert torch.equal(found.viewmats, whole.viewmats)
