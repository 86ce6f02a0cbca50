"""A scene that one can send: its compact file, and the page in which browsers show it."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.camera_coverage import focus_point
from etsplat.data.dataset import Dataset
from etsplat.data.looked_at import middle_photo
from etsplat.data.where_up import noted_up, up_of
from etsplat.geometry.similarity import rotation_between
from etsplat.io.compact_soups import encode_compact
from etsplat.model.solid_soup import SolidSoup
from etsplat.model.soup_compact import compact_of, ranks
from etsplat.model.triangle_soup import UP_NOTE, TriangleSoup
from etsplat.tasks.opened_runs import SoupRun, training_cameras
from etsplat.web.pages import ScenePage

SMALL_WIDTH = 400
"""Training views are drawn this wide to find how much each shows of a triangle."""

_USUAL_LENS = (1.1, 1.1, 0.5, 0.5, 1.0, 1.0)


def small_camera(camera: Cameras) -> Cameras:
    """The same camera with a picture that is no wider than `SMALL_WIDTH`."""
    return camera.scaled(min(1.0, SMALL_WIDTH / camera.width))


def compact_bytes(soup: TriangleSoup, capture: Dataset | None, most: int | None = None) -> bytes:
    """The compact file of a soup or an opaque mesh, of which any part from the start shows as much as so many can.

    Args:
        soup: what is written.
        capture: whose photos say what is important; None: opacity and size do.
        most: so many triangles at most.

    Raises:
        InputError: the soup is drawn with a kernel that was registered from Python.
    """
    cameras = [] if capture is None else [small_camera(camera) for camera in training_cameras(capture)]
    return encode_compact(compact_of(soup, ranks(soup, cameras), most))


def scene_of(run: SoupRun, soup: TriangleSoup, solid: SolidSoup | None, most: int | None = None) -> ScenePage:
    """What the page of a scene holds.

    Args:
        run: what was opened; its capture, where it is known, gives the cameras.
        soup: what is shown of it.
        solid: what is shown of its opaque mesh, or None.
        most: so many triangles of the soup at most, chosen without drawing it from every photo; None: all of them,
            in the order in which photos show most of them.

    Raises:
        InputError: the soup is drawn with a kernel that was registered from Python.
    """
    mesh = None if solid is None else compact_bytes(solid, None)
    view = _without_photos(soup) if run.capture is None else _photos(run.capture)
    name = run.path.resolve().name if run.path.is_dir() else run.path.stem
    return ScenePage(name, compact_bytes(soup, run.capture if most is None else None, most), mesh, view)


def _photos(capture: Dataset) -> dict[str, Any]:
    """The photos by name, from where one looks first, and what they look at."""
    photos = sorted([*capture.train, *capture.test, *capture.watched])
    up = up_of(capture)
    return {
        "cameras": [
            _camera(capture.names[index], capture.viewmats[index], capture.Ks[index], capture.images.sizes[index])
            for index in photos
        ],
        "start": photos.index(middle_photo(capture)),
        "focus": focus_point(capture.viewmats).tolist(),
        "radius": capture.extent,
        "up": None if up is None else up.tolist(),
    }


def _without_photos(soup: TriangleSoup) -> dict[str, Any]:
    """One camera, far enough away to see nine tenths of the triangles, with +y up unless the soup knows better."""
    centers = soup.vertices.detach().double().mean(dim=1).cpu()
    middle = centers.median(dim=0).values
    radius = max(float(torch.quantile((centers - middle).norm(dim=1)[:1_000_000], 0.9)), 1e-6)
    level = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    known = noted_up(soup.notes.get(UP_NOTE))
    up = level if known is None else known
    aside = rotation_between(level, up) @ torch.tensor([0.3, 0.3, 0.9], dtype=torch.float64)
    eye = middle + aside * 2.5 * radius
    forward = torch.nn.functional.normalize(middle - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(-up, forward), dim=0)
    rows = torch.stack([right, torch.linalg.cross(forward, right), forward])
    overview = {"name": "overview", "rows": rows.tolist(), "eye": eye.tolist(), "lens": list(_USUAL_LENS)}
    return {"cameras": [overview], "start": 0, "focus": middle.tolist(), "radius": radius, "up": up.tolist()}


def _camera(name: str, viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], size: tuple[int, int]) -> dict[str, Any]:
    rotation, translation = viewmat[:3, :3].double(), viewmat[:3, 3].double()
    lens = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), *map(float, size)]
    eye = (-rotation.T @ translation).tolist()
    return {"name": Path(name).name, "rows": rotation.tolist(), "eye": eye, "lens": lens}
