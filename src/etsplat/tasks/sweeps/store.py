"""Run directories kept where fsspec reaches: `s3://` and others, for machines that share no folder.

fsspec comes with torch; what it needs for a protocol is an extra of its own (s3fs for `s3://`). A file of a bucket
appears whole or not at all, and a run's files are copied in such an order that it can be resumed at any moment.
"""

from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.io.atomic import atomic_write
from etsplat.io.locks import RUN_LOCK

_LAST = ("history.jsonl", "config.json", "metrics.json")
"""In this order after all others: a run is there once its config.json is, and done once its metrics.json is."""


class Store:
    """A run directory and its copy.

    Attributes:
        url: of the copy, as fsspec names it.
        folder: the run directory.
    """

    def __init__(self, url: str, folder: Path) -> None:
        """Opens the file system.

        Raises:
            InputError: there is no such protocol, or what it needs is not installed.
        """
        self.url, self.folder = url, folder
        self._files, self._root = open_store(url)
        self._kept: dict[str, tuple[int, int]] = {}

    def fetch(self, *, results_only: bool = False) -> None:
        """Copies what is kept into the folder; of a run that is not done only what it needs to go on.

        Args:
            results_only: nothing of a run that is not done, and no checkpoints.

        Raises:
            InputError: the copy cannot be read, or the folder not written to.
        """
        try:
            there = {name.removeprefix(f"{self._root}/"): name for name in self._files.find(self._root)}
            if results_only and "metrics.json" not in there:
                return
            for name in sorted(there, key=_place):
                if not (results_only and name.startswith("checkpoints/")):
                    (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                    with atomic_write(self.folder / name) as temporary:
                        self._files.get_file(there[name], str(temporary))
        except InputError:
            raise
        except Exception as error:  # each protocol has errors of its own
            raise _unreachable(self.url, error) from error

    def keep(self) -> None:
        """Copies what has changed in the folder since the last time, and removes what is not in it any more.

        Raises:
            InputError: the copy cannot be written.
        """
        own = {path.relative_to(self.folder).as_posix(): path for path in self.folder.rglob("*") if path.is_file()}
        own = {name: path for name, path in own.items() if not path.name.startswith(".")}
        assert RUN_LOCK not in own
        try:
            for name in sorted(own, key=_place):
                state = own[name].stat()
                if self._kept.get(name) != (state.st_size, state.st_mtime_ns):
                    self._files.makedirs(f"{self._root}/{name}".rpartition("/")[0], exist_ok=True)
                    self._files.put_file(str(own[name]), f"{self._root}/{name}")
                    self._kept[name] = (state.st_size, state.st_mtime_ns)
            for name in self._files.find(self._root):
                if name.removeprefix(f"{self._root}/") not in own:
                    self._files.rm_file(name)
        except Exception as error:
            raise _unreachable(self.url, error) from error


def open_store(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it.

    Raises:
        InputError: there is no such protocol, or what it needs is not installed.
    """
    import fsspec

    try:
        files, root = fsspec.url_to_fs(url, use_listings_cache=False, skip_instance_cache=True)
    except ImportError as error:
        what = "'etsplat[s3]'" if url.startswith(("s3:", "s3a:")) else "what fsspec names"
        raise InputError(f"store {url}: needs a package that is not installed ({error}); pip install {what}") from error
    except ValueError as error:
        raise InputError(f"store {url}: {error}; write it as fsspec does, such as s3://BUCKET/FOLDER") from error
    return files, str(root).rstrip("/")


def _place(name: str) -> tuple[int, str]:
    return (_LAST.index(name) + 1 if name in _LAST else 0), name


def _unreachable(url: str, error: Exception) -> InputError:
    return InputError(f"store {url}: {type(error).__name__}: {error}; check the address and your rights")
