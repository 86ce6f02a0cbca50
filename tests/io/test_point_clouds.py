import numpy as np
import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.io.ply_tables import encode_ply, load_points
from etsplat.io.point_clouds import load_cloud

PLACES = np.random.default_rng(0).normal(size=(50, 3))


def write_las(path, colors=None):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=0 if colors is None else 3, version="1.2")
    header.scales = [1e-4] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = PLACES.T
    if colors is not None:
        cloud.red, cloud.green, cloud.blue = colors.T
    cloud.write(str(path))


def write_ply(path, colored):
    names = ["x", "y", "z"]
    table = np.empty(50, [(name, "f4") for name in names] + [(c, "u1") for c in ("red", "green", "blue") if colored])
    for axis, name in enumerate(names):
        table[name] = PLACES[:, axis]
    for name in ("red", "green", "blue") if colored else ():
        table[name] = 51
    path.write_bytes(encode_ply({"vertex": table}))


def test_positions_of_both_kinds_of_files(tmp_path):
    """To a half of LAS's step and to float32 of PLY; without colours none are made up."""
    write_las(tmp_path / "a.las")
    write_ply(tmp_path / "a.ply", colored=False)
    for name in ("a.las", "a.ply"):
        points, colors = load_cloud(tmp_path / name)
        assert points.dtype == torch.float64
        assert float((points - torch.from_numpy(PLACES)).abs().max()) < 6e-5
        assert colors is None


@pytest.mark.parametrize("highest", [255, 65535])
def test_colours_have_8_or_16_bits(tmp_path, highest):
    """LAS has a field of 16, into which some programs write 8."""
    colors = np.linspace(0, highest, 150).astype(np.uint16).reshape(50, 3)
    write_las(tmp_path / "a.las", colors)
    found = load_cloud(tmp_path / "a.las")[1]
    assert found is not None
    assert torch.allclose(found, torch.from_numpy(colors.astype(np.float64) / highest).float())
    write_ply(tmp_path / "a.ply", colored=True)
    found = load_cloud(tmp_path / "a.ply")[1]
    assert found is not None
    assert torch.allclose(found, torch.tensor(0.2))


@pytest.mark.parametrize(("kind", "value"), [("f4", 0.5), ("f4", 127.5), ("i4", 127), ("u1", 127), ("u2", 32767)])
def test_colours_of_points_are_of_any_kind(tmp_path, kind, value):
    """Of floating-point numbers and integers with signs those up to 1 are display values, others are from 0 to 255."""
    table = np.zeros(4, [*((axis, "f4") for axis in "xyz"), *((name, kind) for name in ("red", "green", "blue"))])
    for name in ("red", "green", "blue"):
        table[name] = value
    (tmp_path / "a.ply").write_bytes(encode_ply({"vertex": table}))
    assert load_points(tmp_path / "a.ply")[1] == pytest.approx(0.5, abs=3e-3)
    if kind == "f4" and value < 1:  # of which rounding may have made a little more than 1
        table["red"][0] = 1.0001
        (tmp_path / "a.ply").write_bytes(encode_ply({"vertex": table}))
        assert load_points(tmp_path / "a.ply")[1][1:] == pytest.approx(0.5, abs=3e-3)


@pytest.mark.parametrize("name", ["#", "#x", "#kind"])
def test_other_properties_have_any_name(tmp_path, name):
    """One is no number of corners because of a sign in its name."""
    head = f"ply\nformat ascii 1.0\nelement vertex 1\nproperty float {name}\n"
    places = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(f"{head}{places}end_header\n7 1 2 3\n")
    assert load_points(tmp_path / "a.ply")[0].tolist() == [[1.0, 2.0, 3.0]]


def test_black_scans_have_no_colours(tmp_path):
    write_las(tmp_path / "a.las", np.zeros((50, 3), dtype=np.uint16))
    assert load_cloud(tmp_path / "a.las")[1] is None


def test_what_is_no_cloud_is_refused_with_what_to_do(tmp_path):
    write_las(tmp_path / "a.las")
    whole = (tmp_path / "a.las").read_bytes()
    files = {
        "cut.las": (whole[:-30], "cut short"),
        "header.las": (whole[:100], "damaged, or no LAS"),
        "packed.las": (whole[:104] + bytes([whole[104] | 0x80]) + whole[105:], "is compressed"),
        "records.las": (whole[:100] + b"\xff\xff\xff\xff" + whole[104:], "damaged or cut short"),
        "a.laz": (whole, "convert them to PLY or LAS"),
    }
    for name, (data, why) in files.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=why):
            load_cloud(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        load_cloud(tmp_path / "gone.ply")


@pytest.mark.parametrize("names", [("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")])
def test_colours_of_points_by_other_names(tmp_path, names):
    """Such clouds were grey, without a word. Where there are red, green and blue, these are meant."""
    table = np.zeros(2, [*((axis, "f4") for axis in "xyz"), *((name, "u1") for name in names)])
    for name, value in zip(names, (255, 51, 0), strict=True):
        table[name] = value
    (tmp_path / "a.ply").write_bytes(encode_ply({"vertex": table}))
    found = load_cloud(tmp_path / "a.ply")[1]
    assert found is not None
    assert torch.allclose(found, torch.tensor([1.0, 0.2, 0.0]))
    both = np.zeros(2, table.dtype.descr + [(name, "u1") for name in ("red", "green", "blue")])
    both[names[0]] = 255
    (tmp_path / "b.ply").write_bytes(encode_ply({"vertex": both}))
    found = load_cloud(tmp_path / "b.ply")[1]
    assert found is not None
    assert not found.any()
