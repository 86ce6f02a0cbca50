"""What is not understood of other programs' files is named, in one line or in a note; and their many spellings."""

import json
import math

import pytest
import torch

from etsplat.data.load import load_dataset
from helpers import foreign_captures as foreign


def edited_json(path, change):
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def edited(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def openmvg(change):
    def make(folder):
        foreign.write_openmvg(folder, foreign.truth())
        edited_json(folder / "sfm_data.json", change)

    return make


def meshroom(change=lambda document: None, **settings):
    def make(folder):
        foreign.write_meshroom(folder, foreign.truth(), **settings)
        edited_json(folder / "sfm.json", change)

    return make


def metashape(old="", new="", **settings):
    def make(folder):
        foreign.write_metashape(folder, foreign.truth(), **settings)
        edited(folder / "cameras.xml", old, new)

    return make


def csv(old="", new="", **settings):
    def make(folder):
        foreign.write_reality_capture_csv(folder, foreign.truth(), **settings)
        edited(folder / "registration.csv", old, new)

    return make


def xmp(old="", new="", **settings):
    def make(folder):
        foreign.write_reality_capture_xmp(folder, foreign.truth(), **settings)
        edited(folder / "images" / "photo_002.xmp", old, new)

    return make


def bundler(name, old, new):
    def make(folder):
        foreign.write_bundler(folder, foreign.truth())
        edited(folder / name, old, new)

    return make


def polycam(change):
    def make(folder):
        foreign.write_polycam(folder, foreign.truth())
        edited_json(folder / "keyframes" / "corrected_cameras" / "photo_002.json", change)

    return make


def record3d(change, name=None):
    def make(folder):
        foreign.write_record3d(folder, foreign.truth())
        edited_json(folder / "metadata.json", change)
        if name is not None:
            (folder / "rgb" / "2.png").rename(folder / "rgb" / name)

    return make


def two_tables(folder):
    csv()(folder)
    (folder / "again.csv").write_text((folder / "registration.csv").read_text())


def points_elsewhere(folder):
    foreign.write_metashape(folder, foreign.truth(), translation=(500_000.0, 5_400_000.0, 300.0))
    edited(folder / "points.ply", "end_header\n", "end_header\n")
    foreign.write_points(folder, foreign.truth(center=(5e5, 5.4e6, 300.0)))


def intrinsics(**values):
    return lambda document: document["intrinsics"][0].update(values)


REFUSED = {
    "polycam no focal length": (polycam(lambda d: d.pop("fx")), "photo_002 has no fx"),
    "polycam mirrored": (polycam(lambda d: d.update(t_00=-d["t_00"], t_10=-d["t_10"], t_20=-d["t_20"])), "mirrors"),
    "polycam size": (polycam(lambda d: d.update(width=960)), "its camera is for 960x36"),
    "record3d poses": (record3d(lambda d: d.update(poses=d["poses"][:4])), r"has 4 poses, none for 4\.png"),
    "record3d pose": (record3d(lambda d: d["poses"].__setitem__(2, [0] * 7)), "frame 2 has a pose that is no rotation"),
    "record3d numbers": (record3d(lambda d: d["poses"].__setitem__(2, [0, 1])), "frame 2 has no pose of 7 finite"),
    "record3d name": (record3d(lambda d: None, "cover.png"), r"cover\.png is not the number of a frame"),
    "bundler version": (bundler("bundle.out", "v0.3", "v0.1"), "no bundle file of version 0.3"),
    "bundler list": (bundler("list.txt", "./images/photo_003.png 0 52.5\n", ""), "6 cameras, but the list has 5"),
    "bundler count": (bundler("bundle.out", "6 12\n", "6 1200000000000\n"), "is cut short"),
    "bundler number": (bundler("bundle.out", "52.5 0.0", "far 0.0"), "could not convert"),
    "openmvg kind": (
        openmvg(lambda d: d["intrinsics"][0]["value"].update(polymorphic_name="spherical")),
        "camera 0 is spherical, which is not read",
    ),
    "openmvg rotation": (
        openmvg(lambda d: d["extrinsics"][2]["value"].update(rotation=[[1, 0], [0, 1]])),
        "pose 2 has no rotation of 9",
    ),
    "meshroom kind": (meshroom(intrinsics(type="3deanamorphic4")), "camera 0 is of type 3deanamorphic4, which is not"),
    "meshroom later kind": (
        meshroom(kind="pinhole", distortion="radialk3pt", params=(0.1, 0, 0)),
        "camera 0 is of type radialk3pt",
    ),
    "meshroom count": (meshroom(intrinsics(distortionParams=["0.1"])), "no distortionParams of 3"),
    "meshroom rig": (meshroom(lambda d: d["views"][1].update(rigId="7", subPoseId="0")), "view 1 is of a rig"),
    "metashape k4": (metashape(numbers="<k1>0.1</k1><k4>0.2</k4>"), "with k4, which is not read"),
    "metashape skew": (metashape(numbers="<b2>0.5</b2>"), "with b2, which is not read"),
    "metashape type": (metashape(kind="spherical"), "of type spherical, which is not read"),
    "metashape sensors": (
        metashape('<sensor id="1"', '<sensor id="1" master_id="0"'),
        "is one of several lenses of a camera",
    ),
    "metashape sensor": (metashape('sensor_id="2"', 'sensor_id="42"'), "has no sensor with a calibration"),
    "metashape chunks": (
        metashape("</chunk>", '</chunk><chunk><cameras><camera id="0"/></cameras></chunk>'),
        "has 2 chunks with cameras",
    ),
    "metashape entity": (
        metashape("<document", '<!DOCTYPE a [<!ENTITY b "c">]><document'),
        "declares types or entities",
    ),
    "metashape damaged": (metashape("</sensors>", ""), "not valid XML"),
    "metashape points": (points_elsewhere, "is in another frame"),
    "csv twice": (two_tables, r"2 files say where the cameras are \(again\.csv, registration\.csv\)"),
    "csv k4": (csv(coefficients=(0.1, 0, 0, 0.2, 0, 0)), "has k4, which is not read"),
    "csv number": (csv("photo_002.png,", "photo_002.png,wide,"), "has no place of 3 finite numbers"),
    "csv short": (csv("photo_001.png,", "photo_001.png,1,2\nphoto_001.png,"), "a line of 3 values for 16 columns"),
    "xmp division": (xmp(model="division", coefficients=(0.1, 0, 0, 0, 0, 0)), "has division distortion, which is not"),
    "xmp skew": (xmp('xcr:Skew="0"', 'xcr:Skew="0.1"'), "'photo_002' has skew"),
    "xmp relative": (xmp('"absolute"', '"relative"'), "has relative coordinates"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_understood_is_named_in_one_line(tmp_path, case):
    make, message = REFUSED[case]
    make(tmp_path)
    foreign.check_refused(tmp_path, message)


NOTED = {
    "bundler": (bundler("bundle.out", "52.5 0.0", "0 0.0"), 5, "1 of 6 photos have no pose and are left out"),
    "openmvg": (openmvg(lambda d: d["extrinsics"].pop(1)), 5, "1 of 6 photos have no pose and are left out"),
    "meshroom": (meshroom(lambda d: d["poses"].pop(1)), 5, "1 of 6 photos have no pose and are left out"),
    "metashape disabled": (
        metashape('label="photo_001"', 'label="photo_001" enabled="false"'),
        5,
        "2 of 7 photos are disabled or not aligned and are left out",
    ),
    "metashape component": (
        metashape('sensor_id="1" component_id="0"', 'sensor_id="1" component_id="1"'),
        5,
        "1 of 7 photos are of other components and are left out",
    ),
    "csv columns": (csv(more="accuracy"), 6, "registration.csv: columns that are not read: accuracy"),
    "xmp without pose": (xmp("xcr:Position>", "xcr:Other>"), 5, "1 of 6 photos have XMP without a pose"),
}


@pytest.mark.parametrize("case", NOTED)
def test_what_is_left_out_is_noted(tmp_path, case):
    make, count, note = NOTED[case]
    make(tmp_path)
    if case == "xmp without pose":
        path = tmp_path / "images" / "photo_002.xmp"
        path.write_text(path.read_text().replace("</xcr:Position>", "</xcr:Other>"))
    found = load_dataset(tmp_path)
    assert len(found) == count
    assert any(said.startswith(note) for said in found.notes)


@pytest.mark.parametrize("version", [(1, 0, 0), (1, 2, 0), (1, 2, 1), (1, 2, 2), (1, 2, 4), (1, 2, 5), (1, 2, 9)])
def test_every_version_of_meshrooms_files_says_the_same_camera(tmp_path, version):
    """Pixels that are not square too, in those that can say so."""
    aspect = 1.0 if version < (1, 2, 0) else 1.1
    capture = foreign.truth()
    foreign.write_meshroom(tmp_path, capture, version=version, aspect=aspect)
    expected = capture.Ks.clone()
    expected[:, 1, 1] *= aspect
    torch.testing.assert_close(load_dataset(tmp_path).Ks, expected, atol=1e-9, rtol=1e-9)


def test_cameras_sfm_is_read_like_sfm_json(tmp_path):
    foreign.write_meshroom(tmp_path, foreign.truth())
    (tmp_path / "sfm.json").rename(tmp_path / "cameras.sfm")
    assert len(load_dataset(tmp_path)) == 6


def test_newer_names_of_reality_captures_columns_are_read(tmp_path):
    capture = foreign.truth()
    foreign.write_reality_capture_csv(tmp_path, capture, newer=True)
    torch.testing.assert_close(load_dataset(tmp_path).viewmats, capture.viewmats, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize(
    ("angles", "forward", "up"),
    [
        ((0, 0, 0), (0, 0, -1), (0, 1, 0)),  # straight down, north above
        ((0, 90, 0), (0, 1, 0), (0, 0, 1)),  # level, to the north
        ((90, 90, 0), (1, 0, 0), (0, 0, 1)),  # to the east
        ((180, 60, 0), (0, -math.sin(math.radians(60)), -0.5), None),  # to the south, down
    ],
)
def test_heading_is_clockwise_from_north_and_pitch_from_straight_down(tmp_path, angles, forward, up):
    """Of RealityCapture's CSV, whose z is up and y north."""
    foreign.write_photos(tmp_path, foreign.truth(2))
    rows = "".join(f"{name}.png,1,2,3,{','.join(map(str, angles))},30\n" for name in ("photo_000", "photo_001"))
    (tmp_path / "r.csv").write_text("#name,x,y,alt,heading,pitch,roll,f\n" + rows)
    rotation = load_dataset(tmp_path).viewmats[0, :3, :3]
    assert rotation[2].tolist() == pytest.approx(forward, abs=1e-12)
    if up is not None:
        assert (-rotation[1]).tolist() == pytest.approx(up, abs=1e-12)


def test_polycams_own_poses_are_read_where_it_corrected_none(tmp_path):
    capture = foreign.truth()
    foreign.write_polycam(tmp_path, capture, corrected=False)
    torch.testing.assert_close(load_dataset(tmp_path).viewmats, capture.viewmats)


def test_record3d_without_intrinsics_for_each_frame_takes_those_of_all(tmp_path):
    capture = foreign.truth(2)
    capture = foreign.Truth(
        capture.names,
        [(48, 36)] * 2,
        capture.viewmats,
        capture.Ks[:1].expand(2, 3, 3),
        [capture.photos[0]] * 2,
        capture.points,
        capture.colors,
    )
    foreign.write_record3d(tmp_path, capture, each=False)
    torch.testing.assert_close(load_dataset(tmp_path).Ks, capture.Ks)


def test_bundlers_list_may_have_spaces_in_names_and_no_focal_lengths(tmp_path):
    capture = foreign.truth(2)
    foreign.write_bundler(tmp_path, capture)
    (tmp_path / "images" / "photo_001.png").rename(tmp_path / "images" / "photo 001.png")
    (tmp_path / "list.txt").write_text("photo_000.png\nD:\\them\\photo 001.png 0 17.5\n")
    assert load_dataset(tmp_path).names == ["photo 001", "photo_000"]
