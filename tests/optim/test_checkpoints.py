"""Checkpoints: exact, atomic, few, and bound to their run."""

import errno
import os
from pathlib import Path

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.io.tensors import read_tensors, save_tensors
from etsplat.optim import checkpoints
from etsplat.optim.checkpoints import list_checkpoints, load_latest_checkpoint, save_checkpoint


def some_tensors(rng: torch.Generator) -> dict[str, torch.Tensor]:
    return {
        "mesh.vertices": torch.randn(10, 3, generator=rng),
        "faces": torch.randint(0, 10, (16, 3), generator=rng),
        "sampler.generator": rng.get_state(),
        "progress": torch.tensor([0.1, 1 / 3, 1e-300], dtype=torch.float64),
        "log_sigma": torch.tensor(-0.7),
        "empty": torch.empty(0, dtype=torch.int64),
    }


def test_a_checkpoint_returns_every_bit(tmp_path: Path, rng: torch.Generator) -> None:
    """Types, shapes and bits of all tensors come back, scalars and empty ones included."""
    tensors = some_tensors(rng)
    save_checkpoint(tmp_path, 120, tensors, "run")
    loaded = load_latest_checkpoint(tmp_path, "run")
    assert loaded is not None
    assert loaded.iteration == 120
    assert loaded.tensors.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert loaded.tensors[name].dtype == tensor.dtype
        assert torch.equal(loaded.tensors[name], tensor)


def test_only_the_last_two_checkpoints_are_kept(tmp_path: Path, rng: torch.Generator) -> None:
    """Older files go; the newest by iteration is loaded, also past a million, where names grow longer."""
    for iteration in (999_998, 999_999, 1_000_000):
        save_checkpoint(tmp_path, iteration, some_tensors(rng), "run")
    assert [path.name for path in list_checkpoints(tmp_path)] == ["step_999999.safetensors", "step_1000000.safetensors"]
    loaded = load_latest_checkpoint(tmp_path, "run")
    assert loaded is not None
    assert loaded.iteration == 1_000_000


def test_a_folder_without_checkpoints_has_none(tmp_path: Path) -> None:
    """A run that was killed before its first checkpoint has nothing to load, which is no error."""
    assert load_latest_checkpoint(tmp_path / "absent", "run") is None


@pytest.mark.parametrize("length", [0, 7, 500, -1])
def test_a_checkpoint_cut_short_says_what_to_do(tmp_path: Path, rng: torch.Generator, length: int) -> None:
    """Wherever the file ends, the error names it and the checkpoint before it, which is not used by itself."""
    save_checkpoint(tmp_path, 10, some_tensors(rng), "run")
    path = save_checkpoint(tmp_path, 20, some_tensors(rng), "run")
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(InputError) as error:
        load_latest_checkpoint(tmp_path, "run")
    message = str(error.value)
    assert "\n" not in message
    assert "step_000020" in message
    assert "delete it to resume from step_000010" in message


@pytest.mark.parametrize("told", [{}, {"iteration": "pe"}, {"iteration": "-1"}, {"iteration": "9" * 5000}])
def test_a_checkpoint_that_does_not_say_of_which_iteration_it_is_is_refused(
    tmp_path: Path, rng: torch.Generator, told: dict[str, str]
) -> None:
    """By name, with what to do."""
    path = save_checkpoint(tmp_path, 20, some_tensors(rng), "run")
    tensors, metadata = read_tensors(path)
    del metadata["iteration"]
    save_tensors(path, tensors, metadata | told)
    with pytest.raises(InputError, match="does not say which iteration it is of; delete it"):
        load_latest_checkpoint(tmp_path, "run")


def test_a_checkpoint_of_another_run_is_refused(tmp_path: Path, rng: torch.Generator) -> None:
    """A checkpoint made with other settings or input is an error of one line."""
    save_checkpoint(tmp_path, 10, some_tensors(rng), "that run")
    with pytest.raises(InputError, match="other settings or input"):
        load_latest_checkpoint(tmp_path, "this run")


def test_a_full_disk_leaves_the_earlier_checkpoint(
    tmp_path: Path, rng: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When writing fails, the error says why and nothing but the earlier checkpoints is in the folder."""
    save_checkpoint(tmp_path, 10, some_tensors(rng), "run")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left"):
        save_checkpoint(tmp_path, 20, some_tensors(rng), "run")
    assert [path.name for path in tmp_path.iterdir()] == ["step_000010.safetensors"]


def test_a_folder_that_goes_while_a_checkpoint_is_written_is_named_by_the_next(
    tmp_path: Path, rng: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody promises that what was written is still there when the older ones are deleted."""
    folder = tmp_path / "checkpoints"
    folder.mkdir()

    def save_and_remove(*arguments: object) -> None:
        save_tensors(*arguments)  # type: ignore[arg-type]
        folder.rename(tmp_path / "gone")

    with monkeypatch.context() as patched:
        patched.setattr(checkpoints, "save_tensors", save_and_remove)
        save_checkpoint(folder, 10, some_tensors(rng), "run")
    with pytest.raises(InputError, match="cannot write"):
        save_checkpoint(folder, 20, some_tensors(rng), "run")
