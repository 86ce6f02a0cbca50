"""Settings of `etsplat render`. Imports no torch: the command line reads them for its help."""

from dataclasses import dataclass
from typing import Annotated, Literal

from etsplat.tasks.settings import Only, Range, Settings

ViewPath = Literal["test", "train", "orbit", "ellipse", "spiral", "interpolated"]


@dataclass(frozen=True)
class RenderConfig(Settings):
    """What is drawn of a soup, from where, and into which files."""

    path: ViewPath = "test"
    """The test or training views; or a path:
    orbit, ellipse: around what the cameras look at;
    spiral: in front of it;
    interpolated: from one training camera to the next."""
    frames: Annotated[int, Range(1, 10**6), Only("along a path", lambda config: config.path not in _VIEWS)] = 120
    """Of a path."""
    fps: Annotated[int, Range(1, 240), Only("in an MP4", lambda config: config.video)] = 30
    """Frames per second of an MP4."""
    format: Literal["auto", "frames", "mp4"] = "auto"
    """PNG files or one MP4 per kind of image (needs the extra "video"). Auto: PNG for views, MP4 for paths."""
    width: Annotated[int | None, Range(16, 8192)] = None
    """Width of the images; by default that of the photos."""
    depth: bool = False
    """Draw depth too: PNG and MP4 in false colours by inverse depth, near is red; frames also as NNN_depth.npy."""
    normals: bool = False
    """Draw normals too: (n + 1) / 2 in world space, turned to the camera."""
    opaque: bool = False
    """Draw the soup as a mesh viewer would: sharp opaque triangles, 4x4 supersampling."""

    @property
    def video(self) -> bool:
        """Whether MP4 files are written."""
        return self.format == "mp4" or (self.format == "auto" and self.path not in _VIEWS)


_VIEWS = ("test", "train")
