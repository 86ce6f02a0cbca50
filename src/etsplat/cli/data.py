"""`etsplat data ...`: where captures come from."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from etsplat.cli.command import Command


@dataclass(frozen=True, kw_only=True)
class Sfm(Command):
    """Find the cameras of photos (structure from motion, on the CPU), so that they can be trained on.

    Needs pycolmap: pip install 'etsplat[sfm]'.

    Examples:
        etsplat data sfm photos/ --out my_scene
        etsplat data sfm video_frames/ --out my_scene --matching sequential
    """

    photos: tyro.conf.Positional[Path]
    """Folder of JPEG or PNG files, taken with one camera while walking around; 20 to 300 are good."""
    out: Path
    """Folder for the scene: images/ without lens distortion and sparse/0/."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Compare every pair of photos; or only those near in order of names, as for video. Auto: every pair up to 120."""
    max_size: int = 1600
    """Longer sides are shrunk to this many pixels."""

    def run(self, arguments: Sequence[str]) -> int:
        """Writes the scene and says which photos have no place in it."""
        from etsplat.cli.progress import PhaseBar
        from etsplat.data.structure_from_motion import find_cameras

        with PhaseBar() as bar:
            found = find_cameras(
                self.photos, self.out, matching=self.matching, max_size=self.max_size, progress=bar.show
            )
        count = len(found.placed) + len(found.unplaced)
        print(f"{len(found.placed)} of {count} photos placed, {found.points:,} points; scene in {found.scene}")
        if found.unplaced:
            shown = ", ".join(found.unplaced[:8]) + (", ..." if len(found.unplaced) > 8 else "")
            print(f"Without a place, and left out: {shown}")
        if len(found.placed) < count / 2:
            print("That is less than half: the scene will have gaps. Let photos overlap by two thirds.")
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
    """Folder with images/ and sparse/0/, of any of COLMAP's camera models; or with transforms.json of nerfstudio.
    Masks come along; every 8th image is for testing, whatever transforms.json says."""
    out: Path
    """Folder for the new scene."""
    max_size: int = 1600
    """Longer sides are shrunk to this many pixels."""

    def run(self, arguments: Sequence[str]) -> int:
        """Writes the scene."""
        from etsplat.data.undistortion import undistort_scene

        names = undistort_scene(self.source, self.out, max_size=self.max_size)
        print(f"{len(names)} images without lens distortion; scene in {self.out}")
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
