import errno
import os
import stat

import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from etsplat.core.errors import InputError
from etsplat.io import tensors as tensors_module
from etsplat.io.tensors import save_tensors


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
