"""Views of a soft soup between and beyond the photos, for the opaque mesh beside it to be fitted to as well.

Few photos leave depth free, and opaque triangles learn each of them by heart, where soft ones, seen from elsewhere,
show the mean of what would explain the photos. So the soup says what its mesh should look like from there.
"""

from dataclasses import replace

import torch

from etsplat.core.cameras import Cameras
from etsplat.data.cameras_beside import cameras_beside
from etsplat.data.changed_pictures import Joined
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import Pixels, StoredPictures
from etsplat.model.triangle_soup import TriangleSoup

EPOCHS, ENOUGH = 5, 150
"""There are as many as would be seen so often, each photo as well, in all steps of the mesh; and no more than make so
many with the photos, which leave little free then."""

MOST_PIXELS = 50_000_000
"""Of all views of a soup, which stay in memory: three or four bytes each."""


def soft_view_count(capture: Dataset, steps: int) -> int:
    """How many views of a soup there may be beside the training photos.

    Args:
        capture: photos.
        steps: how many are seen in all while the mesh is fitted, one after the other.
    """
    largest = max(width * height for width, height in capture.images.sizes)
    return max(0, min(min(steps // EPOCHS, ENOUGH) - len(capture.train), MOST_PIXELS // largest))


@torch.no_grad()
def with_soft_views(
    capture: Dataset, soup: TriangleSoup, steps: int, background: tuple[float, float, float], seed: int
) -> Dataset:
    """The capture with more views to train on, which the soup draws.

    Args:
        capture: photos, in the frame of the soup.
        soup: what was trained on them.
        steps: as of `soft_view_count`.
        background: behind the pictures, where the photos have no alpha.
        seed: of where the cameras are.
    """
    count = soft_view_count(capture, steps)
    generator = torch.Generator().manual_seed(seed)
    viewmats, nearest = cameras_beside(capture.viewmats[capture.train], count, generator)
    if not len(viewmats):
        return capture
    like = [capture.train[index] for index in nearest.tolist()]
    Ks, device = capture.Ks[like], soup.vertices.device
    alpha = capture.images[capture.train[0]].shape[-1] == 4
    behind = None if alpha else torch.tensor(background, device=device)
    pixels = list[Pixels]()
    for viewmat, K, index in zip(viewmats, Ks, like, strict=True):
        camera = Cameras(viewmat[None].float(), K[None].float(), *capture.images.sizes[index]).to(device)
        drawn = soup.render(camera, backgrounds=behind)
        seen = torch.cat([drawn.color[0], drawn.alpha[0]], dim=-1) if alpha else drawn.color[0]
        pixels.append((255 * seen.clamp(0, 1)).round().to("cpu", torch.uint8))
    names = [f"soft_{number:04d}_beside_{capture.names[index]}" for number, index in enumerate(like)]
    return replace(
        capture,
        viewmats=torch.cat([capture.viewmats, viewmats]),
        Ks=torch.cat([capture.Ks, Ks]),
        images=Joined([capture.images, StoredPictures(pixels)]),
        names=[*capture.names, *names],
        train=[*capture.train, *range(len(capture), len(capture) + len(like))],
    )
