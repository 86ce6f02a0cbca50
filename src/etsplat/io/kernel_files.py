"""The table of a kernel that was registered from Python, beside what was made with it. Code is never in a file."""

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.kernel_table import KernelTable
from etsplat.core.kernels import KERNELS
from etsplat.core.registered_kernels import adopt_table
from etsplat.io.run_directory import KERNEL_FILE
from etsplat.io.tensors import read_tensors, save_tensors


def table_of(kernel: str | None) -> KernelTable | None:
    """Of a kernel that was registered from Python; None for all other names."""
    return KERNELS[kernel].table if kernel in KERNELS else None


def kernel_tensors(kernel: str | None) -> dict[str, Tensor]:
    """What a file has to hold besides, so that it can be drawn anywhere; nothing for a built-in kernel."""
    table = table_of(kernel)
    return {} if table is None else table.to_tensors()


def adopt_kernel(path: Path, kernel: str | None, tensors: Mapping[str, Tensor]) -> None:
    """Register the kernel that a file was made with, if it is none of the built-in ones.

    Args:
        path: of the file, for errors.
        kernel: its name.
        tensors: of the file, with those of `kernel_tensors`.

    Raises:
        InputError: the file lacks the table, or another kernel has this name in this process.
    """
    if kernel is None or (kernel in KERNELS and KERNELS[kernel].table is None):
        return
    try:
        adopt_table(kernel, KernelTable.from_tensors(tensors))
    except ValueError as error:
        raise InputError(f"{path}: its kernel {kernel!r} cannot be used ({error})") from error


def write_kernel(folder: Path, kernel: str | None) -> None:
    """Write KERNEL_FILE into a run's folder, for a kernel that is none of the built-in ones.

    Raises:
        InputError: it cannot be written.
    """
    if kernel and (tensors := kernel_tensors(kernel)):
        save_tensors(folder / KERNEL_FILE, tensors, {"name": kernel})


def adopt_kernel_of(folder: Path) -> None:
    """Register the kernel of a run, if its folder has KERNEL_FILE, so that its settings can be read.

    Raises:
        InputError: the file is damaged, or another kernel has this name in this process.
    """
    path = folder / KERNEL_FILE
    if not path.is_file():
        return
    try:
        tensors, metadata = read_tensors(path)
        name = metadata["name"]
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: is damaged ({error}); remove it and register the kernel") from error
    adopt_kernel(path, name, tensors)


def kernel_digest(kernel: str | None) -> dict[str, str]:
    """For the record of a run: what identifies its kernel, where it is none of the built-in ones."""
    table = table_of(kernel)
    return {} if table is None else {"kernel": table.digest}
