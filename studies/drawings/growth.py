"""Runs while they go on, as moving pictures: from the sphere to an object, from points to a scene."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from etsplat.core.cameras import Cameras, intrinsics, look_at, sphere_grid
from etsplat.data.demo_object import demo_object
from etsplat.data.demo_scene import demo_photo, demo_scene, demo_surface
from etsplat.data.photograph import orbit_cameras
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.loop import Event, StepEvent
from etsplat.optim.trainer import Trainer
from etsplat.tasks.reconstruct import make_trainer
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.soup_trainer import start_trainer
from etsplat.tasks.sources import make_subject
from etsplat.tasks.starts import make_start
from etsplat.tasks.train_config import TrainConfig
from studies.objects.pictures import draw_shape

TILE = 280
FRAMES = 44
CONFIG = ReconstructConfig.demo().changed({"start.shape": "sphere"})
"""What `make demo` does, but from a sphere: fifty seconds of one core, with the pictures."""

SCENE_SIZE = (320, 240)
SCENE_CONFIG = TrainConfig.demo()
"""What `etsplat demo scene` does, without the opaque mesh: a minute or two of one core."""

_HEIGHT = 15.0
_ROUND = (-40.0, 60.0)
_MILLISECONDS = 80
_LAST_MILLISECONDS = 1500


class Frame(NamedTuple):
    """What is seen at an iteration: as it is splatted, and beside that an object's shape, or a photo of a scene."""

    iteration: int
    splatted: Float[Tensor, "H W 3"]
    beside: Float[Tensor, "H W 3"]


def watch_growth(config: ReconstructConfig = CONFIG, frames: int = FRAMES) -> list[Frame]:
    """Reconstructs the built-in object, and looks at it from all around meanwhile: first often, later rarely."""
    device = torch.device("cpu")
    views, _ = make_subject(demo_object(), config, lambda done, total: None, device)
    mesh = make_start(None, views, config, device).mesh
    trainer = make_trainer(mesh, views, config)
    around = orbit_cameras(TILE, TILE, elevations=(_HEIGHT,), azimuths=frames)
    return _watched(
        trainer, config.iterations, frames, lambda number, iteration: _look(mesh, around[[number]], iteration)
    )


def watch_scene(config: TrainConfig = SCENE_CONFIG, frames: int = FRAMES) -> list[Frame]:
    """Trains the built-in scene likewise, past which the camera moves."""
    capture = demo_scene().normalized()
    trainer = start_trainer(capture, config)
    (width, height), (first, last) = SCENE_SIZE, _ROUND
    K, surface = intrinsics(42.0, width, height)[None], demo_surface()
    angles = [first + (last - first) * k / max(1, frames - 1) for k in range(frames)]
    target, up = torch.tensor([0.0, 0.35, 0.0]), torch.tensor([0.0, 1.0, 0.0])
    eyes = sphere_grid([24.0], angles, 4.2) + target

    @torch.no_grad()
    def look(number: int, iteration: int) -> Frame:
        eye = eyes[[number]]
        photo = demo_photo(*surface, Cameras(look_at(eye, target, up), K, width, height))
        own, middle = (capture.normalization.apply(place.double()).float() for place in (eye, target[None]))
        camera = Cameras(look_at(own, middle[0], up), K, width, height)
        return Frame(iteration, trainer.model.render(camera).color[0].clamp(0, 1), photo.float() / 255)

    return _watched(trainer, config.iterations, frames, look)


def _watched(trainer: Trainer[Any], iterations: int, frames: int, look: Callable[[int, int], Frame]) -> list[Frame]:
    """What is seen of a run, of each frame by its number: of the start, then often, then rarely."""
    seen = [look(0, 0)]
    due = [round(iterations * (k / (frames - 1)) ** 2) for k in range(frames)]

    def hear(event: Event) -> None:
        while isinstance(event, StepEvent) and len(seen) < frames and event.iteration >= due[len(seen)]:
            seen.append(look(len(seen), event.iteration))

    trainer.fit(iterations, callbacks=[hear], log_every=1)
    return seen


@torch.no_grad()
def _look(mesh: TriangleMesh, camera: Cameras, iteration: int) -> Frame:
    vertices, faces = (part.detach().cpu() for part in mesh.surface())
    splatted = mesh.render(camera, backgrounds=torch.ones(1, 3)).color[0].clamp(0, 1)
    return Frame(iteration, splatted, draw_shape(vertices, faces, camera=camera))


def save_growth(path: Path, frames: Sequence[Frame]) -> None:
    """An animated WebP: at the left as triangles are splatted, at the right what is beside."""
    pairs = [torch.cat([frame.splatted, frame.beside], dim=1) for frame in frames]
    first, *others = (Image.fromarray((255 * pair).round().to(torch.uint8).numpy()) for pair in pairs)
    shown = [_MILLISECONDS] * len(others) + [_LAST_MILLISECONDS]
    first.save(path, "WEBP", save_all=True, append_images=others, duration=shown, loop=0, quality=70, method=6)
