"""A soup as a file for other programs: colours baked, faint triangles dropped, up along +y."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.io.mesh_files import save_triangles
from etsplat.io.paths import kind_of
from etsplat.io.writers import suffixes, writer_of
from etsplat.model.soup_appearance import OPAQUE_FROM
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.soup_colors import soup_colors
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.sources import SoupRun, rotation_to_y_up, training_cameras, world_up

BAKING_WIDTH = 400
"""Training views are drawn this wide to find how much each shows of a triangle."""


@dataclass(frozen=True)
class Export:
    """What was written: the file, how many triangles, and how many were left out as too faint."""

    path: Path
    triangles: int
    dropped: int


def export_soup(run: SoupRun, path: Path | str, config: ExportConfig) -> Export:
    """Write a soup to `path`, whose suffix chooses the format: .safetensors, or one of `etsplat.io.writers`.

    Raises:
        InputError: settings that contradict each other; nothing is left; the file cannot be written.
    """
    path = Path(path)
    if kind_of(path) == ".safetensors":
        run.soup.save(path)
        return Export(path, run.soup.count, 0)
    holds = writer_of(path).HOLDS
    if config.colors == "keep" and ("numbers" not in holds or config.up == "y"):
        kinds = " or ".join(suffix[1:] for suffix in suffixes("numbers"))
        raise InputError(f"colours that depend on the direction (--colors keep) need --format {kinds} and --up keep")
    if config.alpha and "alpha" not in holds:
        raise InputError(f"{path}: files of this kind hold no opacities; leave out --alpha, or choose another --format")
    soup = run.soup
    opacities = soup.drawn_opacities.detach()
    kept = opacities >= (OPAQUE_FROM if config.min_opacity is None else config.min_opacity)
    if not bool(kept.any()):
        raise InputError(
            f"{run.path}: no triangle is opaque enough; lower --min-opacity, or train with --finish opaque"
        )
    if config.colors == "mean" and run.capture is not None:
        colors = bake_colors(soup, training_cameras(run.capture))[kept]
    else:
        colors = soup.display_colors()[kept]
    vertices = soup.vertices.detach()[kept].cpu()
    up = None if run.capture is None or config.colors == "keep" else world_up(run.capture.viewmats)
    if config.up == "y" and up is not None:
        vertices = (vertices.double() @ rotation_to_y_up(up).T).float()
    if config.alpha:
        colors = torch.cat([colors, opacities[kept, None]], dim=1)
    numbers = {"opacity": opacities[kept], "sigma": soup.drawn_sigma.detach()[kept]}
    if config.colors == "keep":
        numbers |= _coefficients(soup, kept)
    comment = f"etsplat {soup.appearance.kernel} {soup.appearance.distance}"
    save_triangles(path, vertices, colors, weld=config.weld, numbers=numbers, comment=comment)
    return Export(path, len(vertices), int((~kept).sum()))


@torch.no_grad()
def bake_colors(soup: TriangleSoup, cameras: list[Cameras]) -> Float[Tensor, "N 3"]:
    """One colour for every triangle: the mean of what the cameras see, weighted by how much each sees of it.

    The weight is the largest blend weight of any pixel. A triangle that nobody sees has the part of its colour that is
    the same from every side.
    """
    device = soup.vertices.device
    total, weight = torch.zeros(len(soup), 3, device=device), torch.zeros(len(soup), 1, device=device)
    for camera in cameras:
        small = camera.scaled(min(1.0, BAKING_WIDTH / camera.width)).to(device)
        seen = soup.render(small, outputs=("statistics",)).statistics
        assert seen is not None
        colors = soup_colors(soup.vertices, soup.sh_dc, soup.sh_rest, small.centers, soup.drawn_degree)[0]
        total += seen.max_weight[0, :, None] * colors.clamp(0, 1)
        weight += seen.max_weight[0, :, None]
    return torch.where(weight > 0, total / weight.clamp_min(1e-12), soup.display_colors())


def _coefficients(soup: TriangleSoup, kept: Tensor) -> dict[str, Tensor]:
    """The harmonics by the names that Gaussian scenes use: f_rest lists all of red, then green, then blue."""
    dc, rest = soup.sh_dc.detach()[kept, 0], soup.sh_rest.detach()[kept].transpose(1, 2).flatten(1)
    named = {f"f_dc_{channel}": dc[:, channel] for channel in range(3)}
    return named | {f"f_rest_{index}": rest[:, index] for index in range(rest.shape[1])}
