"""The captures and meshes of the paper's tables, fetched from where their authors keep them."""

import os
import shutil
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from etsplat.core.errors import InputError
from etsplat.io.atomic import write_error
from etsplat.io.locks import scratch_folder
from etsplat.io.paths import path_within

_CHUNK = 1 << 20
_TOO_LARGE = 2
"""Times its size at which an archive is another one."""


@dataclass(frozen=True)
class Dataset:
    """An archive of captures or meshes.

    Attributes:
        url: of the zip file.
        scenes: folders in it that are scenes, or mesh files.
        gigabytes: about how large the archive is.
    """

    url: str
    scenes: tuple[str, ...]
    gigabytes: float


_FAMOUS = (
    "armadillo/armadillo",
    "boot/boot",
    "brucewick/brucewick",
    "bunny/bunny_hr",
    "cat/cat-low-resolution",
    "cow/cow-low-resolution",
    "demosthenes/demosthenes",
    "falconstatue/falconstatue",
    "goathead/goathead",
    "hand/hand_closed",
    "house/house",
    "human/human_neutral",
    "koala/koala",
    "mushroom/mushroom",
    "nefertiti/nefertiti-lowres",
    "scorpion/scorpion",
    "skull/skull",
    "springer/springer",
    "strawberry/strawberry",
    "stuffedtoy/stuffedtoy",
    "tree/tree_closed",
)
"""The paper's 21 objects, in the layout of the repository."""

DATASETS = {
    "mipnerf360": Dataset(
        "https://storage.googleapis.com/gresearch/refraw360/360_v2.zip",
        ("bicycle", "garden", "stump", "room", "counter", "kitchen", "bonsai"),
        12.5,
    ),
    "mipnerf360-extra": Dataset(
        "https://storage.googleapis.com/gresearch/refraw360/360_extra_scenes.zip", ("flowers", "treehill"), 3.0
    ),
    "tandt-db": Dataset(
        "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip",
        ("tandt/train", "tandt/truck", "db/drjohnson", "db/playroom"),
        0.7,
    ),
    "famous": Dataset(
        "https://github.com/odedstein/meshes/archive/refs/heads/master.zip",
        tuple(f"meshes-master/objects/{path}.obj" for path in _FAMOUS),
        0.4,
    ),
}
"""By name: Mip-NeRF 360 in its two archives; Tanks and Temples with Deep Blending as 3DGS prepared them; the meshes of
the table famous (each with its own licence in its folder, several of them non-commercial)."""


def download_dataset(
    name: str, folder: Path | str, *, progress: Callable[[int, int], None] | None = None
) -> list[Path]:
    """Fetch and unpack a data set, unless its scenes are there already.

    None of the archives has a published hash. What comes must have about the known size, and the known scenes; nothing
    of another archive stays.

    Args:
        name: a key of DATASETS.
        folder: gets the scenes.
        progress: called with (bytes fetched, bytes in all; 0 if the server does not tell).

    Returns:
        The folders of the scenes, or the mesh files.

    Raises:
        InputError: there is no network or no such file any more; the disk is full; the archive is damaged or another.
    """
    dataset, folder = DATASETS[name], Path(folder)
    scenes = [folder / scene for scene in dataset.scenes]
    if all(map(_is_scene, scenes)):
        return scenes
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with scratch_folder(folder / name) as scratch:
            archive, unpacked = scratch / "archive.zip", scratch / "unpacked"
            _fetch(name, dataset, archive, progress)
            with zipfile.ZipFile(archive) as file:
                for member in file.namelist():
                    path_within(unpacked, member, dataset.url)
                file.extractall(unpacked)
            missing = [scene for scene in dataset.scenes if not _is_scene(unpacked / scene)]
            if missing:
                raise InputError(f"data set {name}: {dataset.url} is another archive now, without {missing[0]}")
            _move(unpacked, folder)
    except (urllib.error.URLError, TimeoutError, ConnectionError) as error:
        reason = getattr(error, "reason", error)
        raise InputError(
            f"data set {name}: cannot reach {dataset.url} ({reason}); fetch it ({dataset.gigabytes:g} GB) where there"
            f" is a network and unpack it into {folder}"
        ) from error
    except zipfile.BadZipFile as error:
        raise InputError(f"data set {name}: {dataset.url} is damaged or not a zip file; try again") from error
    except OSError as error:
        raise write_error(folder, error) from error
    return scenes


def _is_scene(path: Path) -> bool:
    return path.is_file() or (path / "sparse").is_dir()


def _fetch(name: str, dataset: Dataset, path: Path, progress: Callable[[int, int], None] | None) -> None:
    most = int(_TOO_LARGE * dataset.gigabytes * 1e9)
    with urllib.request.urlopen(dataset.url, timeout=30) as response, open(path, "wb") as file:
        total, done = int(response.headers.get("Content-Length") or 0), 0
        if total and shutil.disk_usage(path.parent).free < 2 * total:
            raise OSError(f"{2 * total >> 30} GB are needed for the archive and what is in it")
        while chunk := response.read(_CHUNK):
            file.write(chunk)
            done += len(chunk)
            if done > most:
                raise InputError(
                    f"data set {name}: {dataset.url} is larger than the {dataset.gigabytes:g} GB that it should have"
                )
            if progress is not None:
                progress(done, total)


def _move(source: Path, target: Path) -> None:
    """Into folders that exist file by file, else whole. By name, so that a scene has its sparse/ last."""
    if not (source.is_dir() and target.is_dir()):
        os.replace(source, target)
        return
    for child in sorted(source.iterdir()):
        _move(child, target / child.name)
