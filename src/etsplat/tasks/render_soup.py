"""Pictures and videos of a trained soup."""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from torch import Tensor

from etsplat.core.cameras import Cameras, intrinsics
from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.data.camera_paths import PATHS, path_note, played, usual_frames
from etsplat.data.dataset import Dataset
from etsplat.data.where_up import up_of
from etsplat.engines.choice import engine
from etsplat.io.atomic import atomic_write, write_error
from etsplat.io.camera_path_files import read_camera_path
from etsplat.io.images import IMAGE_SUFFIXES, over_background, save_image
from etsplat.io.paths import kind_of
from etsplat.io.videos import VIDEO_SUFFIXES, VideoSink, open_video
from etsplat.model.soup_appearance import OPAQUE_FROM
from etsplat.model.triangle_soup import FOCAL_NOTE, TriangleSoup
from etsplat.tasks.opened_runs import SoupRun
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.soup_selection import Crop, select

_MOST_SAMPLES = 8

_NEAREST = 0.02
"""Quantile of depths that is shown as nearest, and as farthest from the other end."""

_PROBE_WIDTH = 160

KEY_FRAMES = 60
"""From pose to pose of a recorded path, unless somebody says how many in all."""

USUAL_WIDTH, USUAL_ASPECT = 960, 1.5
"""Of the pictures of a recorded path where neither it nor a capture says."""


_PICTURES = (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES, ".webp", ".gif", ".webm")
"""Ends of the names of files, which no folder is to have."""


def render_run(
    run: SoupRun,
    out: Path | str,
    config: RenderConfig,
    *,
    crop: Crop | None = None,
    progress: Callable[[int, int], None] | None = None,
    tell: Callable[[str], None] | None = None,
) -> list[Path]:
    """Draw views or a path of a run into a folder.

    Args:
        run: with its capture.
        out: folder; made if it does not exist. Gets NAME_color.png (and _depth.png, _depth.npy, _normal.png) or
            PATH_color.mp4 and so on.
        config: what, from where, how.
        crop: what is drawn of the soup, in the capture's own units and axes.
        progress: called with (pictures drawn, pictures in all).
        tell: called with a sentence where a path is otherwise than its name says, as an orbit that is no whole turn.

    Returns:
        The files written.

    Raises:
        InputError: the run has no capture or no views of that kind; nothing is left to draw; MP4 cannot be written; the
            disk is full.
    """
    out = Path(out)
    if out.is_file() or kind_of(out) in _PICTURES:
        raise InputError(f"{out}: pictures get names of their own; name a folder for them")
    names, cameras = recorded_views(run, config) if config.recorded else views_of(run.needed_capture(), config, tell)
    soup = drawn_soup(run, config, crop)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(out, error) from error
    written: list[Path] = []
    with engine(run.engine), ExitStack() as stack:
        span = _path_span(soup, cameras) if config.video and config.depth else None
        sinks: dict[str, VideoSink] = {}
        for index, (name, camera) in enumerate(zip(names, cameras, strict=True)):
            pictures = draw(soup, camera, config)
            if "depth" in pictures:
                depth = pictures["depth"]
                if not config.video:
                    written.append(_save_array(out / f"{name}_depth.npy", depth))
                pictures["depth"] = color_depth(depth, span or depth_span(depth))
            for kind, picture in pictures.items():
                if not config.video:
                    written.append(out / f"{name}_{kind}.png")
                    save_image(written[-1], picture)
                    continue
                if kind not in sinks:
                    written.append(out / f"{path_name(config)}_{kind}.mp4")
                    sinks[kind] = stack.enter_context(open_video(written[-1], config.fps))
                sinks[kind](picture)
            if progress is not None:
                progress(index + 1, len(names))
    return written


def drawn_soup(run: SoupRun, config: RenderConfig, crop: Crop | None = None) -> TriangleSoup:
    """What is drawn of a run's soup.

    Raises:
        InputError: nothing is.
    """
    # where a run has no opaque mesh, depths and normals are of the soft triangles
    solid = config.opaque and (run.solid is not None or not (config.depth or config.normals))
    run = replace(run, soup=run.solid) if solid and run.solid is not None else run
    if config.sky and not config.clean and crop is None:
        return run.soup
    least = OPAQUE_FROM if solid else 0.0
    return select(run, crop=crop, clean=config.clean, sky=config.sky, min_opacity=least, opaque=solid).of(run.soup)


def path_name(config: RenderConfig) -> str:
    """What files of a path are called."""
    return Path(config.path).stem if config.recorded else config.path


def recorded_views(run: SoupRun, config: RenderConfig) -> tuple[list[str], list[Cameras]]:
    """Names and single cameras of the frames of a path in a file. They have the shape of the photos unless it says.

    Raises:
        InputError: the file cannot be used.
    """
    keys = read_camera_path(config.path)
    frames = config.frames or max(1, KEY_FRAMES * (len(keys) - 1))
    viewmats, fovs = played(keys.viewmats, keys.fovs, frames)
    photo = None if run.capture is None else run.capture.images.sizes[run.capture.train[0]]
    width = config.width or (photo[0] if photo else USUAL_WIDTH)
    aspect = keys.aspect or (photo[0] / photo[1] if photo else USUAL_ASPECT)
    height = max(1, round(width / aspect))
    cameras = [
        Cameras(viewmats[index : index + 1].float(), intrinsics(float(fov), width, height)[None], width, height)
        for index, fov in enumerate(fovs)
    ]
    return [f"{path_name(config)}_{index:04d}" for index in range(frames)], cameras


def views_of(
    capture: Dataset, config: RenderConfig, tell: Callable[[str], None] | None = None
) -> tuple[list[str], list[Cameras]]:
    """Names and single cameras of what is to be drawn; `tell` as of `render_run`.

    Raises:
        InputError: the capture has no test views.
    """
    if config.path in ("test", "train"):
        chosen = capture.test if config.path == "test" else capture.train
        if not chosen:
            raise InputError(f"{option('path', config.path)}: the capture has no such views; draw a path instead")
        cameras = capture.cameras
        return [capture.names[index] for index in chosen], [_sized(cameras[index], config.width) for index in chosen]
    up = up_of(capture)
    if up is None:  # the cameras contradict each other: take the first one's
        up = -capture.viewmats[0, 1, :3]
    photographed = capture.viewmats[capture.train]
    frames = config.frames or usual_frames(config.path, photographed)
    viewmats = PATHS[config.path](photographed, up, frames).float()
    if tell is not None and (note := path_note(config.path, photographed, up)):
        tell(note)
    first = _sized(capture.cameras[capture.train[0]], config.width)
    names = [f"{config.path}_{index:04d}" for index in range(frames)]
    return names, [replace(first, viewmats=viewmats[index : index + 1]) for index in range(frames)]


@torch.no_grad()
def draw(soup: TriangleSoup, camera: Cameras, config: RenderConfig) -> dict[str, Float[Tensor, "H W *C"]]:
    """The images of one camera by kind: color (H, W, 3); depth (H, W), 0 where nothing is; normal (H, W, 3).

    Drawn on the soup's device, returned on the CPU.
    """
    device = soup.vertices.device
    background, camera = torch.tensor(soup.appearance.background, device=device), camera.to(device)
    pictures: dict[str, Tensor] = {}
    if config.opaque:
        pictures["color"] = over_background(soup.render_opaque(camera)[0], background).clamp(0, 1)
    if config.opaque and not (config.depth or config.normals):
        return {"color": pictures["color"].cpu()}
    outputs = ("color", *(["depth"] if config.depth else []), *(["normal"] if config.normals else []))
    rendering = soup.render(camera, backgrounds=background[None], outputs=outputs)
    if config.antialias and not config.opaque and (samples := samples_of(soup, camera)) > 1:
        fine = soup.render(camera.scaled(samples), backgrounds=background[None]).color.movedim(-1, 1)
        pictures["color"] = torch.nn.functional.avg_pool2d(fine, samples)[0].movedim(0, -1).clamp(0, 1)
    pictures.setdefault("color", rendering.color[0].clamp(0, 1))
    if rendering.depth is not None:
        pictures["depth"] = rendering.depth[0, ..., 0]
    if rendering.normal is not None:
        normals = torch.nn.functional.normalize(rendering.normal[0], dim=-1)
        pictures["normal"] = (0.5 + 0.5 * normals) * rendering.alpha[0]
    return {kind: picture.cpu() for kind, picture in pictures.items()}


def samples_of(soup: TriangleSoup, camera: Cameras) -> int:
    """How many samples along each side of a pixel are as fine as the photos that a soup was trained with; 1 to 8.

    1 of soups of which nobody knows.
    """
    try:
        focal = float(soup.notes.get(FOCAL_NOTE, "0"))
    except ValueError:
        return 1
    return min(_MOST_SAMPLES, max(1, round(focal / float(camera.Ks[0, 0, 0])))) if math.isfinite(focal) else 1


def depth_span(depth: Float[Tensor, "H W"]) -> tuple[float, float]:
    """The nearest and farthest depth that get a colour of their own."""
    seen = depth[depth > 0]
    if not len(seen):
        return 0.5, 1.0
    kept = seen[:: max(1, len(seen) // 100_000)].double()
    near, far = torch.quantile(kept, _NEAREST).item(), torch.quantile(kept, 1 - _NEAREST).item()
    return near, max(far, near * 1.001)


def color_depth(depth: Float[Tensor, "H W"], span: tuple[float, float]) -> Float[Tensor, "H W 3"]:
    """False colours by inverse depth, red near and blue far; black where nothing is."""
    near, far = span
    inverse = 1 / depth.clamp_min(1e-12)
    level = ((inverse - 1 / far) / (1 / near - 1 / far)).clamp(0, 1)
    colors = torch.from_numpy(colormaps["turbo"](level.numpy())[..., :3]).float()
    return torch.where(depth[..., None] > 0, colors, 0.0)


def _path_span(soup: TriangleSoup, cameras: list[Cameras]) -> tuple[float, float]:
    """One span for all frames of a video, from some of them drawn small: colours do not flicker."""
    probes = [cameras[index].scaled(_PROBE_WIDTH / cameras[index].width) for index in range(0, len(cameras), 8)]
    depths = [draw(soup, probe, RenderConfig(depth=True))["depth"] for probe in probes]
    return depth_span(torch.cat(depths))


def _sized(camera: Cameras, width: int | None) -> Cameras:
    return camera if width is None else camera.scaled(width / camera.width)


def _save_array(path: Path, values: Tensor) -> Path:
    with atomic_write(path) as temporary:
        np.save(temporary, values.numpy())
    return path
