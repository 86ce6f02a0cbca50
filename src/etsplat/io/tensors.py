"""Named tensors on disk, as safetensors files."""

import json
import os
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from etsplat.io.atomic import atomic_write


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """Write tensors of any device under their names. Atomic. Equal tensors and metadata are equal bytes.

    Args:
        path: ends in .safetensors.
        tensors: by name.
        metadata: text by name.

    Raises:
        InputError: the file cannot be written.
    """
    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic_write(path) as temporary:
        temporary.touch()
        mode = temporary.stat().st_mode
        try:
            save_file(whole, temporary, metadata=metadata)
        except SafetensorError as error:  # how safetensors reports what the system said, a full disk among it
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise OSError(str(error).splitlines()[0]) from error
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from error
        _sort_metadata(temporary)
        temporary.chmod(mode)  # safetensors makes files that only their owner may read


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """What `save_tensors` wrote, on the CPU: tensors, and metadata.

    Raises:
        SafetensorError, OSError, ValueError: the file is cut short, damaged or cannot be read.
    """
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118 (no mapping)


def _sort_metadata(path: Path) -> None:
    """By name, in place: safetensors writes it in another order in every call."""
    with open(path, "rb+") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        if "__metadata__" in header:
            header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode().ljust(size)
        if len(text) != size:  # the offsets of the tensors count from its end
            raise ValueError(f"{path}: safetensors writes its header in another way than JSON of {size} bytes")
        file.seek(8)
        file.write(text)


def read_state_dict(path: Path) -> Any:
    """What `torch.save` wrote, a dict of tensors if it is what it is taken for, on the CPU. No code in it is run.

    Raises:
        ValueError: it claims to hold more than the file does.
        Exception: whatever torch's unpickler raises, depending on the bytes.
    """
    room = path.stat().st_size
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            if sum(record.file_size for record in archive.infolist()) > room:
                raise ValueError("its records are larger than the file")
    entries = torch.load(path, map_location="cpu", weights_only=True)
    for name, tensor in entries.items() if isinstance(entries, dict) else ():
        if isinstance(tensor, Tensor) and (tensor.is_meta or tensor.numel() * tensor.element_size() > room):
            raise ValueError(f"{name} is larger than the file")
    return entries
