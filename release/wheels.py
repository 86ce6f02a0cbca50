"""The wheels of every platform, on one Linux machine: compiled by Zig (`ziglang` from PyPI), then looked into.

    make wheels                                    all platforms, into dist/wheels
    make wheels WHEELS='windows-x64 macos-arm64'   some

Each is one file for all Pythons from 3.12 on (abi3), under 3 MB, that calls the stable ABI alone and asks for the
system's own libraries alone. It holds nanobind: the package nanobind-backend throws what its users catch, and is
compiled by others (GCC, MSVC), so that wheels with it are made by .github/workflows/wheels.yml. Whether a wheel runs
is known on its platform.
"""

import argparse
import importlib
import io
import os
import re
import shutil
import struct
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
MAX_BYTES = 3_000_000
PYTHON = "cp312"
"""The oldest that nanobind within a module takes the stable ABI of."""


@dataclass(frozen=True)
class Platform:
    """What a wheel is made for.

    Attributes:
        target: as Zig names it, with the oldest version of the system or of its C library
        system: as CMake names it
        processor: as CMake names it
        tag: of the wheel, as Python's `sysconfig` spells it; `auditwheel` makes manylinux of Linux
        libraries: what the native module may ask for, a regular expression of each file's name
    """

    target: str
    system: str
    processor: str
    tag: str
    libraries: str


_GLIBC = r"(libc|libdl|libm|libpthread|librt|ld-linux-[a-z0-9-]+)\.so\.\d"
PLATFORMS: Mapping[str, Platform] = {
    "linux-x64": Platform("x86_64-linux-gnu.2.28", "Linux", "x86_64", "linux-x86_64", _GLIBC),
    "linux-arm64": Platform("aarch64-linux-gnu.2.28", "Linux", "aarch64", "linux-aarch64", _GLIBC),
    "macos-arm64": Platform(
        "aarch64-macos.11.0", "Darwin", "arm64", "macosx-11.0-arm64", r"/usr/lib/libSystem\.B\.dylib"
    ),
    "windows-x64": Platform(
        "x86_64-windows-gnu",
        "Windows",
        "AMD64",
        "win-amd64",
        r"(kernel32|ntdll|python3|api-ms-win-crt-[a-z]+-l1-1-0)\.dll",
    ),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Builds the wheels that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("platforms", nargs="*", metavar="PLATFORM", help=", ".join(PLATFORMS))
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "wheels", help="build folders, kept")
    parser.add_argument("--out", type=Path, default=ROOT / "dist" / "wheels")
    options = parser.parse_args(arguments)
    unknown = set(options.platforms) - set(PLATFORMS)
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))}: no platform of {', '.join(PLATFORMS)}")
    for name in options.platforms or PLATFORMS:
        wheel = build(PLATFORMS[name], options.work.resolve() / name, options.out.resolve())
        check(wheel, PLATFORMS[name])
        print(f"{wheel.name}: {wheel.stat().st_size:,} bytes")


def build(platform: Platform, work: Path, out: Path) -> Path:
    """A wheel of the checkout, under its final name in `out`."""
    made = work / "made"
    shutil.rmtree(made, ignore_errors=True)
    out.mkdir(parents=True, exist_ok=True)
    defines: dict[str, Path | str] = {
        "CMAKE_TOOLCHAIN_FILE": ROOT / "release" / "zig.cmake",
        "ETSPLAT_SYSTEM": platform.system,
        "ETSPLAT_PROCESSOR": platform.processor,
        "ETSPLAT_TOOLS": compilers(platform, work / "tools"),
        "ETSPLAT_NANOBIND_BACKEND": "OFF",
        "Python_INCLUDE_DIR": headers(work / "include"),
    }
    if platform.system == "Windows":
        defines["Python_SABI_LIBRARY"] = import_library(work)
        defines["SKBUILD_SOSABI"] = ""  # no .abi3 before .pyd
        # CMake wants that of one Python too, whose version it reads from the name; nothing is linked with it.
        defines["Python_LIBRARY"] = work / f"python{sys.version_info.major}{sys.version_info.minor}.lib"
        shutil.copy2(defines["Python_SABI_LIBRARY"], defines["Python_LIBRARY"])
    settings = [f"--config-settings=cmake.define.{name}={value}" for name, value in defines.items()]
    settings += [f"--config-settings=build-dir={work / 'cmake'}", f"--config-settings=wheel.py-api={PYTHON}"]
    pip = [
        sys.executable,
        "-m",
        "pip",
        "--disable-pip-version-check",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
    ]
    environment = {**os.environ, "_PYTHON_HOST_PLATFORM": platform.tag}
    subprocess.run([*pip, *settings, "--wheel-dir", str(made), str(ROOT)], check=True, env=environment)
    (wheel,) = made.glob("*.whl")
    if platform.system != "Linux":
        return Path(shutil.copy2(wheel, out / wheel.name))
    # `auto` is the oldest C library that the symbols allow; other processors' tags auditwheel does not take by name.
    audit = [sys.executable, "-m", "auditwheel", "repair", "--plat", "auto", "--only-plat"]
    subprocess.run([*audit, "--wheel-dir", str(made), str(wheel)], check=True)
    (repaired,) = made.glob("*-manylinux_*.whl")
    return Path(shutil.copy2(repaired, out / repaired.name))


def compilers(platform: Platform, folder: Path) -> Path:
    """A folder with programs of the names that CMake asks for, which call Zig for this platform."""
    folder.mkdir(parents=True, exist_ok=True)
    # A bundle and nanobind's list of Python's symbols (@FILE) are for Apple's linker; to Python a library does as well.
    # What the Python of this machine is linked with (-ldl) is part of the C library elsewhere.
    cases = "-bundle) word=-dynamiclib;; -ldl) continue;; -Wl,@*.sym) word='-Wl,-undefined,dynamic_lookup';;"
    translate = f'for word; do shift; case $word in {cases} esac; set -- "$@" "$word"; done'
    zig = zig_program()
    scripts = {"c++": f"{translate}\nexec '{zig}' c++ -target {platform.target} -O2 \"$@\""}
    scripts |= {tool: f"exec '{zig}' {tool} \"$@\"" for tool in ("ar", "ranlib", "rc")}
    for name, script in scripts.items():
        path, text = folder / name, f"#!/bin/sh\n{script}\n"
        if not path.is_file() or path.read_text() != text:  # a newer compiler would have all compiled again
            path.write_text(text)
        path.chmod(0o755)
    return folder


def zig_program() -> Path:
    """Zig, as `ziglang` brings it."""
    return Path(str(importlib.import_module("ziglang").__file__)).parent / "zig"


def headers(folder: Path) -> Path:
    """Those of the Python that runs this, but for what tells of its machine."""
    shutil.copytree(sysconfig.get_paths()["include"], folder, dirs_exist_ok=True)
    shutil.copy2(ROOT / "release" / "pyconfig.h", folder)
    return folder


def import_library(work: Path) -> Path:
    """python3.lib, by which a program for Windows finds the stable ABI; from the list of its symbols."""
    stable: Any = importlib.import_module("abi3info")
    names = [*(symbol.name for symbol in stable.FUNCTIONS), *(f"{symbol.name} DATA" for symbol in stable.DATAS)]
    definition, library = work / "python3.def", work / "python3.lib"
    definition.write_text("\n".join(["LIBRARY python3.dll", "EXPORTS", *sorted(names), ""]))
    dlltool = [str(zig_program()), "dlltool", "-m", "i386:x86-64", "-D", "python3.dll"]
    subprocess.run([*dlltool, "-d", str(definition), "-l", str(library)], check=True)
    return library


def check(wheel: Path, platform: Platform) -> None:
    """Fails unless the wheel is what is promised of it.

    Raises:
        SystemExit: it is too large, has not exactly one native module, or that asks for other libraries.
        subprocess.CalledProcessError: it calls what is not of the stable ABI.
    """
    if wheel.stat().st_size >= MAX_BYTES:
        raise SystemExit(f"{wheel.name}: {wheel.stat().st_size:,} bytes, and {MAX_BYTES:,} are allowed")
    if f"-{PYTHON}-abi3-" not in wheel.name:
        raise SystemExit(f"{wheel.name}: not for all Pythons from {PYTHON} on")
    if platform.system == "Linux" and _glibc(wheel.name, r"-manylinux") > _glibc(platform.target, r"gnu"):
        raise SystemExit(f"{wheel.name}: needs a newer C library than {platform.target}")
    with zipfile.ZipFile(wheel) as archive:
        native = [name for name in archive.namelist() if name.endswith((".so", ".pyd", ".dll", ".dylib"))]
        if native != ["etsplat/_native.pyd" if platform.system == "Windows" else "etsplat/_native.abi3.so"]:
            raise SystemExit(f"{wheel.name}: holds {native}, where one native module belongs")
        asked = libraries(archive.read(native[0]))
    other = [name for name in asked if not re.fullmatch(platform.libraries, name, re.IGNORECASE)]
    if other or not asked:
        raise SystemExit(f"{wheel.name}: its native module asks for {', '.join(other) or 'no library'}")
    subprocess.run(
        [sys.executable, "-m", "abi3audit", "--strict", "--assume-minimum-abi3", "3.12", str(wheel)], check=True
    )


def _glibc(name: str, prefix: str) -> tuple[int, ...]:
    """The version of the C library in a name; where it has none, one that is newer than all."""
    version = re.search(prefix + r"[._](\d+)[._](\d+)", name)
    return tuple(map(int, version.groups())) if version else (sys.maxsize,)


def libraries(module: bytes) -> list[str]:
    """The names of the libraries that a native module asks for, of any of the platforms (ELF, Mach-O, PE)."""
    if module[:4] == b"\x7fELF":
        elf: Any = importlib.import_module("elftools.elf.elffile").ELFFile(io.BytesIO(module))
        return [tag.needed for tag in elf.get_section_by_name(".dynamic").iter_tags("DT_NEEDED")]
    if module[:2] == b"MZ":
        pe: Any = importlib.import_module("pefile").PE(data=module)
        return [entry.dll.decode() for entry in pe.DIRECTORY_ENTRY_IMPORT]
    return list(_dylibs(module))


def _dylibs(module: bytes) -> list[str]:
    """Of a Mach-O file of 64 bits: the names of its commands to load a library."""
    magic, commands = struct.unpack_from("<I12xI", module)
    if magic != 0xFEEDFACF:
        raise SystemExit("neither ELF, PE nor Mach-O of 64 bits")
    names, offset = [], 32
    for _ in range(commands):
        kind, size = struct.unpack_from("<II", module, offset)
        if kind & 0x7FFFFFFF in (0xC, 0x18, 0x1F):  # to load, also weakly, and to pass on
            start = offset + struct.unpack_from("<I", module, offset + 8)[0]
            names.append(module[start : offset + size].partition(b"\0")[0].decode())
        offset += size
    return names


if __name__ == "__main__":
    main()
