"""What a run of a part of a scene has from the whole: its frame, what lies around it, its start, exposures."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from jaxtyping import Float
from safetensors import SafetensorError
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset, Normalization
from etsplat.io.tensors import read_tensors, save_tensors
from etsplat.model.surrounded_soup import SurroundedSoup
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.drive import digest_of
from etsplat.optim.exposure import Exposure
from etsplat.optim.known_exposure import KnownExposure
from etsplat.optim.schedules import NEVER

_AROUND, _COLORS = "around.safetensors", "sh_dc"
"""In the folder of a run that recolours its rest: the plain colours of that."""


@dataclass(frozen=True)
class ScenePart:
    """In the whole's own units, on the CPU.

    Attributes:
        frame: of the whole, from its own units to where it is trained.
        rest: triangles around the part, which are drawn with it and stay where they are.
        start: triangles to start from; None for those that are put at the capture's points.
        closed: the sphere that the sky is on; None without a sky.
        exposure: by names of photos, how each saw the colours of the scene; empty where all were exposed alike.
        recolors: whether plain colours of the rest learn as well.
    """

    frame: Normalization
    rest: TriangleSoup
    start: TriangleSoup | None = None
    closed: Surroundings | None = None
    exposure: Mapping[str, Float[Tensor, "3 3"]] = field(default_factory=dict)
    recolors: bool = False

    def digest(self) -> str:
        """Names all that a result depends on."""
        soups = {"rest": self.rest, "start": self.start}
        tensors = {f"{name}.{key}": t for name, soup in soups.items() if soup for key, t in soup.state().items()}
        tensors |= {f"exposure.{name}": matrix for name, matrix in self.exposure.items()}
        about = repr((self.frame.center.tolist(), self.frame.radius, self.closed and self.closed.note, self.recolors))
        return hashlib.sha256((digest_of(tensors) + about).encode()).hexdigest()[:16]

    def exposures(self, capture: Dataset) -> Exposure:
        """Of a part of the capture, as the whole has them.

        Raises:
            InputError: they are not those of its photos.
        """
        if not self.exposure:
            return Exposure(NEVER)
        names = {view: capture.names[view] for view in capture.train}
        if missing := sorted(set(names.values()) - set(self.exposure)):
            raise InputError(f"exposure.json: says nothing of {missing[0]}; remove the folder and run again")
        return KnownExposure({view: self.exposure[name] for view, name in names.items()})


def keep_colors(soup: TriangleSoup, folder: Path) -> None:
    """Writes what a soup's surroundings have learned, if they have."""
    if isinstance(soup, SurroundedSoup) and soup.rest_dc is not None:
        save_tensors(folder / _AROUND, {_COLORS: soup.rest_dc})


def recolored(rest: TriangleSoup, folder: Path) -> TriangleSoup:
    """The rest of a run that is done, in the colours that it learned there.

    Raises:
        InputError: these are missing, or of others.
    """
    path = folder / _AROUND
    try:
        colors = read_tensors(path)[0][_COLORS]
        if colors.shape != rest.sh_dc.shape:
            raise ValueError(f"of {len(colors):,} triangles, not {len(rest):,}")
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        detail = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: cannot be read ({detail}); remove its folder and run again") from error
    return replace(rest, sh_dc=colors)


def in_frame(soup: TriangleSoup, frame: Normalization) -> TriangleSoup:
    """A soup in its capture's own units, in the frame that this leads to."""
    near = soup.appearance.near_plane / frame.radius
    return replace(
        soup,
        vertices=frame.apply(soup.vertices.detach().double()).float(),
        appearance=replace(soup.appearance, near_plane=near),
    )


def sphere_in_frame(sphere: Surroundings, frame: Normalization) -> Surroundings:
    """Likewise the sphere of the sky."""
    return Surroundings(frame.apply(sphere.middle.double()).float(), sphere.radius / frame.radius)
