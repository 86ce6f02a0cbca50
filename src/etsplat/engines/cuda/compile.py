"""Programs to machine code by NVRTC, which needs neither a GPU nor a driver, and a cache of the results on disk."""

import hashlib
import importlib
import os
import stat
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from etsplat.core.errors import EngineUnavailableError, InputError
from etsplat.engines.cuda.program import Program

INSTALL = "pip install 'etsplat[cuda]'"
OLDER_INSTALL = "pip install 'etsplat[cuda12]'"
OPTIONS = ("--std=c++17",)
_DIGEST_SIZE = 32


def compile_program(program: Program, architecture: str) -> bytes:
    """Machine code of ``program`` for an architecture such as "sm_90", from the cache if it is there.

    For a virtual architecture such as "compute_90" it is PTX that ends with a 0, as drivers want it.

    Raises:
        EngineUnavailableError: NVRTC is not installed.
        InputError: Others can write to the folder of the cache.
        RuntimeError: The source does not compile; the message is the compiler's.
    """
    virtual = architecture.startswith("compute_")
    path = cache_folder() / f"{program_key(program, architecture)}.{'ptx' if virtual else 'cubin'}"
    code = _load(path)
    if code is None:
        start = time.perf_counter()
        code = compile_without_cache(program, architecture) + (b"\0" if virtual else b"")
        print(f"compiled {program} for {architecture} in {time.perf_counter() - start:.1f} s", file=sys.stderr)
        _store(path, code)
    return code


def target_architecture(major: int, minor: int) -> str:
    """What to compile for a GPU of this compute capability: its own architecture, such as "sm_90".

    For a GPU newer than NVRTC it is the newest virtual one, such as "compute_120": the driver compiles the rest.

    Raises:
        EngineUnavailableError: NVRTC is missing, or the GPU is older than all that it knows.
    """
    nvrtc = import_nvrtc()
    known = [number for number in _checked(nvrtc, nvrtc.nvrtcGetSupportedArchs()) if number <= 10 * major + minor]
    if not known:
        raise EngineUnavailableError(
            f"NVRTC {'.'.join(map(str, nvrtc_version(nvrtc)))} compiles for no GPU as old as this one (compute "
            f"capability {major}.{minor}): compute on the CPU"
        )
    return f"{'sm' if max(known) == 10 * major + minor else 'compute'}_{max(known)}"


def compile_without_cache(program: Program, architecture: str) -> bytes:
    """As ``compile_program``, without looking at the cache or writing to it.

    For a virtual architecture such as "compute_75" it is the PTX, as text.
    """
    nvrtc = import_nvrtc()
    handle = _checked(nvrtc, nvrtc.nvrtcCreateProgram(program.source.encode(), program.file.encode(), 0, [], []))
    try:
        options = [option.encode() for option in _options(program, architecture)]
        (status,) = nvrtc.nvrtcCompileProgram(handle, len(options), options)
        if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
            log = b" " * _checked(nvrtc, nvrtc.nvrtcGetProgramLogSize(handle))
            nvrtc.nvrtcGetProgramLog(handle, log)
            raise RuntimeError(
                f"{program} for {architecture}: {status.name}\n{log.decode(errors='replace').rstrip(chr(0))}"
            )
        if architecture.startswith("compute_"):
            ptx = b" " * _checked(nvrtc, nvrtc.nvrtcGetPTXSize(handle))
            _checked(nvrtc, nvrtc.nvrtcGetPTX(handle, ptx))
            return ptx.rstrip(b"\0")
        cubin = b" " * _checked(nvrtc, nvrtc.nvrtcGetCUBINSize(handle))
        _checked(nvrtc, nvrtc.nvrtcGetCUBIN(handle, cubin))
        return cubin
    finally:
        nvrtc.nvrtcDestroyProgram(handle)


def import_nvrtc() -> Any:
    """The module ``cuda.bindings.nvrtc`` with its library found.

    Raises:
        EngineUnavailableError: The package or the library is missing.
    """
    try:
        nvrtc = importlib.import_module("cuda.bindings.nvrtc")
        nvrtc.nvrtcVersion()
    except Exception as error:  # what is raised for a missing library differs between versions
        raise EngineUnavailableError(
            f"the GPU engine compiles its kernels with NVRTC, which is missing ({type(error).__name__}): {INSTALL}"
        ) from error
    return nvrtc


def nvrtc_version(nvrtc: Any) -> tuple[int, int]:
    """(major, minor) of the NVRTC library."""
    _, major, minor = nvrtc.nvrtcVersion()
    return major, minor


def cache_folder() -> Path:
    """Where compiled kernels are kept: ETSPLAT_CACHE_DIR, or the user's cache folder. It need not exist.

    Raises:
        InputError: others can write to it, or it is another user's: what lies there would be run.
    """
    folder = _chosen_folder()
    try:
        trusted = _is_trusted(folder.stat())
    except OSError:
        return folder
    if not trusted:
        raise InputError(
            f"{folder}: others can write to this folder, or it is another user's, and compiled kernels from there would"
            f" be run; remove it, or set ETSPLAT_CACHE_DIR to a folder that is yours alone"
        )
    return folder


def _chosen_folder() -> Path:
    chosen = os.environ.get("ETSPLAT_CACHE_DIR")
    if chosen:
        return Path(chosen)
    if os.name == "nt":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "etsplat" / "kernels"


def _is_trusted(found: os.stat_result) -> bool:
    """Whether nobody but this user and the superuser could have written a file, or a folder's files."""
    if os.name == "nt":  # where a profile's folders are its user's
        return True
    return found.st_uid in (os.geteuid(), 0) and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _options(program: Program, architecture: str) -> tuple[str, ...]:
    # Where contraction is on, what forward and backward must compute alike is written with vfma (csrc/math/portable.h).
    contraction, flush = ("true" if wanted else "false" for wanted in (program.contract, program.flush))
    return (*OPTIONS, f"--fmad={contraction}", f"--ftz={flush}", f"--gpu-architecture={architecture}")


def program_key(program: Program, architecture: str) -> str:
    """A name for what is compiled: that of the source, the options and the version of NVRTC.

    Raises:
        EngineUnavailableError: NVRTC is not installed.
    """
    parts = (program.source, *_options(program, architecture), str(nvrtc_version(import_nvrtc())))
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _load(path: Path) -> bytes | None:
    """The content of a cache file, or None if it is not there, not what was stored, or maybe somebody else's."""
    try:
        with open(path, "rb") as file:
            if not _is_trusted(os.fstat(file.fileno())):
                return None
            content = file.read()
    except OSError:
        return None
    digest, cubin = content[:_DIGEST_SIZE], content[_DIGEST_SIZE:]
    return cubin if hashlib.sha256(cubin).digest() == digest else None


def _store(path: Path, cubin: bytes) -> None:
    """Write beside and rename: processes that compile the same thing at once replace each other's equal files."""
    try:
        path.parent.parent.mkdir(parents=True, exist_ok=True)
        path.parent.mkdir(mode=0o700, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as part:
            part.write(hashlib.sha256(cubin).digest() + cubin)
        try:
            os.replace(part.name, path)
        except OSError:
            os.unlink(part.name)
            raise
    except OSError as error:
        print(f"compiled kernels cannot be kept in {path.parent} ({error}): set ETSPLAT_CACHE_DIR", file=sys.stderr)


def _checked(nvrtc: Any, result: tuple[Any, ...]) -> Any:
    status, *values = result
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        raise RuntimeError(f"NVRTC: {status.name}")
    return values[0] if values else None
