"""The folder that holds a run: what may become one, and how its files are written.

A folder is a run's if it holds a config.json that says so. Files are written whole or not at all, except history.jsonl,
which grows by a line at a time; a line that a kill cut short is ignored and, on resume, removed. Who writes holds the
folder's lock (`io/locks.py`); readers need none.
"""

import contextlib
import json
import math
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.io.atomic import atomic_write, destination_of, write_error
from etsplat.io.georeference import GEOREFERENCE_FILE
from etsplat.io.json_text import as_json, check_entries, entries_problem, json_differences, parse_json
from etsplat.io.locks import RUN_LOCK
from etsplat.io.run_readme import readme_of

FORMAT = "etsplat run 1"

KERNEL_FILE = "kernel.safetensors"
"""The table of the run's kernel; there where that is none of the built-in ones."""

_FILES = (
    *("mesh.ply", "mesh.obj", "mesh.glb", "textured.glb"),
    *("soup.safetensors", "opaque.glb", "opaque.safetensors", "gaussians.safetensors", "around.safetensors"),
    KERNEL_FILE,
    *("metrics.json", "evaluation.json", "exposure.json", "cameras.json"),
    GEOREFERENCE_FILE,
    "history.jsonl",
    "convergence.png",
    "overview.png",
    "report.html",
    "README.txt",
    "ended.txt",
    "config.json",
)
_STAGES = "stages"
_FOLDERS = ("test", "checkpoints", "tensorboard", "blocks", _STAGES)

_CONFIG_KINDS: dict[str, Any] = {
    "task": str,
    "config": dict,
    "iterations": int,
    "source": dict,
    "paths": dict,
    "paths.source": str | None,
    "paths.init_mesh": str | None,
    "paths.images": str | None,
    "paths.masks": str | None,
    "versions": dict,
    "versions.etsplat": str,
}
"""What config.json holds. Only the task is in every one: `Trainer.fit` records what its caller says."""


@dataclass(frozen=True)
class RunDirectory:
    """Paths and files of one run. Make it with `create` or `resume`; `RunDirectory(path)` is for reading.

    Attributes:
        path: the folder.
    """

    path: Path

    @property
    def config_path(self) -> Path:
        """config.json: the settings, how long the run is, the input's fingerprint, versions."""
        return self.path / "config.json"

    @property
    def metrics_path(self) -> Path:
        """metrics.json: final metrics; there once the run is done."""
        return self.path / "metrics.json"

    @property
    def evaluation_path(self) -> Path:
        """evaluation.json: what `etsplat eval` measured; there once it did."""
        return self.path / "evaluation.json"

    @property
    def history_path(self) -> Path:
        """history.jsonl: one JSON object per line."""
        return self.path / "history.jsonl"

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def test(self) -> Path:
        """Folder of the test views' pictures."""
        return self.path / "test"

    def mesh_path(self, suffix: str) -> Path:
        """mesh.ply, mesh.obj or mesh.glb."""
        return self.path / f"mesh{suffix}"

    @property
    def textured_path(self) -> Path:
        """textured.glb: a light mesh under a texture."""
        return self.path / "textured.glb"

    @property
    def soup_path(self) -> Path:
        """soup.safetensors."""
        return self.path / "soup.safetensors"

    @property
    def opaque_path(self) -> Path:
        """opaque.safetensors: the opaque mesh of a scene."""
        return self.path / "opaque.safetensors"

    def stage(self, name: str, iterations: int) -> "RunDirectory":
        """The folder for checkpoints and history of something that is made beside what the run optimizes.

        Raises:
            InputError: it cannot be written to.
        """
        folder = self.path / _STAGES / name
        if is_run(folder):
            return RunDirectory(folder)
        return RunDirectory.create(folder, {"task": "fit", "iterations": iterations})

    @staticmethod
    def check_free(path: Path | str, *, overwrite: bool = False) -> None:
        """Refuses a folder in which `create` would fail, without writing anything into it that stays.

        Cheap, so that a run can ask before it prepares its input.

        Args:
            path: need not exist; an existing folder must be empty, or with `overwrite` hold a run.
            overwrite: whether an earlier run may be replaced.

        Raises:
            InputError: `path` is a file, cannot be written to, holds something that is not a run, or holds a run and
                `overwrite` is off.
        """
        path = Path(path)
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: is a file; choose a folder for the results")
        if path.is_dir() and not is_empty(path):
            if not is_run(path):
                raise InputError(f"{path}: is not empty and not a run of etsplat; choose another or a new folder")
            if not overwrite:
                raise InputError(
                    f"{path}: holds a run already; continue it with {option('resume', True)}, replace it with "
                    f"{option('overwrite', True)}, or choose another folder"
                )
        _check_writable(path)

    @classmethod
    def create(cls, path: Path | str, config: Mapping[str, Any], *, overwrite: bool = False) -> "RunDirectory":
        """Makes `path` the folder of a new run: with config.json, README.txt and nothing else of a run.

        Args:
            path: as in `check_free`.
            config: what config.json holds, JSON-serialisable, with the key "task": "reconstruct", "train",
                "fit" or "peer".
            overwrite: whether an earlier run may be replaced. Only files that a run writes are removed.

        Raises:
            InputError: as in `check_free`; or the disk is full.
        """
        cls.check_free(path, overwrite=overwrite)
        run = cls(Path(path))
        with _explained(run.path):
            run.path.mkdir(parents=True, exist_ok=True)
            run._remove_results()
        # First, so that a folder in which no more than this had room says whose it is, and can be resumed.
        _write_json(run.config_path, {"format": FORMAT, **config})
        run._furnish(config["task"])
        return run

    @classmethod
    def resume(cls, path: Path | str, config: Mapping[str, Any]) -> "RunDirectory":
        """Opens the folder of a run that is to be continued.

        Args:
            path: of the folder.
            config: as given to `create`. What it holds under "config" and "source" must be the same as then.

        Raises:
            InputError: `path` holds no run, a run with other settings or input, or cannot be written to.
        """
        path = Path(path)
        if not is_run(path):
            raise InputError(f"{path}: holds no run to resume; start it without {option('resume')}")
        run = cls(path)
        stored = run.read_config()
        for section in ("task", "config", "source"):
            differences = json_differences(stored.get(section), as_json(config.get(section)))
            if differences:
                other = "other photos, cameras or meshes: " if section == "source" else ""
                raise InputError(
                    f"{path}: was started with {other}{'; '.join(differences)}; resume with the same, or choose "
                    "another folder"
                )
        _check_writable(path)
        run._remove_unfinished()
        run._furnish(stored["task"])
        return run

    def read_config(self, *needed: str) -> dict[str, Any]:
        """What config.json holds.

        Args:
            needed: dotted names of entries that it must have, beside "task". Whatever is there has the right type.

        Raises:
            InputError: it is missing, not JSON, or has not what it must.
        """
        found = _read_json(self.config_path)
        check_entries(self.config_path, found, _CONFIG_KINDS)
        for name in ("task", *needed):
            if entries_problem(found, {name: object}, [name]):
                raise InputError(
                    f"{self.config_path}: an earlier version of etsplat wrote it, it lacks `{name}`; "
                    "remove the folder and run again"
                )
        return found

    def read_iterations(self) -> int:
        """How many iterations the run will have had when it is done.

        Raises:
            InputError: config.json is missing, or does not say, as those of the first days did not.
        """
        return self.read_config("iterations")["iterations"]

    def read_metrics(self) -> dict[str, Any]:
        """What metrics.json holds.

        Raises:
            InputError: it is missing (the run is not done) or not JSON.
        """
        return _read_json(self.metrics_path)

    def write_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Writes metrics.json, whole or not at all. NaN and infinity, which JSON has not, become null."""
        _write_json(self.metrics_path, _null_if_not_finite(metrics))

    def read_evaluation(self) -> dict[str, Any]:
        """What evaluation.json holds; empty if nobody evaluated the run after it was done."""
        return _read_json(self.evaluation_path) if self.evaluation_path.is_file() else {}

    def write_evaluation(self, evaluation: Mapping[str, Any]) -> None:
        """Writes evaluation.json as `write_metrics` does."""
        _write_json(self.evaluation_path, _null_if_not_finite(evaluation))

    def write_end(self, text: str) -> None:
        """Says in ended.txt how the run ended before it was done. Where nothing can be written it stays unsaid."""
        with contextlib.suppress(InputError):
            _write_text(self.path / "ended.txt", f"{text}\n")

    def read_end(self) -> str:
        """How the run ended before it was done; empty where it did not, or nobody could say."""
        try:
            return (self.path / "ended.txt").read_text(encoding="utf-8").strip()
        except (OSError, ValueError):
            return ""

    def forget_end(self) -> None:
        """The run goes on."""
        with _explained(self.path):
            (self.path / "ended.txt").unlink(missing_ok=True)

    def conclude(self, verdict: str) -> None:
        """Puts what became of the run into README.txt, in the place of what that said of it before."""
        task = self.read_config()["task"]
        _write_text(self.path / "README.txt", f"{readme_of(task)}\nThe result is {verdict}.\n")

    def write_exposure(self, exposure: Mapping[str, Any]) -> None:
        """Writes exposure.json: what was learned of each training photo's exposure."""
        _write_json(self.path / "exposure.json", exposure)

    def read_exposure(self) -> dict[str, Any]:
        """What exposure.json holds; empty if the run learned none."""
        return _read_json(path) if (path := self.path / "exposure.json").is_file() else {}

    def append_history(self, line: Mapping[str, Any]) -> None:
        """Appends one line to history.jsonl."""
        with _explained(self.history_path), open(self.history_path, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def read_history(self) -> list[dict[str, Any]]:
        """The lines of history.jsonl; empty if there is none yet. A last line that a kill cut short is left out.

        Each has its "iteration", which increases from line to line; what else it says may be anything.

        Raises:
            InputError: the file is damaged.
        """
        try:
            text = self.history_path.read_text(encoding="utf-8")
            lines = [parse_json(line) for line in text.split("\n")[:-1]]  # what follows the last \n is cut short
        except FileNotFoundError:
            return []
        except ValueError as error:
            raise InputError(f"{self.history_path}: is damaged ({error}); delete the file") from error
        before = -1
        for number, line in enumerate(lines, 1):
            problem = entries_problem(line, {"iteration": int}, ["iteration"])
            if not problem and line["iteration"] <= before:
                problem = "its iteration is not after that of the line before"
            if problem:
                raise InputError(f"{self.history_path}: is damaged (line {number}: {problem}); delete the file")
            before = line["iteration"]
        return lines

    def truncate_history(self, iteration: int) -> None:
        """Keeps only the lines up to an iteration: what came after the checkpoint will be done again."""
        kept = [line for line in self.read_history() if line["iteration"] <= iteration]
        _write_text(self.history_path, "".join(json.dumps(line) + "\n" for line in kept))

    def _furnish(self, task: str) -> None:
        """What a run's folder has from the start beside its config.json, where it is not there yet."""
        with _explained(self.path):
            self.checkpoints.mkdir(exist_ok=True)
            self.test.mkdir(exist_ok=True)
        readme = self.path / "README.txt"
        if not readme.is_file():
            _write_text(readme, readme_of(task))

    def _remove_unfinished(self) -> None:
        # A process that was killed while it wrote a file leaves its beginning under a name that nobody would look for.
        inside = (path for name in _FOLDERS for path in (self.path / name).rglob("*"))
        for path in [*filter(_is_unfinished, self.path.iterdir()), *filter(destination_of, inside)]:
            path.unlink()

    def _remove_results(self) -> None:
        self._remove_unfinished()
        # config.json goes last: until then the folder still says whose it is.
        for name in _FILES:
            (self.path / name).unlink(missing_ok=True)
        for name in _FOLDERS:
            if (self.path / name).is_dir():
                shutil.rmtree(self.path / name)


def is_empty(folder: Path) -> bool:
    """Whether a folder holds nothing but what a run leaves that was killed before it began."""
    return all(path.name == RUN_LOCK or _is_unfinished(path) for path in folder.iterdir())


def _is_unfinished(path: Path) -> bool:
    destination = destination_of(path)
    return destination is not None and destination.name in _FILES


def is_run(path: Path | str) -> bool:
    """Whether a folder holds a run of etsplat, finished or not."""
    try:
        return parse_json((Path(path) / "config.json").read_text(encoding="utf-8")).get("format") == FORMAT
    except (OSError, ValueError, AttributeError):
        return False


def _check_writable(path: Path) -> None:
    folder = path
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        raise InputError(f"{path}: {folder} is a file; choose a folder for the results")
    probe = folder / f".etsplat-{secrets.token_hex(4)}"
    with _explained(path):
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        probe.unlink()


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise write_error(path, error) from error


def _write_text(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    _write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); is the run done?") from error
    except ValueError as error:
        raise InputError(f"{path}: is not JSON ({error}); delete it and run again") from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: holds no JSON object; delete it and run again")
    return found


def _null_if_not_finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _null_if_not_finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_null_if_not_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
