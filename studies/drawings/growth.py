"""A reconstruction while it runs, as a moving picture: from the sphere to the object."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import orbit_cameras
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.loop import Event, StepEvent
from etsplat.tasks.reconstruct import make_trainer
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.sources import make_subject
from etsplat.tasks.starts import make_start
from studies.objects.pictures import draw_shape

TILE = 280
FRAMES = 44
CONFIG = ReconstructConfig.demo().changed({"start.shape": "sphere"})
"""What `make demo` does, but from a sphere: fifty seconds of one core, with the pictures."""

_HEIGHT = 15.0
_MILLISECONDS = 80
_LAST_MILLISECONDS = 1500


class Frame(NamedTuple):
    """What is seen at an iteration: (TILE, TILE, 3) each, over white."""

    iteration: int
    splatted: Float[Tensor, "H W 3"]
    shape: Float[Tensor, "H W 3"]


def watch_growth(config: ReconstructConfig = CONFIG, frames: int = FRAMES) -> list[Frame]:
    """Reconstructs the built-in object, and looks at it from all around meanwhile: first often, later rarely."""
    device = torch.device("cpu")
    views, _ = make_subject(demo_object(), config, lambda done, total: None, device)
    mesh = make_start(None, views, config, device).mesh
    trainer = make_trainer(mesh, views, config)
    around = orbit_cameras(TILE, TILE, elevations=(_HEIGHT,), azimuths=frames)
    seen = [_look(mesh, around[[0]], 0)]
    due = [round(config.iterations * (k / (frames - 1)) ** 2) for k in range(frames)]

    def look(event: Event) -> None:
        while isinstance(event, StepEvent) and len(seen) < frames and event.iteration >= due[len(seen)]:
            seen.append(_look(mesh, around[[len(seen)]], event.iteration))

    trainer.fit(config.iterations, callbacks=[look], log_every=1)
    return seen


@torch.no_grad()
def _look(mesh: TriangleMesh, camera: Cameras, iteration: int) -> Frame:
    vertices, faces = (part.detach().cpu() for part in mesh.surface())
    splatted = mesh.render(camera, backgrounds=torch.ones(1, 3)).color[0].clamp(0, 1)
    return Frame(iteration, splatted, draw_shape(vertices, faces, camera=camera))


def save_growth(path: Path, frames: Sequence[Frame] | None = None) -> None:
    """An animated WebP: at the left as triangles are splatted, at the right the mesh that they are."""
    frames = frames or watch_growth()
    pairs = [torch.cat([frame.splatted, frame.shape], dim=1) for frame in frames]
    first, *others = (Image.fromarray((255 * pair).round().to(torch.uint8).numpy()) for pair in pairs)
    shown = [_MILLISECONDS] * len(others) + [_LAST_MILLISECONDS]
    first.save(path, "WEBP", save_all=True, append_images=others, duration=shown, loop=0, quality=70, method=6)
