"""Settings of `etsplat render`. Imports no torch: the command line reads them for its help."""

from dataclasses import dataclass
from typing import Annotated, Literal

from etsplat.tasks.settings import OneOf, Only, Range, Settings

VIEWS = ("test", "train")
PATHS = ("photos", "orbit", "ellipse", "spiral", "interpolated")
"""What may be drawn by name: views of the capture, and paths through it."""


@dataclass(frozen=True)
class RenderConfig(Settings):
    """What is drawn of a soup, from where, and into which files."""

    path: Annotated[str, OneOf(lambda: VIEWS + PATHS, ".json")] = "test"
    """Test or train: those views of the capture. Or a path:
    photos: smoothly along the training photos;
    orbit, ellipse: around what the photos show, as far as they go round it;
    spiral: in front of it;
    interpolated: from one training camera to the next, as they are named;
    FILE.json: through poses that were recorded in the viewer."""
    frames: Annotated[int | None, Range(1, 10**6), Only("along a path", lambda config: config.path not in VIEWS)] = None
    """Of a path; by default 120:
    along photos as many as keep it calm, up to 480;
    60 from pose to pose of a file."""
    fps: Annotated[int, Range(1, 240), Only("in an MP4", lambda config: config.video)] = 30
    """Frames per second of an MP4."""
    format: Literal["auto", "frames", "mp4"] = "auto"
    """PNG files or one MP4 per kind of image (needs the extra "video"). Auto: PNG for views, MP4 for paths."""
    width: Annotated[int | None, Range(16, 8192)] = None
    """Width of the images; by default that of the photos."""
    antialias: bool = True
    """Where pictures show less than the photos of the training did, take the mean of as many samples of each pixel.
    Triangles that are smaller than its pixels would flicker, and miss its light."""
    depth: bool = False
    """Draw depth too: PNG and MP4 in false colours by inverse depth, near is red; frames also as NNN_depth.npy."""
    normals: bool = False
    """Draw normals too: (n + 1) / 2 in world space, turned to the camera."""
    opaque: bool = False
    """Draw the soup as a mesh viewer would: sharp opaque triangles, 4x4 supersampling."""
    sky: bool = True
    """Draw what is behind everything, at the distance of the sky."""
    clean: bool = False
    """Draw what `etsplat export --clean` keeps: of the soft triangles, or with --opaque of the opaque ones."""

    @property
    def video(self) -> bool:
        """Whether MP4 files are written."""
        return self.format == "mp4" or (self.format == "auto" and self.path not in VIEWS)

    @property
    def recorded(self) -> bool:
        """Whether the path is a file of poses."""
        return self.path.lower().endswith(".json")
