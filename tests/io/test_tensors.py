import errno
import os
import stat

import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from etsplat.core.errors import InputError
from etsplat.io import tensors as tensors_module
from etsplat.io.tensors import read_tensors, save_tensors


def test_others_may_read_the_file_as_the_umask_says(tmp_path):
    before = os.umask(0o022)
    try:
        save_tensors(tmp_path / "a.safetensors", {"x": torch.arange(6).reshape(2, 3).T})
    finally:
        os.umask(before)
    assert torch.equal(load_file(tmp_path / "a.safetensors")["x"], torch.tensor([[0, 3], [1, 4], [2, 5]]))
    assert stat.S_IMODE((tmp_path / "a.safetensors").stat().st_mode) == 0o644


def test_a_full_disk_is_told_as_such_and_leaves_the_earlier_file(tmp_path, monkeypatch):
    save_tensors(tmp_path / "a.safetensors", {"x": torch.ones(2)})

    def full(*args, **kwargs):
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(tensors_module, "save_file", full)
    with pytest.raises(InputError, match=f"{os.strerror(errno.ENOSPC)}; free some space"):
        save_tensors(tmp_path / "a.safetensors", {"x": torch.zeros(2)})
    assert float(load_file(tmp_path / "a.safetensors")["x"].sum()) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a.safetensors"]


def test_what_is_saved_again_has_the_same_bytes(tmp_path):
    """Names and texts that JSON writes with escapes, and tensors of several widths, in any order."""
    notes = {f'name {index} "{chr(index)}" é': f"\\ {chr(index)} \x7f 三" for index in range(40)}
    tensors = {"b": torch.ones(3), "a": torch.ones(5, dtype=torch.uint8), "c": torch.arange(3), "d": torch.ones(0, 3)}
    for index in range(4):
        notes, tensors = dict(reversed(notes.items())), dict(reversed(tensors.items()))
        save_tensors(tmp_path / f"{index}.safetensors", tensors, notes)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    found, told = read_tensors(tmp_path / "0.safetensors")
    assert told == notes
    assert all(torch.equal(found[name], tensors[name]) for name in tensors)
    save_tensors(tmp_path / "plain.safetensors", tensors)
    assert read_tensors(tmp_path / "plain.safetensors")[1] == {}
