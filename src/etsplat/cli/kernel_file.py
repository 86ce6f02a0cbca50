"""``--kernel-file``: the only file that the command line runs, and only where somebody names it."""

import runpy
from pathlib import Path
from typing import get_args

from etsplat.core.errors import InputError
from etsplat.tasks.settings import SoftMethod, kernel_methods


def run_kernel_file(path: Path) -> None:
    """Runs a Python file that registers kernels.

    Raises:
        InputError: there is no such file, it fails, or it registers nothing.
    """
    if not path.is_file():
        raise InputError(f"--kernel-file {path}: no such file; check the path")
    try:
        runpy.run_path(str(path))
    except Exception as error:
        raise InputError(f"--kernel-file {path}: failed ({type(error).__name__}: {error})") from error
    if kernel_methods() == get_args(SoftMethod):
        raise InputError(f"--kernel-file {path}: registers no kernel; call etsplat.register_kernel(name, value) in it")
