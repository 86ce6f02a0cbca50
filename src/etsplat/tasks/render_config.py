"""Settings of `etsplat render`. Imports no torch: the command line reads them for its help."""

from dataclasses import dataclass
from typing import Literal

from etsplat.core.errors import InputError

ViewPath = Literal["test", "train", "orbit", "ellipse", "spiral", "interpolated"]


@dataclass(frozen=True)
class RenderConfig:
    """What is drawn of a soup, from where, and into which files."""

    path: ViewPath = "test"
    """The test or training views; or a path: around what the cameras look at (orbit, ellipse), in front of it
    (spiral), or from one training camera to the next (interpolated)."""
    frames: int = 120
    """Of a path."""
    fps: int = 30
    """Frames per second of an MP4."""
    format: Literal["auto", "frames", "mp4"] = "auto"
    """PNG files or one MP4 per kind of image (needs the extra "video"). Auto: PNG for views, MP4 for paths."""
    width: int | None = None
    """Width of the images; by default that of the photos."""
    depth: bool = False
    """Draw depth too: PNG and MP4 in false colours by inverse depth, near is red; frames also as NNN_depth.npy."""
    normals: bool = False
    """Draw normals too: (n + 1) / 2 in world space, turned to the camera."""
    opaque: bool = False
    """Draw the soup as a mesh viewer would: sharp opaque triangles, 4x4 supersampling."""

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise InputError(f"frames: is {self.frames}; it must be at least 1")
        if not 1 <= self.fps <= 240:
            raise InputError(f"fps: is {self.fps}; it must be from 1 to 240")
        if self.width is not None and not 16 <= self.width <= 8192:
            raise InputError(f"width: is {self.width}; it must be from 16 to 8192")

    @property
    def video(self) -> bool:
        """Whether MP4 files are written."""
        return self.format == "mp4" or (self.format == "auto" and self.path not in ("test", "train"))
