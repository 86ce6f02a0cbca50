"""What other programs write of a capture whose cameras are known: a writer for each, by what describes its files."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from helpers.captures import circle_poses, opengl_pose, quaternion

FLIP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Truth:
    """A capture: photos with noise, cameras that look at something, coloured points.

    Attributes:
        names: of the photos, sorted.
        sizes: of the photos; one stands upright.
        viewmats: (N, 4, 4) float64.
        Ks: (N, 3, 3) float64; square pixels, the principal point away from the middle.
        photos: (H, W, 3) uint8.
        points: (P, 3) float64.
        colors: (P, 3) whole numbers from 0 to 255.
    """

    names: Sequence[str]
    sizes: Sequence[tuple[int, int]]
    viewmats: torch.Tensor
    Ks: torch.Tensor
    photos: Sequence[np.ndarray]
    points: torch.Tensor
    colors: np.ndarray

    @property
    def centers(self) -> np.ndarray:
        """(N, 3) where the cameras are."""
        return np.stack([(-v[:3, :3].T @ v[:3, 3]).numpy() for v in self.viewmats])

    def rotation(self, index: int) -> np.ndarray:
        """World to camera."""
        return self.viewmats[index, :3, :3].numpy()


def truth(count: int = 6, center: tuple[float, float, float] = (0.0, 0.0, 0.0), *, centered: bool = False) -> Truth:
    """One made here; `centered` has the principal points in the middle of the photos."""
    rng = np.random.default_rng(0)
    sizes = [(48, 36)] * (count - 1) + [(36, 48)]
    shift = (0.0, 0.0) if centered else (1.25, -0.75)
    Ks = torch.tensor(
        [[[52.5, 0, w / 2 + shift[0]], [0, 52.5, h / 2 + shift[1]], [0, 0, 1]] for w, h in sizes], dtype=torch.float64
    )
    poses = circle_poses(count, center)
    for index in range(count):  # tilted, so that no axis is like another
        angle = 0.2 * index - 0.3
        roll = torch.eye(4, dtype=torch.float64)
        cosine, sine = math.cos(angle), math.sin(angle)
        roll[:2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float64)
        poses[index] = roll @ poses[index]
    return Truth(
        [f"photo_{index:03d}" for index in range(count)],
        sizes,
        poses,
        Ks,
        [rng.integers(0, 256, (h, w, 3), dtype=np.uint8) for w, h in sizes],
        torch.from_numpy(rng.normal(size=(12, 3))) + torch.tensor(center, dtype=torch.float64),
        rng.integers(0, 256, (12, 3)),
    )


def write_photos(folder: Path, capture: Truth, names: Sequence[str] | None = None) -> None:
    """PNG without loss, whatever their names end in."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, photo in zip(names or [f"{name}.png" for name in capture.names], capture.photos, strict=True):
        Image.fromarray(photo).save(folder / name, "PNG")


def write_points(folder: Path, capture: Truth) -> None:
    """points.ply, in double precision."""
    rows = "".join(
        f"{x!r} {y!r} {z!r} {r} {g} {b}\n"
        for (x, y, z), (r, g, b) in zip(capture.points.tolist(), capture.colors.tolist(), strict=True)
    )
    head = f"ply\nformat ascii 1.0\nelement vertex {len(capture.points)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
    (folder / "points.ply").write_text(head + "end_header\n" + rows)


def write_polycam(folder: Path, capture: Truth, *, corrected: bool = True) -> None:
    kind = "corrected_" if corrected else ""
    write_photos(folder / "keyframes" / f"{kind}images", capture)
    (folder / "keyframes" / f"{kind}cameras").mkdir()
    for index, name in enumerate(capture.names):
        pose, K, (w, h) = opengl_pose(capture.viewmats[index]), capture.Ks[index].tolist(), capture.sizes[index]
        said = {f"t_{row}{column}": pose[row][column] for row in range(3) for column in range(4)}
        said |= {"fx": K[0][0], "fy": K[1][1], "cx": K[0][2], "cy": K[1][2], "width": w, "height": h}
        said |= {"blur_score": 80.5, "timestamp": 12345 + index, "neighbors": [1, 2], "center_depth": 1.5}
        (folder / "keyframes" / f"{kind}cameras" / f"{name}.json").write_text(json.dumps(said))
    write_points(folder, capture)


def write_record3d(folder: Path, capture: Truth, *, each: bool = True) -> None:
    """One camera for all, unless `each` has intrinsics of its own; all photos are of one size."""
    write_photos(folder / "rgb", capture, [f"{index}.png" for index in range(len(capture.names))])
    poses = []
    for index in range(len(capture.names)):
        pose = torch.tensor(opengl_pose(capture.viewmats[index]), dtype=torch.float64)
        w, x, y, z = quaternion(pose[:3, :3])
        poses.append([x, y, z, w, *pose[:3, 3].tolist()])
    K = capture.Ks[0]
    said = {"w": capture.sizes[0][0], "h": capture.sizes[0][1], "K": K.T.flatten().tolist(), "poses": poses, "fps": 60}
    if each:
        said["perFrameIntrinsicCoeffs"] = [[k[0][0], k[1][1], k[0][2], k[1][2]] for k in capture.Ks.tolist()]
    (folder / "metadata.json").write_text(json.dumps(said))
    write_points(folder, capture)


def write_bundler(folder: Path, capture: Truth, *, k: tuple[float, float] = (0.0, 0.0)) -> None:
    """Principal points are in the middle of the photos."""
    write_photos(folder / "images", capture)
    count = len(capture.names)
    lines = ["# Bundle file v0.3", f"{count} {len(capture.points)}"]
    for index in range(count):
        R = FLIP @ capture.rotation(index)
        t = FLIP @ capture.viewmats[index, :3, 3].numpy()
        lines += [f"{float(capture.Ks[index, 0, 0])!r} {k[0]!r} {k[1]!r}"]
        lines += [" ".join(map(repr, row)) for row in [*R.tolist(), t.tolist()]]
    for point, color in zip(capture.points.tolist(), capture.colors.tolist(), strict=True):
        lines += [" ".join(map(repr, point)), " ".join(map(str, color)), "1 0 17 3.5 -2.5"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("".join(f"./images/{name}.png 0 52.5\n" for name in capture.names))


def write_openmvg(
    folder: Path, capture: Truth, *, kind: str = "pinhole", disto: tuple[str, list[float]] | None = None
) -> None:
    """A camera for each photo; the first names its kind."""
    write_photos(folder / "images", capture)
    views, cameras, poses = [], [], []
    for index, (name, (w, h)) in enumerate(zip(capture.names, capture.sizes, strict=True)):
        place = {"local_path": "", "filename": f"{name}.png", "width": w, "height": h}
        view = {**place, "id_view": index, "id_intrinsic": index, "id_pose": index}
        wrapped = {"id": (1 << 31) + 1 + index, "data": view}
        views.append({"key": index, "value": {"polymorphic_id": 1 << 30, "ptr_wrapper": wrapped}})
        K = capture.Ks[index].tolist()
        data: dict = {"width": w, "height": h, "focal_length": K[0][0], "principal_point": [K[0][2], K[1][2]]}
        if disto is not None:
            data = {"value0": data, disto[0]: disto[1]}
        named = {"polymorphic_id": (1 << 31) + 1, "polymorphic_name": kind} if index == 0 else {"polymorphic_id": 1}
        cameras.append({"key": index, "value": {**named, "ptr_wrapper": {"id": (1 << 31) + 50 + index, "data": data}}})
        pose = {"rotation": capture.rotation(index).tolist(), "center": capture.centers[index].tolist()}
        poses.append({"key": index, "value": pose})
    structure = [
        {"key": index, "value": {"X": point, "observations": [{"key": 0, "value": {"id_feat": 3, "x": [1.0, 2.0]}}]}}
        for index, point in enumerate(capture.points.tolist())
    ]
    document = {"sfm_data_version": "0.3", "root_path": "D:/them/photos", "views": views, "intrinsics": cameras}
    document |= {"extrinsics": poses, "structure": structure, "control_points": []}
    (folder / "sfm_data.json").write_text(json.dumps(document))


def write_meshroom(
    folder: Path,
    capture: Truth,
    *,
    version: tuple[int, int, int] = (1, 2, 6),
    kind: str = "radial3",
    params: Sequence[float] = (0.0, 0.0, 0.0),
    distortion: str | None = None,
    aspect: float = 1.0,
) -> None:
    """Of any version; `aspect` is fy / fx."""

    def texts(values: Iterable[float]) -> list[str]:
        return [repr(float(value)) for value in values]

    write_photos(folder / "images", capture)
    views, cameras, poses = [], [], []
    for index, (name, (w, h)) in enumerate(zip(capture.names, capture.sizes, strict=True)):
        identity = str(3_000_000_000 + index)
        path = f"D:/them/photos/{name}.png"
        views.append(
            {
                "viewId": identity,
                "poseId": identity,
                "intrinsicId": str(index),
                "path": path,
                "width": str(w),
                "height": str(h),
            }
        )
        K = capture.Ks[index].tolist()
        focal, sensor = K[0][0], 6.4
        camera: dict[str, object] = {
            "intrinsicId": str(index),
            "width": str(w),
            "height": str(h),
            "serialNumber": "x",
            "type": kind,
        }
        offset = [K[0][2], K[1][2]] if version < (1, 2, 1) else [K[0][2] - w / 2, K[1][2] - h / 2]
        camera["principalPoint"] = texts(offset)
        if version < (1, 2, 0):
            camera["pxFocalLength"] = repr(focal)
        elif version < (1, 2, 2):
            camera["pxFocalLength"] = texts([focal, focal * aspect])
        else:
            ratio = 1 / aspect if version < (1, 2, 5) else aspect
            camera |= {"sensorWidth": repr(sensor), "focalLength": repr(focal * sensor / w), "pixelRatio": repr(ratio)}
        camera["distortionParams"] = texts(params)
        if distortion is not None:
            camera["distortionType"] = distortion
        cameras.append(camera)
        transform = {"rotation": texts(capture.rotation(index).T.flatten()), "center": texts(capture.centers[index])}
        poses.append({"poseId": identity, "pose": {"transform": transform, "locked": "0"}})
    structure = [
        {"landmarkId": str(index), "descType": "dspsift", "color": [str(c) for c in color], "X": texts(point)}
        for index, (point, color) in enumerate(zip(capture.points.tolist(), capture.colors.tolist(), strict=True))
    ]
    document = {"version": [str(part) for part in version], "views": views, "intrinsics": cameras, "poses": poses}
    (folder / "sfm.json").write_text(json.dumps({**document, "structure": structure}))


def write_metashape(
    folder: Path,
    capture: Truth,
    *,
    kind: str = "frame",
    numbers: str = "",
    scale: float = 2.5,
    translation: tuple[float, float, float] = (3.0, -1.0, 0.5),
    extra: str = "",
) -> None:
    """A chunk that is turned, scaled and moved; a sensor for each photo; one photo that was not aligned."""
    write_photos(folder / "images", capture)
    angle = 0.7
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    sensors, cameras = "", ""
    for index, (name, (w, h)) in enumerate(zip(capture.names, capture.sizes, strict=True)):
        K = capture.Ks[index].tolist()
        size = f'<resolution width="{w}" height="{h}"/>'
        inner = f"{size}<f>{K[1][1]!r}</f><cx>{K[0][2] - w / 2!r}</cx><cy>{K[1][2] - h / 2!r}</cy>{numbers}"
        sensors += f'<sensor id="{index}" label="unknown" type="{kind}">{size}'
        sensors += f'<calibration type="{kind}" class="initial">{size}<f>1</f></calibration>'
        sensors += f'<calibration type="{kind}" class="adjusted">{inner}</calibration></sensor>\n'
        matrix = np.eye(4)
        matrix[:3, :3] = turn.T @ capture.rotation(index).T
        matrix[:3, 3] = turn.T @ (capture.centers[index] - translation) / scale
        text = " ".join(map(repr, matrix.flatten().tolist()))
        cameras += f'<camera id="{index}" sensor_id="{index}" component_id="0" label="{name}">'
        cameras += f"<transform>{text}</transform></camera>\n"
    cameras += '<group id="0" label="rest"><camera id="99" sensor_id="0" label="unaligned"/></group>'
    place = (
        f"<rotation>{' '.join(map(repr, turn.flatten().tolist()))}</rotation>"
        f"<translation>{' '.join(map(repr, translation))}</translation><scale>{scale!r}</scale>"
    )
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1" enabled="true">'
        f'<sensors>{sensors}</sensors><components><component id="0"><transform>{place}</transform></component>'
        f"</components><cameras>{cameras}</cameras>{extra}</chunk></document>\n"
    )
    write_points(folder, capture)


def angles_of(rotation: np.ndarray) -> tuple[float, float, float]:
    """Heading, pitch and roll in degrees of a camera's axes in the world: x right, y up and z backwards as columns."""
    pitch = math.asin(rotation[2, 1])
    roll = math.atan2(-rotation[2, 0], rotation[2, 2])
    heading = math.atan2(rotation[0, 1], rotation[1, 1])
    return math.degrees(heading), math.degrees(pitch), math.degrees(roll)


def write_reality_capture_csv(
    folder: Path, capture: Truth, *, coefficients: Sequence[float] = (0,) * 6, newer: bool = False, more: str = ""
) -> None:
    write_photos(folder / "images", capture)
    header = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
    if newer:
        header = header.replace("heading", "yaw").replace(",f,px,py", ",f_35mm,px_norm,py_norm")
    rows = f"#cameras {len(capture.names)}\n" if newer else ""
    rows += header + (f",{more}" if more else "") + "\n"
    for index, (name, (w, h)) in enumerate(zip(capture.names, capture.sizes, strict=True)):
        K, longer = capture.Ks[index].tolist(), max(w, h)
        numbers = [*capture.centers[index].tolist(), *angles_of((FLIP @ capture.rotation(index)).T)]
        numbers += [K[0][0] / longer * 36, (K[0][2] - w / 2) / longer, (K[1][2] - h / 2) / longer, *coefficients]
        rows += ",".join([f"{name}.png", *(repr(float(n)) for n in numbers), *(["7"] if more else [])]) + "\n"
    (folder / "registration.csv").write_text(rows)
    write_points(folder, capture)


def write_reality_capture_xmp(
    folder: Path,
    capture: Truth,
    *,
    coefficients: Sequence[float] = (0,) * 6,
    model: str = "brown3",
    attributes: str = "",
) -> None:
    write_photos(folder / "images", capture)
    for index, (name, (w, h)) in enumerate(zip(capture.names, capture.sizes, strict=True)):
        K, longer = capture.Ks[index].tolist(), max(w, h)

        def text(values: Iterable[float]) -> str:
            return " ".join(repr(float(value)) for value in values)

        (folder / "images" / f"{name}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            f'<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" '
            f'xcr:Coordinates="absolute" xcr:DistortionModel="{model}" xcr:FocalLength35mm="{K[0][0] / longer * 36!r}" '
            f'xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="{(K[0][2] - w / 2) / longer!r}" '
            f'xcr:PrincipalPointV="{(K[1][2] - h / 2) / longer!r}" {attributes}>'
            f"<xcr:Rotation>{text(capture.rotation(index).flatten())}</xcr:Rotation>"
            f"<xcr:Position>{text(capture.centers[index])}</xcr:Position>"
            f"<xcr:DistortionCoeficients>{text(coefficients)}</xcr:DistortionCoeficients>"
            "</rdf:Description></rdf:RDF></x:xmpmeta>\n"
        )
    write_points(folder, capture)


def write_neus(
    folder: Path,
    capture: Truth,
    *,
    scale: float = 2.0,
    offset: tuple[float, float, float] = (3.0, -1.0, 0.5),
    name: str = "cameras_sphere.npz",
    precision: type = np.float64,
) -> None:
    """The capture's frame is that of the sphere; the centre of the first pixel is at 0; matrices up to a factor."""
    write_photos(folder / "image", capture)
    scale_mat = np.diag([scale, scale, scale, 1.0])
    scale_mat[:3, 3] = offset
    matrices = {}
    for index, viewmat in enumerate(capture.viewmats.numpy()):
        K = np.eye(4)
        K[:3, :3] = capture.Ks[index].numpy()
        K[:2, 2] -= 0.5
        projection = K @ viewmat @ np.linalg.inv(scale_mat)
        projection[:3] *= (-1) ** index * (1 + index)
        matrices |= {f"world_mat_{index}": projection, f"scale_mat_{index}": scale_mat}
        matrices |= {f"scale_mat_inv_{index}": np.linalg.inv(scale_mat)}
    np.savez(folder / name, **{key: value.astype(precision) for key, value in matrices.items()})
    write_points(folder, capture)


def write_llff(folder: Path, capture: Truth) -> None:
    """Principal points are in the middle of the photos."""
    write_photos(folder / "images", capture)
    rows = []
    for index, (w, h) in enumerate(capture.sizes):
        right, down, forward = capture.rotation(index)
        hwf = [h, w, float(capture.Ks[index, 0, 0])]
        matrix = np.stack([down, right, -forward, capture.centers[index], hwf], axis=1)
        rows.append([*matrix.flatten(), 0.5, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    write_points(folder, capture)


def write_opensfm(
    folder: Path,
    capture: Truth,
    *,
    kind: str = "brown",
    coefficients: Mapping[str, float] | None = None,
    place: str = "reconstruction.json",
    lla: bool = False,
) -> None:
    """A camera for each photo; perspective and fisheye ones have principal points in the middle of the photos."""
    write_photos(folder / "images", capture)
    cameras, shots = {}, {}
    for index, (name, (w, h)) in enumerate(zip(capture.names, capture.sizes, strict=True)):
        K, longer = capture.Ks[index].tolist(), max(w, h)
        said: dict[str, object] = {"projection_type": kind, "width": w, "height": h, **(coefficients or {})}
        if kind in ("perspective", "fisheye"):
            said["focal"] = K[0][0] / longer
        else:
            said |= {"focal_x": K[0][0] / longer, "focal_y": K[1][1] / longer}
            said |= {"c_x": (K[0][2] - w / 2) / longer, "c_y": (K[1][2] - h / 2) / longer}
        cameras[f"v2 someone {index}"] = said
        scalar, *axis = quaternion(capture.viewmats[index, :3, :3])
        length = math.hypot(*axis)
        angle = 2 * math.atan2(length, scalar)
        shots[f"{name}.png"] = {
            "camera": f"v2 someone {index}",
            "rotation": [part / length * angle for part in axis],
            "translation": capture.viewmats[index, :3, 3].tolist(),
            "orientation": 1,
            "gps_position": [1.0, 2.0, 3.0],
        }
    points = {
        str(index): {"coordinates": point, "color": [float(part) for part in color]}
        for index, (point, color) in enumerate(zip(capture.points.tolist(), capture.colors.tolist(), strict=True))
    }
    document: dict[str, object] = {"cameras": cameras, "shots": dict(reversed(shots.items())), "points": points}
    if lla:
        document["reference_lla"] = {"latitude": 46.5, "longitude": 6.25, "altitude": 400.0}
    (folder / place).parent.mkdir(parents=True, exist_ok=True)
    (folder / place).write_text(json.dumps([document]))


def write_nsvf(folder: Path, capture: Truth, *, intrinsics: str | None = None) -> None:
    """One camera for all: photos are of one size."""
    write_photos(folder / "rgb", capture)
    (folder / "pose").mkdir()
    for index, name in enumerate(capture.names):
        (folder / "pose" / f"{name}.txt").write_text(rows_of(torch.linalg.inv(capture.viewmats[index]).numpy()))
    K = np.eye(4)
    K[:3, :3] = capture.Ks[0].numpy()
    (folder / "intrinsics.txt").write_text(rows_of(K) if intrinsics is None else intrinsics)
    (folder / "bbox.txt").write_text("-1 -1 -1 1 1 1 0.4\n")
    write_points(folder, capture)


def write_nerf_plus_plus(folder: Path, capture: Truth, *, tested: str = "test", tests: int = 1) -> None:
    """The first photos are for testing."""
    for index, (name, photo) in enumerate(zip(capture.names, capture.photos, strict=True)):
        part = folder / (tested if index < tests else "train")
        for kind in ("rgb", "pose", "intrinsics"):
            (part / kind).mkdir(parents=True, exist_ok=True)
        Image.fromarray(photo).save(part / "rgb" / f"{name}.png")
        K = np.eye(4)
        K[:3, :3] = capture.Ks[index].numpy()
        for kind, matrix in (("pose", torch.linalg.inv(capture.viewmats[index]).numpy()), ("intrinsics", K)):
            (part / kind / f"{name}.txt").write_text(rows_of(matrix).replace("\n", " "))
    write_points(folder, capture)


def write_mvsnet(folder: Path, capture: Truth, *, photos: str = "images") -> None:
    write_photos(folder / photos, capture)
    (folder / "cams").mkdir()
    for index, name in enumerate(capture.names):
        extrinsic, K = rows_of(capture.viewmats[index].numpy()), rows_of(capture.Ks[index].numpy())
        text = f"extrinsic\n{extrinsic}\nintrinsic\n{K}\n0.5 0.01 192 2.5\n"
        (folder / "cams" / f"{name}_cam.txt").write_text(text)
    (folder / "cams" / "pair.txt").write_text("1\n0\n1 1 0.5\n")
    write_points(folder, capture)


def rows_of(matrix: np.ndarray) -> str:
    """A matrix as lines of numbers."""
    return "".join(" ".join(map(repr, row)) + "\n" for row in matrix.tolist())


WRITERS: dict[str, Callable[[Path, Truth], None]] = {
    "polycam": write_polycam,
    "record3d": write_record3d,
    "bundler": write_bundler,
    "openmvg": write_openmvg,
    "meshroom": write_meshroom,
    "metashape": write_metashape,
    "reality_capture_csv": write_reality_capture_csv,
    "reality_capture_xmp": write_reality_capture_xmp,
    "neus": write_neus,
    "llff": write_llff,
    "opensfm": write_opensfm,
    "nsvf": write_nsvf,
    "nerf_plus_plus": write_nerf_plus_plus,
    "mvsnet": write_mvsnet,
}


def check_refused(folder: Path, message: str) -> None:
    """That a capture cannot be read, and one line says why."""
    with pytest.raises(InputError, match=message) as raised:
        load_dataset(folder)
    assert "\n" not in str(raised.value)
