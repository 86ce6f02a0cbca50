"""Camera paths through a capture: along its photos, around what its cameras look at, or from one of them to the next.

They stay where photos were taken: behind what was photographed from one side there is nothing to see.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import camera_centers, look_at
from etsplat.core.validation import check_count, check_finite, check_floating, check_shape
from etsplat.data.camera_coverage import INSET, Coverage, coverage, focus_point
from etsplat.data.camera_tour import largest_group, nearest_rotations, smoothed, splined, spread_of, step_lengths, tour

Viewmats = Float[Tensor, "B 4 4"]

MAX_FRAMES = 1_000_000
"""Of a path, which is made as a whole."""

FRAMES, MOST_FRAMES = 120, 480
"""Of a path where nobody says how many: the first, and as many as keep one along photos calm, up to the second."""

_CALM = math.radians(2.5)
"""From frame to frame: what it moves about what it shows, and half of what it turns."""

_STATIONS = 4000
"""By which a path along photos is smoothed."""

_LIFT = 0.7
"""Standard deviations of the cameras' heights by which an ellipse rises and sinks: half of them stand within."""


def orbit(viewmats: Viewmats, up: Float[Tensor, "3"], frames: int) -> Viewmats:
    """Around the focus, as far as the cameras go round it and where they stand on the mean, looking at the focus.

    Where they leave a gap of more than 60 degrees, from one end of what they cover to the other and back; where they do
    not look at one place, along the photos. `path_note` says which.

    Example:
        >>> cameras = etsplat.orbit_cameras(64, 64, elevations=(20.0,), azimuths=8)
        >>> etsplat.orbit(cameras.viewmats, torch.tensor([0.0, 1.0, 0.0]), frames=30).shape
        torch.Size([30, 4, 4])
    """
    frames = _check(viewmats, up, frames)
    covered = coverage(viewmats, up)
    if covered is None:
        return photos(viewmats, up, frames)
    return _looking_in(covered, _azimuths(covered, frames))


def ellipse(viewmats: Viewmats, up: Float[Tensor, "3"], frames: int) -> Viewmats:
    """An orbit that rises on one side and sinks on the other, as far as half of the cameras do there.

    Where they do not go all around, to the other end of what they cover above their mean height, and back below it.

    Example:
        >>> cameras = etsplat.orbit_cameras(64, 64, elevations=(20.0,), azimuths=8)
        >>> etsplat.ellipse(cameras.viewmats, torch.tensor([0.0, 1.0, 0.0]), frames=30).shape
        torch.Size([30, 4, 4])
    """
    frames = _check(viewmats, up, frames)
    covered = coverage(viewmats, up)
    if covered is None:
        return photos(viewmats, up, frames)
    turn = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / frames)
    return _looking_in(covered, _azimuths(covered, frames), _LIFT * turn.sin())


def spiral(viewmats: Viewmats, up: Float[Tensor, "3"], frames: int) -> Viewmats:
    """Two turns around the middle camera, within half of the cameras' spread; for scenes that are seen from one side.

    `up` is not used: it is the middle camera's own.

    Example:
        >>> cameras = etsplat.orbit_cameras(64, 64, elevations=(20.0,), azimuths=8)
        >>> etsplat.spiral(cameras.viewmats, torch.tensor([0.0, 1.0, 0.0]), frames=30).shape
        torch.Size([30, 4, 4])
    """
    frames = _check(viewmats, up, frames)
    focus, centers = focus_point(viewmats), camera_centers(viewmats.double())
    offsets = centers - centers.mean(dim=0)
    middle = int(offsets.norm(dim=1).argmin())
    own = viewmats[middle, :3, :3].double()  # rows: right, down, forward
    distance = (centers[middle] - focus).norm()
    reach = torch.minimum(0.5 * torch.quantile((offsets @ own.T).abs(), 0.9, dim=0), 0.2 * distance)
    angle = torch.arange(frames, dtype=torch.float64) * (4 * math.pi / frames)
    turns = torch.stack([angle.cos() * reach[0], angle.sin() * reach[1], (0.5 * angle).sin() * reach[2]], dim=1)
    return look_at(centers[middle] + turns @ own, focus, -own[1])


@torch.no_grad()
def photos(viewmats: Viewmats, up: Float[Tensor, "3"], frames: int) -> Viewmats:
    """Along the photos, smoothly and at even speed: in the order of the cameras where that is a way, else a short one.

    `up` is not used: orientations are means of the cameras' own.
    """
    frames = _check(viewmats, up, frames)
    if len(viewmats) == 1:
        return viewmats.double().expand(frames, 4, 4)
    positions, rotations, passed = _along(viewmats)
    at = torch.linspace(0, 1, frames, dtype=torch.float64) * passed[-1]
    last = torch.searchsorted(passed, at).clamp(1, len(passed) - 1)
    t = ((at - passed[last - 1]) / (passed[last] - passed[last - 1]).clamp_min(1e-12)).clamp(0, 1)
    position = torch.lerp(positions[last - 1], positions[last], t[:, None])
    turned = nearest_rotations(torch.lerp(rotations[last - 1], rotations[last], t[:, None, None]))
    return _viewmats(position, turned)


def interpolated(viewmats: Viewmats, up: Float[Tensor, "3"], frames: int) -> Viewmats:
    """From camera to camera in order, at even speed: positions on Catmull-Rom splines, orientations turned evenly.

    `up` is not used: orientations are the cameras' own.

    Example:
        >>> cameras = etsplat.orbit_cameras(64, 64, elevations=(20.0,), azimuths=8)
        >>> etsplat.interpolated(cameras.viewmats, torch.tensor([0.0, 1.0, 0.0]), frames=30).shape
        torch.Size([30, 4, 4])
    """
    frames = _check(viewmats, up, frames)
    if len(viewmats) == 1:
        return viewmats.double().expand(frames, 4, 4)
    centers = camera_centers(viewmats.double())
    steps = (centers[1:] - centers[:-1]).norm(dim=1)
    # Cameras at one place still take their time to turn.
    return _viewmats(*splined(viewmats, steps + 0.05 * steps.mean() + 1e-9, frames))


PATHS: dict[str, Callable[[Viewmats, Float[Tensor, "3"], int], Viewmats]] = {
    "photos": photos,
    "orbit": orbit,
    "ellipse": ellipse,
    "spiral": spiral,
    "interpolated": interpolated,
}
"""By name: (viewmats of the cameras, where up is, number of frames) to float64 viewmats of the path.

They raise ValueError where an argument has a wrong shape, dtype, device or range; the message names it.
"""


def played(viewmats: Viewmats, fovs: Float[Tensor, " B"], frames: int) -> tuple[Viewmats, Float[Tensor, " F"]]:
    """The film through key poses, at even speed, and its fields of view, float64.

    Args:
        viewmats: (B, 4, 4) world to camera.
        fovs: (B,) of the poses, in any unit.
        frames: number of stations.
    """
    if len(viewmats) == 1:
        return viewmats.double().expand(frames, 4, 4), fovs.double().expand(frames)
    centers = camera_centers(viewmats.double())
    steps = step_lengths(centers, viewmats[:, :3, :3].double(), 0.5 * spread_of(centers))
    steps = steps + 0.05 * steps.mean() + 1e-9
    time = np.concatenate([[0.0], steps.cumsum(dim=0).numpy()])
    told = np.interp(np.linspace(0, time[-1], frames), time, fovs.double().numpy())
    return _viewmats(*splined(viewmats, steps, frames)), torch.from_numpy(told)


def path_note(name: str, viewmats: Viewmats, up: Float[Tensor, "3"]) -> str | None:
    """What of a path of `PATHS` is otherwise than its name says, in a sentence; None if nothing is."""
    if name == "photos":
        left = len(viewmats) - len(largest_group(viewmats))
        stand = "1 photo stands" if left == 1 else f"{left} photos stand"
        return f"photos: {stand} apart from the others, and the path leaves that out" if left else None
    if name not in ("orbit", "ellipse"):
        return None
    covered = coverage(viewmats, up)
    if covered is None:
        return f"{name}: the photos do not look at one place from around it, so the path goes along them"
    if covered.all_around:
        return None
    degrees = math.degrees(covered.breadth)
    return f"{name}: the photos go {degrees:.0f} degrees round what they show; so does the path, there and back"


def usual_frames(name: str, viewmats: Viewmats) -> int:
    """How many frames a path of `PATHS` has where nobody says."""
    if name != "photos" or len(viewmats) == 1:
        return FRAMES
    positions, rotations, _ = _along(viewmats)
    away = (camera_centers(viewmats.double()) - focus_point(viewmats)).norm(dim=1).median().clamp_min(1e-9)
    total = step_lengths(positions / away, rotations, 0.5).sum()
    return min(max(FRAMES, math.ceil(float(total) / _CALM)), MOST_FRAMES)


def _along(viewmats: Viewmats) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3 3"], Float[Tensor, " S"]]:
    """Stations of a smooth way along at least two photos: positions, rotations, and how far each is on the way."""
    viewmats = viewmats[largest_group(viewmats)].double()
    stops, spread = viewmats[tour(viewmats)], spread_of(camera_centers(viewmats))
    if len(stops) == 1:
        stops = stops.expand(2, 4, 4)
    steps = step_lengths(camera_centers(stops), stops[:, :3, :3], spread) + 1e-9
    positions, rotations = splined(stops, steps, _STATIONS)
    width = max(0.5 * float(steps.median()), 0.2 * spread) / float(steps.sum()) * _STATIONS
    both = smoothed(torch.cat([positions, rotations.flatten(1)], dim=1), min(width, _STATIONS / 6))
    positions, rotations = both[:, :3], nearest_rotations(both[:, 3:].reshape(-1, 3, 3))
    passed = step_lengths(positions, rotations, spread).cumsum(dim=0)
    return positions, rotations, torch.cat([torch.zeros(1, dtype=torch.float64), passed])


def _azimuths(covered: Coverage, frames: int) -> Float[Tensor, " F"]:
    """Once around, or there and back, gently at the ends; from the arc's start on."""
    turn = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / frames)
    return turn if covered.all_around else 0.5 * covered.breadth * (1 - (1 - 2 * INSET) * turn.cos())


def _looking_in(covered: Coverage, azimuths: Float[Tensor, " F"], lift: Float[Tensor, " F"] | None = None) -> Viewmats:
    return look_at(covered.stations(azimuths, lift), covered.focus, covered.up)


def _viewmats(positions: Float[Tensor, "F 3"], rotations: Float[Tensor, "F 3 3"]) -> Viewmats:
    result = torch.zeros(len(positions), 4, 4, dtype=torch.float64)
    result[:, :3, :3], result[:, 3, 3] = rotations, 1.0
    result[:, :3, 3] = -torch.einsum("bij,bj->bi", rotations, positions)
    return result


def _check(viewmats: Tensor, up: Tensor, frames: int) -> int:
    """The number of frames."""
    check_shape("viewmats", viewmats, ("B", 4, 4))
    check_shape("up", up, (3,))
    for name, tensor in (("viewmats", viewmats), ("up", up)):
        check_floating(name, tensor)
        if not tensor.is_cpu:
            raise ValueError(f"{name} must be on the CPU, got {tensor.device}")
        check_finite(name, tensor)
    if len(viewmats) == 0:
        raise ValueError("viewmats must hold at least one camera, got 0")
    return check_count("frames", frames, most=MAX_FRAMES)
