"""Targets with a defect each: a session that does not find all of them proves nothing."""

import os
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from etsplat.io.mesh_files import load_mesh
from tests.fuzz import corpus
from tests.fuzz.readers import Reader

INPUTS = 32
HANG = 0.5
"""Seconds that the one that hangs may take."""


def _raise() -> None:
    raise KeyError("planted")


def _allocate() -> None:
    np.ones(400 << 17)  # 400 MiB, all of it written


def _wait() -> None:
    time.sleep(60)


DEFECTS: dict[str, Callable[[], None]] = {"exception": _raise, "memory": _allocate, "hang": _wait, "crash": os.abort}


@dataclass
class Planted(Reader):
    """The reader of OBJ files, with a defect of a kind at one input in four."""

    @staticmethod
    def defective(files: corpus.Files) -> bool:
        """Whether an input shows the defect."""
        return zlib.crc32(files["input.obj"]) % 4 == 0


def planted(kind: str) -> Planted:
    """A target with a defect of this kind."""

    def read(folder: Path) -> None:
        path = folder / "input.obj"
        if Planted.defective({path.name: path.read_bytes()}):
            DEFECTS[kind]()
        load_mesh(path)

    return Planted(f"planted {kind}", lambda: [{"input.obj": data} for data in corpus.objs()], (".obj",), read)
