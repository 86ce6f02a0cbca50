"""`etsplat data ...`: where captures come from."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from etsplat.cli.command import Command

if TYPE_CHECKING:
    from etsplat.data.gps_alignment import MapFit


@dataclass(frozen=True, kw_only=True)
class Sfm(Command):
    """Find the cameras of photos or of a video (structure from motion, on the CPU), so that they can be trained on.

    Needs pycolmap: pip install 'etsplat[sfm]'; HEIC also needs pillow-heif (extra heic), videos imageio-ffmpeg (video).
    Photos are turned upright as their EXIF says, which also gives focal lengths to start from.

    Examples:
        etsplat data sfm photos/ --out my_scene
        etsplat data sfm walk.mp4 --out my_scene --frames 200
    """

    photos: tyro.conf.Positional[Path]
    """Folder of JPEG, PNG or HEIC files, also in subfolders, taken while walking around; 20 to 300 are good.
    Or a video: its sharpest frames are taken, evenly spread over what moves, and kept in OUT/frames."""
    out: Path
    """Folder for the scene: images/ without lens distortion and sparse/0/."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Compare every pair of photos; or only those near in order of names.
    Auto: every pair up to 120, and of more where fewer than half could be placed."""
    cameras: Literal["auto", "folder", "photo"] = "auto"
    """Which photos of one size share a camera and its lens setting.
    Auto: those whose EXIF names the same camera and focal length; without EXIF, those of one subfolder.
    Folder: those of one subfolder, whatever EXIF says. Photo: none."""
    mapper: Literal["incremental", "global"] = "incremental"
    """Place cameras one after the other; or all at once (GLOMAP)."""
    frames: int = 120
    """Of a video: how many frames are chosen; fewer where less moves."""
    masks: Literal["own", "auto", "none"] = "own"
    """Of an object, for `etsplat reconstruct`: where it is in the photos, which masks/ of the scene say then.
    Own: as they bring it along, transparent around it or with masks/NAME.png among them; else there are none.
    Auto: by the colours of a plain background. Photos whose background is not plain are left out.
    Shadows and what the object stands on count as object; parts that have the background's colour are lost."""
    max_size: int = 1600
    """Longer sides are shrunk to this many pixels."""

    def run(self, arguments: Sequence[str]) -> int:
        """Writes the scene and says which photos have no place in it."""
        from etsplat.cli.progress import PhaseBar
        from etsplat.data.structure_from_motion import find_cameras

        with PhaseBar() as bar:
            found = find_cameras(
                self.photos,
                self.out,
                matching=self.matching,
                cameras=self.cameras,
                mapper=self.mapper,
                frames=self.frames,
                masks=self.masks,
                max_size=self.max_size,
                progress=bar.show,
            )
        count = len(found.placed) + len(found.unplaced)
        cameras = f" of {found.cameras} cameras" if found.cameras > 1 else ""
        masks = " with their masks" if found.masked else ""
        what = f"{len(found.placed)} of {count} photos{cameras} placed{masks}, {found.points:,} points"
        print(f"{what}; scene in {found.scene}")
        if found.unplaced:
            shown = ", ".join(found.unplaced[:8]) + (", ..." if len(found.unplaced) > 8 else "")
            print(f"Without a place, and left out: {shown}")
        if found.unread:
            shown = ", ".join(found.unread[:8]) + (", ..." if len(found.unread) > 8 else "")
            print(f"Not read, and left out: {shown}; convert them to JPEG or PNG")
        if found.unmasked:
            why = "; ".join(f"{name}: {problem}" for name, problem in list(found.unmasked.items())[:8])
            print(f"Without a mask, and left out: {len(found.unmasked)} photos ({why})")
        if found.on_map is not None:
            print(_map_note(found.on_map))
        if len(found.placed) < count / 2:
            print("That is less than half: the scene will have gaps. Let photos overlap by two thirds.")
        return 0


def _map_note(fit: "MapFit") -> str:
    """What became of where photos say that they were taken."""
    beside = f"{fit.error:.2g} m, beside {fit.across:.2g} m that they spread across"
    if not fit.believed:
        return f"GPS of {fit.count} photos not used, it is off by {beside}: axes and unit are arbitrary"
    scale = fit.to_map.scale
    return (
        f"GPS of {fit.count} photos agrees to {beside}: z is up, a unit is {scale:.4g} m. georeference.json has the"
        f" place ({fit.crs}); etsplat export --scale {scale:.4g} writes metres, --place world coordinates of the map"
    )


@dataclass(frozen=True, kw_only=True)
class Masks(Command):
    """Write masks for the posed photos of an object: before a plain background, or on a table, a floor or the ground.

    Nothing is learned or fetched. Before a plain background colours tell, and shadows and what the object stands on
    count as object; parts that have the background's colour are lost. On a surface depths tell, of a soup of triangles
    that is fitted to the photos first, which takes a minute or two; whatever stands there, whole in nearly all photos,
    is the object.

    Examples:
        etsplat data masks my_scene/ --out my_scene/masks
        etsplat data masks my_scene/ --out my_scene/masks --soup runs/my_scene
        etsplat reconstruct my_scene/ --out runs/my_object
    """

    source: tyro.conf.Positional[Path]
    """Folder with posed photos, of any layout that `etsplat reconstruct` reads."""
    out: Path
    """Folder for the masks: masks/ in the scene, where they are found, or any other, for `--masks`."""
    by: Literal["auto", "background", "surface"] = "auto"
    """Background: the colours of a plain one. Surface: what stands on one.
    Auto: the background where half of the photos have a plain one, else the surface."""
    soup: Path | None = None
    """Run of `etsplat train` over the scene to go by the surface with; else a small one is made, and thrown away."""

    def run(self, arguments: Sequence[str]) -> int:
        """Writes them, and says which photos have none."""
        from etsplat.cli.progress import PhaseBar
        from etsplat.tasks.object_masks import mask_capture

        with PhaseBar() as bar:
            masked = mask_capture(self.source, self.out, by=self.by, soup=self.soup, progress=bar.show)
        how = "a plain background" if masked.by == "background" else "the surface that the object stands on"
        print(f"{masked.count} masks in {self.out}, by {how}")
        for name, problem in masked.refused.items():
            print(f"Without a mask: {name}, as {problem}. Draw one, or take the photo out of the scene.")
        return 0


@dataclass(frozen=True, kw_only=True)
class Undistort(Command):
    """Write a scene anew without lens distortion, in COLMAP's layout: what every other command wants.

    Needs pycolmap: pip install 'etsplat[sfm]'.

    Examples:
        etsplat data undistort distorted_scene/ --out my_scene
        etsplat data undistort nerfstudio_capture/ --out my_scene --max-size 1000
    """

    source: tyro.conf.Positional[Path]
    """Folder with images/ and sparse/0/, of any of COLMAP's camera models;
    or of any other program whose files are read: nerfstudio, Metashape, RealityCapture and others.
    Masks come along, and which images are for testing; depth maps do not."""
    out: Path
    """Folder for the new scene."""
    max_size: int = 1600
    """Longer sides are shrunk to this many pixels."""

    def run(self, arguments: Sequence[str]) -> int:
        """Writes the scene."""
        from etsplat.data.undistortion import undistort_scene

        notes: list[str] = []
        names = undistort_scene(self.source, self.out, max_size=self.max_size, tell=notes.append)
        print(f"{len(names)} images without lens distortion; scene in {self.out}")
        for note in notes:
            print(f"  {note}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Download(Command):
    """Fetch the captures and meshes of the paper's tables: Mip-NeRF 360, Tanks and Temples, Deep Blending, FAMOUS.

    Examples:
        etsplat data download tandt-db --out data
        etsplat data download famous --out data
        etsplat train data/tandt/truck --out runs/truck
    """

    name: tyro.conf.Positional[Literal["mipnerf360", "mipnerf360-extra", "tandt-db", "famous"]]
    """Of scenes: mipnerf360 (7, 12.5 GB), mipnerf360-extra (flowers and treehill, 3 GB), tandt-db (4, 0.7 GB).
    Of meshes: famous (those of shape reconstruction, 0.4 GB)."""
    out: Path = Path("data")
    """Folder for the scenes."""

    def run(self, arguments: Sequence[str]) -> int:
        """Fetches and unpacks."""
        from etsplat.cli.progress import PhaseBar
        from etsplat.io.datasets import download_dataset

        with PhaseBar() as bar:
            scenes = download_dataset(
                self.name, self.out, progress=lambda done, total: bar.show("Fetching MB", done >> 20, total >> 20)
            )
        print("\n".join(str(scene) for scene in scenes))
        return 0
