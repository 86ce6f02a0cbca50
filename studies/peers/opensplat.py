"""OpenSplat's CPU build beside our methods: what it is given, how it is run, and what comes of it.

It is a program of its own (AGPL), https://github.com/pierotofy/OpenSplat: none of its code is here. It gets the photos
of training as we have them, in a folder as nerfstudio lays it out, and returns a PLY file of 3D Gaussians.
"""

import json
import os
import resource
import subprocess
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import as_float
from etsplat.io.atomic import atomic_write, write_error
from etsplat.io.images import load_image, save_image, to_8_bit
from etsplat.io.ply_tables import columns, encode_ply, read_ply_tables
from etsplat.metrics.image import psnr
from studies.peers.gaussians import NAMES
from studies.peers.settings import PeerConfig, Schedule, peer_config
from studies.peers.training import PeerDrawing

BUILD = (
    "build OpenSplat for the CPU (https://github.com/pierotofy/OpenSplat: cmake -DGPU_RUNTIME=CPU"
    " -DCMAKE_PREFIX_PATH=\"$(python -c 'import torch; print(torch.utils.cmake_prefix_path)')\", with OpenCV), with"
    " .contiguous() after what camDepths is in rasterizer/gsplat-cpu/gsplat_cpu.cpp, and name its program"
)
"""How its program is made."""

BACKGROUND = (0.6130, 0.0101, 0.3984)
"""Behind its Gaussians, in training and in its own pictures."""

MOST_OFF_CENTER = 0.1
"""Pixels that a principal point may be off the middle of the photo, where OpenSplat takes it to be."""

LEAST_AGREEMENT = 35.0
"""In dB, of our picture of its Gaussians and its own, which is rounded down to 8 bits."""

CHECKED_AFTER = 50
"""Steps of the run whose pictures are compared, a multiple of 10 (it draws its own at these)."""

SCHEDULE = {"resolution-schedule": 3000, "sh-degree-interval": 1000, "stop-screen-size-at": 4000, "warmup-length": 500}
"""Its settings that are iterations of a run of 30,000; intervals between densifications stay, as with the peers."""
SCHEDULE_LENGTH, REFINE_EVERY = 30_000, 100


@dataclass(frozen=True)
class OpenSplatRun:
    """A finished run and what it came to.

    Attributes:
        steps: of optimization, a photo each.
        processor_seconds: of the whole process, on all its threads.
        seconds: the same by the clock.
        gaussians: in its file.
        psnr: mean over the test views, in dB.
        ssim: likewise.
    """

    steps: int
    processor_seconds: float
    seconds: float
    gaussians: int
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Program:
    """OpenSplat as it is run here.

    Attributes:
        path: of its program.
        gsplat: the module that draws what it makes, on the CPU.
        threads: of each run.
        schedule: what becomes of `SCHEDULE` in a short run.

    Raises:
        InputError: there is no such program.
    """

    path: Path
    gsplat: Any
    threads: int
    schedule: Schedule

    def __post_init__(self) -> None:
        if not self.path.is_file() or not os.access(self.path, os.X_OK):
            raise InputError(f"opensplat {self.path}: no program that can be run; {BUILD}")

    def options(self, steps: int) -> list[str]:
        """Those of a run of so many steps."""
        options = ["--cpu", "--keep-crs", "--num-iters", str(steps)]
        if self.schedule == "own":
            return options
        for name, step in SCHEDULE.items():
            # Without that it would reset opacities at its first refinement, when they are hardly learned.
            least = REFINE_EVERY if name == "warmup-length" else 1
            options += [f"--{name}", str(max(least, round(step * steps / SCHEDULE_LENGTH)))]
        return options

    def start(self, project: Path, folder: Path, steps: int, more: Sequence[str] = ()) -> nn.ParameterDict:
        """The Gaussians of a run in a folder, which gets splat.ply, cameras.json and log.txt.

        Raises:
            InputError: it fails, or writes nothing that can be read.
        """
        folder.mkdir(parents=True, exist_ok=True)
        output, log = folder / "splat.ply", folder / "log.txt"
        output.unlink(missing_ok=True)
        command = [str(self.path.resolve()), str(project), "--output", str(output), *self.options(steps), *more]
        environment = {**os.environ, "OMP_NUM_THREADS": str(self.threads), "MKL_NUM_THREADS": str(self.threads)}
        with open(log, "w", encoding="utf-8") as file:
            ended = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, env=environment, check=False)
        if ended.returncode or not output.is_file():
            raise InputError(f"opensplat {self.path}: failed with status {ended.returncode}; {log} says why")
        return read_gaussians(output)


@dataclass(frozen=True)
class Checked:
    """A short run, which was drawn by both.

    Attributes:
        agreement: PSNR in dB between our picture of its Gaussians and its own, of the first test view.
        seconds_per_step: of the processor.
    """

    agreement: float
    seconds_per_step: float


class OpenSplat:
    """Its runs on one capture."""

    def __init__(self, program: Program, name: str, capture: Dataset, out: Path) -> None:
        """Checks that it can be run on this.

        Args:
            program: which.
            name: of the capture, for error messages.
            capture: what all runs train on and are scored on, in any frame.
            out: folder that gets the runs.

        Raises:
            InputError: what `check_capture` raises.
        """
        check_capture(name, capture)
        self._program, self._capture, self._out = program, capture, out

    def check(self) -> Checked:
        """Makes a short run, and compares our picture of its Gaussians with its own.

        Raises:
            InputError: they differ so much that our pictures would be no measure of it.
        """
        (view, *_), folder = self._capture.test, self._out / "check"
        project = write_project(folder / "project", self._capture, [*self._capture.train, view])
        more = ["--num-downscales", "0", "--val-image", photo_name(view), "--val-render", str(folder)]
        before = processor_seconds()
        gaussians = self._program.start(project, folder, CHECKED_AFTER, more)
        taken = processor_seconds() - before
        ours, _ = self._drawing(gaussians).pair(view)
        own = folder / f"{CHECKED_AFTER}.png"
        agreement = psnr(torch.floor(ours * 255) / 255, load_image(own))
        if agreement < LEAST_AGREEMENT:
            raise InputError(
                f"opensplat {self._program.path}: its picture {own} is {agreement:.1f} dB from its Gaussians as gsplat"
                f" draws them; as shipped it draws them in a wrong order: {BUILD}"
            )
        return Checked(agreement, taken / CHECKED_AFTER)

    def train(self, steps: int) -> OpenSplatRun:
        """So many steps on the training views; a run that is finished is not repeated.

        Raises:
            InputError: as `Program.start`.
        """
        folder = self._out / f"{steps} steps"
        found, options = folder / "run.json", self._program.options(steps)
        if found.is_file():
            document = json.loads(found.read_text(encoding="utf-8"))
            if document["options"] == options:
                return OpenSplatRun(**document["run"])
        project = write_project(self._out / "project", self._capture, self._capture.train)
        before, began = processor_seconds(), time.perf_counter()
        gaussians = self._program.start(project, folder, steps)
        taken, seconds = processor_seconds() - before, time.perf_counter() - began
        scores = self._drawing(gaussians).draw_test_views(folder)
        run = OpenSplatRun(steps, taken, seconds, len(gaussians["means"]), **scores)
        with atomic_write(found) as temporary:
            temporary.write_text(json.dumps({"options": options, "run": asdict(run)}, indent=2), encoding="utf-8")
        return run

    def _drawing(self, gaussians: nn.ParameterDict) -> PeerDrawing:
        background, cpu = torch.tensor([BACKGROUND]), torch.device("cpu")
        config = _config(gaussians)
        return PeerDrawing(self._program.gsplat, gaussians, self._capture, config, cpu, background)


def check_capture(name: str, capture: Dataset) -> None:
    """Whether OpenSplat can be given these photos.

    Args:
        name: for error messages.
        capture: the photos.

    Raises:
        InputError: there are no test views, masks, no points, or a principal point off the middle of its photo.
    """
    if not capture.test:
        raise InputError(f"scene {name}: has no test views, on which methods are compared; leave it out")
    if capture.has_masks or any(capture.images.mask(view) is not None for view in range(len(capture))):
        raise InputError(f"scene {name}: has masks, which OpenSplat does not know; leave it out")
    if capture.points is None:
        raise InputError(f"scene {name}: has no points, from which OpenSplat starts; leave it out")
    middles = torch.tensor(capture.images.sizes, dtype=torch.float64) / 2
    off = float((capture.Ks[:, :2, 2] - middles).abs().max())
    if off > MOST_OFF_CENTER:
        raise InputError(
            f"scene {name}: has principal points up to {off:.1f} pixels off the middle of the photos, where OpenSplat"
            " takes all to be; leave it out"
        )


def photo_name(view: int) -> str:
    """The file of a view in a project."""
    return f"{view:05d}.png"


def write_project(folder: Path, capture: Dataset, views: Sequence[int]) -> Path:
    """Some views of a capture as nerfstudio lays them out: transforms.json, points.ply, images/; returns the folder.

    Photos are PNG, of the very pixels that our methods train on.
    """
    try:
        (folder / "images").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(folder, error) from error
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # to OpenGL's axes
    frames = []
    for view in views:
        save_image(folder / "images" / photo_name(view), as_float(capture.images[view]))
        K = capture.Ks[view]
        frames.append(
            {
                "file_path": f"images/{photo_name(view)}",
                **dict(zip(("w", "h"), capture.images.sizes[view], strict=True)),
                **dict(zip(("fl_x", "fl_y", "cx", "cy"), K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True)),
                "transform_matrix": (torch.linalg.inv(capture.viewmats[view]) @ flip).tolist(),
            }
        )
    document = {"camera_model": "PINHOLE", "ply_file_path": "points.ply", "frames": frames}
    with atomic_write(folder / "points.ply") as temporary:
        temporary.write_bytes(encode_ply({"vertex": _points(capture)}))
    with atomic_write(folder / "transforms.json") as temporary:
        temporary.write_text(json.dumps(document, indent=1), encoding="utf-8")
    return folder


def read_gaussians(path: Path) -> nn.ParameterDict:
    """The Gaussians of a PLY file, by the names of `studies.peers.gaussians`.

    Raises:
        InputError: it cannot be read, or there are none.
    """
    table = read_ply_tables(path)["vertex"]
    if not len(table):
        raise InputError(f"{path}: holds no Gaussians; OpenSplat removed them all")

    def read(*names: str) -> Float[Tensor, "N K"]:
        return columns(path, table, *names).float()

    bands = sum(name.startswith("f_rest_") for name in table.dtype.names or ()) // 3
    rest = read(*(f"f_rest_{index}" for index in range(3 * bands)))  # all of red, then green, then blue
    values = {
        "means": read(*"xyz"),
        "scales": read(*(f"scale_{axis}" for axis in range(3))),
        "quats": read(*(f"rot_{part}" for part in range(4))),
        "opacities": read("opacity")[:, 0],
        "sh0": read(*(f"f_dc_{channel}" for channel in range(3)))[:, None],
        "shN": rest.view(-1, 3, bands).transpose(1, 2),
    }
    return nn.ParameterDict({name: nn.Parameter(values[name].contiguous(), requires_grad=False) for name in NAMES})


def processor_seconds() -> float:
    """Of all processes that this one has started and that have ended; a busy machine hardly adds to them."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _config(gaussians: nn.ParameterDict) -> PeerConfig:
    return peer_config("3dgs", sh_degree=round((gaussians["shN"].shape[1] + 1) ** 0.5) - 1)


def _points(capture: Dataset) -> np.ndarray:
    assert capture.points is not None
    colors = capture.point_colors if capture.point_colors is not None else torch.full_like(capture.points, 0.5)
    channels = ("red", "green", "blue")
    table = np.empty(len(capture.points), [*((axis, "f4") for axis in "xyz"), *((name, "u1") for name in channels)])
    for index, (axis, channel) in enumerate(zip("xyz", channels, strict=True)):
        table[axis], table[channel] = capture.points[:, index].numpy(), to_8_bit(colors[:, index]).numpy()
    return table
