"""What a run of a part of a scene has from the whole: its frame, what lies around it, its start, exposures."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset, Normalization
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.drive import digest_of
from etsplat.optim.exposure import Exposure
from etsplat.optim.known_exposure import KnownExposure
from etsplat.optim.schedules import NEVER


@dataclass(frozen=True)
class ScenePart:
    """In the whole's own units, on the CPU.

    Attributes:
        frame: of the whole, from its own units to where it is trained.
        rest: triangles around the part, which are drawn with it and stay as they are.
        start: triangles to start from; None for those that are put at the capture's points.
        closed: the sphere that the sky is on; None without a sky.
        exposure: by names of photos, how each saw the colours of the scene; empty where all were exposed alike.
    """

    frame: Normalization
    rest: TriangleSoup
    start: TriangleSoup | None = None
    closed: Surroundings | None = None
    exposure: Mapping[str, Float[Tensor, "3 3"]] = field(default_factory=dict)

    def digest(self) -> str:
        """Names all that a result depends on."""
        soups = {"rest": self.rest, "start": self.start}
        tensors = {f"{name}.{key}": t for name, soup in soups.items() if soup for key, t in soup.state().items()}
        tensors |= {f"exposure.{name}": matrix for name, matrix in self.exposure.items()}
        about = repr((self.frame.center.tolist(), self.frame.radius, self.closed and self.closed.note))
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
