"""Every kernel compiles for the supported architectures, without a GPU; the cache of compiled kernels is safe."""

import hashlib
import os
import stat
from multiprocessing import get_context
from types import SimpleNamespace

import pytest

from benchmarks.gpu_programs import PROGRAMS, VARIANTS
from etsplat.core.errors import EngineUnavailableError, InputError
from etsplat.engines.cuda import compile as compile_module
from etsplat.engines.cuda import device
from etsplat.engines.cuda.compile import cache_folder, compile_program, compile_without_cache
from etsplat.engines.cuda.program import Program, source_root

OLDEST, NEWEST = "sm_75", "sm_120"
BETWEEN = ("sm_80", "sm_86", "sm_89", "sm_90", "sm_100")


ELF = b"\x7fELF"


@pytest.mark.parametrize("architecture", [OLDEST, NEWEST])
@pytest.mark.parametrize("program", [*PROGRAMS, *VARIANTS], ids=str)
def test_compiles(program, architecture):
    assert compile_without_cache(program, architecture).startswith(ELF)


@pytest.mark.parametrize("architecture", BETWEEN)
def test_compiles_for_architectures_between(architecture):
    """One program stands for all: no source asks for the architecture."""
    assert compile_without_cache(PROGRAMS[3], architecture).startswith(ELF)


@pytest.mark.parametrize("program", [*PROGRAMS, *VARIANTS], ids=str)
def test_nothing_is_kept_in_local_memory(program):
    """An array that is indexed by what the compiler does not know lies there: slower than registers by far."""
    ptx = compile_without_cache(program, "compute_75").decode()
    assert ".entry" in ptx
    assert not [line for line in ptx.splitlines() if line.strip().startswith(".local")]


def test_no_source_asks_for_the_architecture():
    """If one did, every architecture would have to be compiled for."""
    assert not [path for path in source_root().rglob("*.*") if "__CUDA_ARCH__" in path.read_text(encoding="utf-8")]


def test_every_file_is_checked():
    """A new .cu file belongs into the list above."""
    assert {program.file for program in PROGRAMS} == {path.name for path in (source_root() / "cuda").glob("*.cu")}


def test_errors_name_file_and_line():
    broken = Program("fill.cu", (("count", "missing +"),))
    with pytest.raises(RuntimeError, match=r"cuda/fill\.cu\(4\): error"):
        compile_without_cache(broken, "sm_90")


def test_cache_keeps_and_recognises(tmp_path, monkeypatch, capfd):
    """Compiled once per source and architecture; a damaged file is compiled anew; a folder that cannot be written to
    costs the cache only."""
    monkeypatch.setenv("ETSPLAT_CACHE_DIR", str(tmp_path / "kernels"))
    first = compile_program(Program("fill.cu"), "sm_90")
    assert compile_program(Program("fill.cu"), "sm_90") == first
    assert capfd.readouterr().err.count("compiled fill.cu for sm_90") == 1
    compile_program(Program("fill.cu"), "sm_80")
    compile_program(Program("fill.cu", (("UNUSED", 1),)), "sm_90")
    files = list(cache_folder().iterdir())
    assert len(files) == 3
    for file in files:
        file.write_bytes(file.read_bytes()[:-1])
    assert compile_program(Program("fill.cu"), "sm_90") == first
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ETSPLAT_CACHE_DIR", str(tmp_path / "file"))
    assert compile_program(Program("fill.cu"), "sm_90") == first
    assert "set ETSPLAT_CACHE_DIR" in capfd.readouterr().err


def test_kernels_that_others_may_have_written_are_not_run(tmp_path, monkeypatch, capfd):
    """A folder that others can write to is refused; so is one of somebody else. Of a folder that is one's own, a file
    that others can write to is compiled anew."""
    folder = tmp_path / "kernels"
    monkeypatch.setenv("ETSPLAT_CACHE_DIR", str(folder))
    before = os.umask(0o002)
    try:
        first = compile_program(Program("fill.cu"), "sm_90")
    finally:
        os.umask(before)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    (file,) = folder.iterdir()
    planted = b"planted"
    file.write_bytes(hashlib.sha256(planted).digest() + planted)
    assert compile_program(Program("fill.cu"), "sm_90") == planted  # what the next lines keep out
    file.chmod(0o666)
    assert compile_program(Program("fill.cu"), "sm_90") == first
    for mode in (0o777, 0o770):
        folder.chmod(mode)
        with pytest.raises(InputError, match="others can write to this folder"):
            compile_program(Program("fill.cu"), "sm_90")
    mine = os.geteuid()
    owned = [compile_module._is_trusted(SimpleNamespace(st_uid=uid, st_mode=0o40755)) for uid in (mine, 0, mine + 1)]
    assert owned == [True, True, False]


def _compile_into(folder):
    os.environ["ETSPLAT_CACHE_DIR"] = folder
    return compile_program(Program("fill.cu"), "sm_90")


def test_processes_share_the_cache(tmp_path):
    """Several at once get the same kernels, and leave one file and no parts."""
    with get_context("fork").Pool(3) as pool:
        results = pool.map(_compile_into, [str(tmp_path)] * 6)
    assert len(set(results)) == 1
    assert len(list(tmp_path.iterdir())) == 1


class TestErrors:
    """Each missing piece has its line."""

    def test_torch_without_cuda(self, monkeypatch):
        monkeypatch.setattr(device.torch, "__version__", "2.13.0+cpu")
        monkeypatch.setattr(device.torch.version, "cuda", None)
        with pytest.raises(EngineUnavailableError, match="built without CUDA"):
            device.check_torch()

    def test_old_torch(self, monkeypatch):
        monkeypatch.setattr(device.torch, "__version__", "2.9.1+cu128")
        with pytest.raises(EngineUnavailableError, match=r"needs torch 2\.11 or newer, found 2\.9\.1\+cu128"):
            device.check_torch()

    def test_no_gpu(self, monkeypatch):
        monkeypatch.setattr(device.torch, "__version__", "2.11.0+cu130")
        monkeypatch.setattr(device.torch.version, "cuda", "13.0")
        monkeypatch.setattr(device.torch.cuda, "is_available", lambda: False)
        with pytest.raises(EngineUnavailableError, match="finds no usable GPU"):
            device.check_torch()

    def test_old_driver(self):
        class Driver:
            class CUresult:
                CUDA_SUCCESS = 0

            @staticmethod
            def cuDriverGetVersion():  # noqa: N802
                return 0, 12040

        with pytest.raises(EngineUnavailableError, match=r"supports CUDA 12\.4 .* NVRTC 13"):
            device.check_driver(Driver)
