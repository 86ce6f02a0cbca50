"""One target for each reader of files."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

import etsplat
from etsplat.core.errors import InputError
from etsplat.core.kernels import KERNELS
from etsplat.data.frames import Wanted, check_frames
from etsplat.data.georeferencing import near_origin
from etsplat.data.load import format_of, load_dataset
from etsplat.io.camera_path_files import read_camera_path
from etsplat.io.depth_maps import load_depth, resize_depth
from etsplat.io.georeference import Georeference
from etsplat.io.images import image_size, load_image, load_mask, load_pixels
from etsplat.io.kernel_files import adopt_kernel_of
from etsplat.io.mesh_files import load_mesh
from etsplat.io.opaque_files import load_opaque
from etsplat.io.photos import inspect_photo, write_upright
from etsplat.io.ply_tables import load_points
from etsplat.io.point_clouds import load_cloud
from etsplat.io.refined_camera_files import read_refined_cameras
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.metrics.image import Lpips
from etsplat.model.soup_import import load_soup
from etsplat.optim.checkpoints import load_latest_checkpoint
from etsplat.tasks.opened_runs import open_run
from tests.fuzz import corpus
from tests.fuzz.mutate import mutated
from tests.fuzz.session import Refused
from tests.fuzz.videos import read_video, small_videos


@dataclass
class Reader:
    """A reader, the folders that it reads, and which files of theirs are changed.

    Attributes:
        name: of the target.
        make: folders to start from.
        changed: the files that are changed, by how their paths end.
        read: reads a folder, and raises AssertionError where what it accepts is not what it promises.
        least_accepted: the share of inputs that must be accepted.
    """

    name: str
    make: Callable[[], Sequence[corpus.Files]]
    changed: tuple[str, ...]
    read: Callable[[Path], None]
    least_accepted: float = 0.1

    @cached_property
    def folders(self) -> Sequence[corpus.Files]:
        """Made when first asked for."""
        return self.make()

    def describe(self, rng: np.random.Generator) -> corpus.Files:
        """The files of an input."""
        folder = self.folders[int(rng.integers(len(self.folders)))]
        names = [name for name in folder if name.endswith(self.changed)]
        chosen = names[int(rng.integers(len(names)))]
        alike = [data for other in self.folders for name, data in other.items() if name.endswith(self.changed)]
        return {**folder, chosen: mutated(folder[chosen], rng, alike)}

    def write(self, files: corpus.Files, folder: Path) -> None:
        """Into a folder that holds the files of an input before it, or nothing."""
        for path in folder.rglob("*"):
            if path.is_file() and path.relative_to(folder).as_posix() not in files:
                path.unlink()
        for name, data in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.is_file() or path.stat().st_size != len(data) or path.read_bytes() != data:
                path.write_bytes(data)

    def run(self, files: corpus.Files, folder: Path) -> None:
        """Read an input.

        Raises:
            Refused: by InputError; everything else that is raised is a defect.
        """
        self.write(files, folder)
        try:
            self.read(folder)
        except InputError as error:
            lines = str(error).splitlines()
            assert len(lines) == 1, f"the message has {len(lines)} lines: {lines[:2]}"
            raise Refused from error


def _single(suffix: str, seeds: Callable[[], list[bytes]]) -> Callable[[], list[corpus.Files]]:
    return lambda: [{f"input{suffix}": data} for data in seeds()]


def _file(read: Callable[[Path], object]) -> Callable[[Path], None]:
    def read_it(folder: Path) -> None:
        read(next(folder.glob("input*")))

    return read_it


def _mesh(path: Path) -> None:
    mesh = load_mesh(path)
    assert mesh.vertices.isfinite().all()
    assert 0 <= int(mesh.faces.min()) <= int(mesh.faces.max()) < len(mesh.vertices)
    for colors, count in ((mesh.vertex_colors, len(mesh.vertices)), (mesh.face_colors, len(mesh.faces))):
        assert colors is None or (colors.shape == (count, 3) and 0 <= colors.min() <= colors.max() <= 1)
    if mesh.texture is not None:
        every = torch.arange(len(mesh.faces))
        for corner in torch.eye(3):
            colors = mesh.texture.colors(every, corner.expand(len(every), 3))
            assert colors.shape == (len(every), 3)
            assert 0 <= colors.min() <= colors.max() <= 1


CAMERA = etsplat.orbit_cameras(16, 12, azimuths=1)[0]


def _opaque(path: Path) -> None:
    mesh = load_opaque(path)
    assert mesh.vertex_colors is not None
    assert mesh.vertices.isfinite().all()
    assert mesh.vertex_colors[mesh.faces].isfinite().all()


def _refined_cameras(folder: Path) -> None:
    for camera in read_refined_cameras(folder).values():
        pose, K = torch.tensor(camera.viewmat, dtype=torch.float64), torch.tensor(camera.K, dtype=torch.float64)
        etsplat.Cameras(pose[None], K[None], camera.width, camera.height)
        assert pose.isfinite().all(), camera
        assert K.isfinite().all(), camera
        assert math.isfinite(camera.shifted_of_distance), camera


def _camera_path(path: Path) -> None:
    keys = read_camera_path(path)
    assert keys.viewmats.shape == (len(keys), 4, 4)
    assert keys.viewmats.isfinite().all()
    assert ((keys.fovs > 0) & (keys.fovs < 180)).all()


def _soup(path: Path) -> None:
    soup = load_soup(path)
    assert all(parameter.isfinite().all() for parameter in soup.parameters().values())
    assert soup.render(CAMERA).color.shape == (1, 12, 16, 3)


def _georeference(path: Path) -> None:
    found = Georeference.read(path)
    assert all(math.isfinite(value) for value in (*found.offset, found.scale))
    assert found.scale > 0


def _picture(path: Path) -> None:
    width, height = image_size(path)
    image = load_image(path)
    assert image.shape[:2] == (height, width)
    assert image.dtype == torch.float32
    assert 0 <= image.min() <= image.max() <= 1
    assert load_pixels(path, 8, 6).shape[:2] == (6, 8)


def _photo(path: Path) -> None:
    known, copy = inspect_photo(path), path.with_name("upright.jpg")
    write_upright(path, copy)
    assert inspect_photo(copy).size == known.size
    assert inspect_photo(copy).upright


def _mask(path: Path) -> None:
    mask = load_mask(path)
    assert mask.ndim == 2
    assert 0 <= mask.min() <= mask.max() <= 1


def _depth(path: Path) -> None:
    depth = load_depth(path)
    assert depth.dtype == torch.float32
    assert depth.isfinite().all()
    assert depth.min() >= 0
    assert resize_depth(depth, 5, 4).shape == (4, 5)


def _cloud(path: Path) -> None:
    points, colors = load_cloud(path)
    assert points.isfinite().all()
    assert colors is None or (colors.shape == points.shape and 0 <= colors.min() <= colors.max() <= 1)


def _points(path: Path) -> None:
    points, colors = load_points(path)
    assert points.shape == colors.shape
    assert points.isfinite().all()
    assert colors.isfinite().all()


def _scene(folder: Path, *, preload: bool = False) -> None:
    dataset = load_dataset(folder, masks_as="alpha" if preload else "ignore", preload=preload)
    assert dataset.viewmats.isfinite().all()
    assert dataset.Ks.isfinite().all()
    assert sorted([*dataset.train, *dataset.test]) == sorted({*dataset.train, *dataset.test})
    assert len(dataset.viewmats) == len(dataset.names)


def _decoded(folder: Path) -> None:
    _scene(folder, preload=True)


def _listed(folder: Path) -> None:
    frames = near_origin(folder, format_of(folder).list_frames(folder, Wanted())).frames
    check_frames(folder, frames)
    assert all(frame.viewmat.isfinite().all() and frame.K.isfinite().all() for frame in frames)


def _run(folder: Path) -> None:
    run = folder / "run"
    if not is_run(run):
        raise InputError("no run")
    place = RunDirectory(run)
    place.read_iterations()
    place.read_metrics()
    place.read_evaluation()
    place.read_history()
    open_run(run, folder / "scene")


def _report(folder: Path) -> None:
    assert etsplat.write_report(folder / "run").stat().st_size > 1000


def _kernel(folder: Path) -> None:
    for name in [name for name, kernel in KERNELS.items() if kernel.table is not None]:
        del KERNELS[name]  # of an input before: another table of that name would be refused
    adopt_kernel_of(folder)


def _checkpoint(folder: Path) -> None:
    found = load_latest_checkpoint(folder, corpus.RUN_HASH)
    assert found is not None
    assert found.iteration >= 0


def _settings(path: Path) -> None:
    for kind in (etsplat.TrainConfig, etsplat.ReconstructConfig):
        try:
            kind.from_file(path)
            return
        except InputError as error:
            refused = error
    raise refused


def _weights(path: Path) -> None:
    try:
        Lpips.from_weights(path)
    except InputError as error:
        if "entries are missing" not in str(error) and "has shape" not in str(error):
            raise


def _prefixed(make: Callable[[], corpus.Files]) -> Callable[[], list[corpus.Files]]:
    return lambda: [make()]


_FOREIGN = {
    "polycam": (".json", ".ply"),
    "record3d": (".json", ".ply"),
    "bundler": (".out", ".txt"),
    "openmvg": (".json",),
    "meshroom": (".json",),
    "metashape": (".xml", ".ply"),
    "reality_capture_csv": (".csv", ".ply"),
    "reality_capture_xmp": (".xmp", ".ply"),
    "neus": (".npz", ".ply"),
    "llff": (".npy", ".ply"),
    "opensfm": (".json",),
    "nsvf": (".txt", ".ply"),
    "nerf_plus_plus": (".txt", ".ply"),
    "mvsnet": ("_cam.txt", ".ply"),
}


def _foreign(kind: str) -> Reader:
    """Of captures that another program wrote, with lenses or without: what lists their frames."""
    return Reader(f"capture of {kind}", lambda: [corpus.foreign(kind)], _FOREIGN[kind], _listed)


_MODEL = ("cameras.txt", "images.txt", "points3D.txt", "cameras.bin", "images.bin", "points3D.bin")

READERS = [
    Reader("mesh .obj", _single(".obj", corpus.objs), (".obj",), _file(_mesh)),
    Reader("mesh .ply", _single(".ply", corpus.plys), (".ply",), _file(_mesh)),
    Reader("mesh .off", _single(".off", corpus.offs), (".off",), _file(_mesh)),
    Reader("mesh .stl", _single(".stl", corpus.stls), (".stl",), _file(_mesh)),
    Reader("mesh .glb", _single(".glb", lambda: corpus.meshes(".glb")), (".glb",), _file(_mesh)),
    Reader("packed .glb", _single(".glb", corpus.packed_glbs), (".glb",), _file(_mesh)),
    Reader("mesh .gltf", _single(".gltf", corpus.gltfs), (".gltf",), _file(_mesh)),
    Reader("textured .obj", _prefixed(corpus.textured_obj), (".obj", ".mtl", ".png"), _file(_mesh)),
    Reader("textured .glb, .gltf", corpus.textured_gltfs, (".glb", ".gltf", ".bin", ".png"), _file(_mesh)),
    Reader("picture", _single(".png", corpus.pictures), (".png",), _file(_picture)),
    Reader("photo with EXIF", _single(".jpg", lambda: corpus.phone_photos(".jpg")), (".jpg",), _file(_photo)),
    Reader("mask", _single(".png", corpus.masks), (".png",), _file(_mask)),
    Reader("depth map", corpus.depth_maps, (".png", ".npy", ".exr"), _file(_depth)),
    Reader("laser scan", corpus.laser_scans, (".las",), _file(_cloud)),
    Reader("points", _single(".ply", corpus.point_clouds), (".ply",), _file(_points)),
    Reader("colmap text", _prefixed(corpus.colmap_text), _MODEL, _scene),
    Reader("colmap binary", _prefixed(corpus.colmap_binary), _MODEL, _scene),
    Reader("transforms.json", _prefixed(corpus.transforms_with_points), (".json", ".ply"), _scene),
    Reader("blender", _prefixed(corpus.blender), (".json",), _scene),
    Reader("photos of a scene", _prefixed(corpus.blender), (".png",), _decoded),
    Reader(
        "transforms.json, distorted",
        lambda: [corpus.transforms(k1=0.1, k2=0.01, p1=0.001, p2=0.0, camera_model="OPENCV")],
        (".json",),
        _listed,
    ),
    *(_foreign(kind) for kind in _FOREIGN),
    Reader("georeference.json", _single(".json", corpus.georeferences), (".json",), _file(_georeference)),
    Reader("soup .safetensors", _single(".safetensors", corpus.soups), (".safetensors",), _file(_soup)),
    Reader("soup .ply, Gaussians", _single(".ply", corpus.gaussians), (".ply",), _file(_soup)),
    Reader("soup .ply, exported", _single(".ply", corpus.exported), (".ply",), _file(_soup)),
    Reader("soup .etz", _single(".etz", corpus.compact_soups), (".etz",), _file(_soup)),
    Reader("soup .pt", _single(".pt", corpus.states), (".pt",), _file(_soup)),
    Reader("opaque mesh", _single(".safetensors", corpus.opaque_meshes), (".safetensors",), _file(_opaque)),
    Reader("camera path", _single(".json", corpus.camera_paths), (".json",), _file(_camera_path)),
    Reader("cameras.json", _prefixed(corpus.refined_cameras), (".json",), _refined_cameras),
    Reader(
        "kernel.safetensors",
        lambda: [{"kernel.safetensors": data} for data in corpus.kernels()],
        (".safetensors",),
        _kernel,
    ),
    Reader(
        "checkpoint",
        lambda: [{"step_000003.safetensors": data} for data in corpus.checkpoints()],
        (".safetensors",),
        _checkpoint,
    ),
    Reader("run", _prefixed(corpus.run), ("run/config.json", "metrics.json", ".jsonl", "soup.safetensors"), _run),
    Reader("report", _prefixed(corpus.run), ("run/config.json", "metrics.json", ".jsonl", "_render.png"), _report),
    Reader("--config", _single(".json", corpus.config_files), (".json",), _file(_settings)),
    Reader("LPIPS weights", _single(".pth", corpus.weights), (".pth",), _file(_weights)),
]

if find_spec("pillow_heif"):  # an extra
    READERS.append(
        Reader("photo .heic", _single(".heic", lambda: corpus.phone_photos(".heic")), (".heic",), _file(_photo))
    )
if find_spec("imageio_ffmpeg"):  # another
    READERS.append(Reader("video", small_videos, (".mp4", ".mkv", ".avi", ".mov"), _file(read_video)))
