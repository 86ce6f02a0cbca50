"""What makes wheels of other platforms and runs the Dockerfile, as far as can be tested without compilers and root."""

import os
import shutil
import struct
import subprocess
import zipfile
from pathlib import Path

import pytest

from release import dockerfile, wheels

LINUX = wheels.PLATFORMS["linux-x64"]
NAME = "etsplat-0.1.0-cp312-abi3-manylinux_2_24_x86_64.whl"


def mach_o(*names: str) -> bytes:
    """A file of commands alone: a segment, which names nothing, and a library for each name."""
    commands = [struct.pack("<II", 0x19, 72) + bytes(64)]
    for name in names:
        text = name.encode() + bytes(8 - len(name) % 8)
        commands.append(struct.pack("<IIIIII", 0xC, 24 + len(text), 24, 2, 1, 1) + text)
    return struct.pack("<IIIIIIII", 0xFEEDFACF, 0x100000C, 0, 6, len(commands), 0, 0, 0) + b"".join(commands)


def test_libraries_of_a_mac_are_read() -> None:
    """In their order; other commands are passed over, other files refused."""
    assert wheels.libraries(mach_o("/usr/lib/libSystem.B.dylib", "@rpath/libomp.dylib")) == [
        "/usr/lib/libSystem.B.dylib",
        "@rpath/libomp.dylib",
    ]
    with pytest.raises(SystemExit, match="neither"):
        wheels.libraries(bytes(64))


@pytest.mark.parametrize(
    ("name", "files", "problem"),
    [
        (NAME.replace("cp312-abi3", "cp312-cp312"), {}, "not for all Pythons"),
        (NAME.replace("2_24", "2_29"), {}, "needs a newer C library than x86_64-linux-gnu.2.28"),
        (NAME.replace("manylinux_2_24", "linux"), {}, "needs a newer C library than x86_64-linux-gnu.2.28"),
        (NAME, {"etsplat/_native.abi3.so": b"", "etsplat/libomp.so": b""}, "one native module belongs"),
        (NAME, {"etsplat/big.bin": os.urandom(wheels.MAX_BYTES)}, "are allowed"),
        (NAME, {"etsplat/_native.abi3.so": mach_o("libomp.dylib")}, "asks for libomp.dylib"),
    ],
)
def test_wheels_that_promise_too_little_are_refused(
    name: str, files: dict[str, bytes], problem: str, tmp_path: Path
) -> None:
    with zipfile.ZipFile(tmp_path / name, "w") as archive:
        for file, content in files.items():
            archive.writestr(file, content)
    with pytest.raises(SystemExit, match=problem):
        wheels.check(tmp_path / name, LINUX)


def test_what_zig_does_not_know_is_translated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a Mac's linker: bundles, and lists of symbols; a library of Linux. All other words pass as they are."""
    echo = tmp_path / "zig"
    echo.write_text('#!/bin/sh\nfor word; do echo "$word"; done\n')
    echo.chmod(0o755)
    monkeypatch.setattr(wheels, "zig_program", lambda: echo)
    tools = wheels.compilers(wheels.PLATFORMS["macos-arm64"], tmp_path / "tools")
    command = [str(tools / "c++"), "-bundle", "-DNAME=two words", "-ldl", "-Wl,@python.sym", "-Wl,-x"]
    words = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert words[:3] == ["c++", "-target", "aarch64-macos.11.0"]
    assert words[-4:] == ["-dynamiclib", "-DNAME=two words", "-Wl,-undefined,dynamic_lookup", "-Wl,-x"]


@pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler")
def test_headers_of_python_are_of_the_compilers_machine(tmp_path: Path) -> None:
    """Not of the one on which Python was configured; and there is all that the stable ABI's headers ask for."""
    source = tmp_path / "sizes.cpp"
    sizes = {"VOID_P": "void*", "LONG": "long", "LONG_LONG": "long long", "SIZE_T": "size_t", "WCHAR_T": "wchar_t"}
    checks = [f'static_assert(SIZEOF_{name} == sizeof({kind}), "{kind}");' for name, kind in sizes.items()]
    own = '#ifdef HAVE_FORK\n#error "of the machine"\n#endif'
    source.write_text("\n".join(["#define Py_LIMITED_API 0x030A0000", "#include <Python.h>", own, *checks, ""]))
    command = ["c++", "-std=c++17", "-fsyntax-only", f"-I{wheels.headers(tmp_path / 'include')}", str(source)]
    compiled = subprocess.run(command, capture_output=True, text=True, check=False)
    assert compiled.returncode == 0, compiled.stderr


def a_stage(root: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dockerfile.Stage, list[str]]]:
    """Stages begin in empty folders, and what they would run is noted."""
    ran: list[tuple[str, dockerfile.Stage, list[str]]] = []
    (root / "base").mkdir()
    monkeypatch.setattr(dockerfile, "base", lambda image, folder: root / "base")
    monkeypatch.setattr(
        dockerfile.Stage, "run", lambda stage, command, binds: ran.append((stage.root.name, stage, list(command)))
    )
    return ran


def test_the_dockerfile_is_understood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of it: what is copied where, what runs in which stage and shell, and as whom its entry point does."""
    ran = a_stage(tmp_path, monkeypatch)
    text = (dockerfile.ROOT / "Dockerfile").read_text(encoding="utf-8")
    made = text.replace("RUN python -m pip wheel", "WORKDIR /wheels\nCOPY LICENSE .\nRUN python -m pip wheel")
    build, image = dockerfile.build(made, tmp_path, {"EXTRAS": "cuda"}, {})
    assert (image.user, image.folder, image.entry, image.command) == (1000, "/data", ["etsplat"], ["--help"])
    assert image.variables == {"EXTRAS": "cuda"}  # TORCH_INDEX has no value unless it is given one
    assert [name for name, _, _ in ran] == ["build", "build", "image"]
    assert [command[0] for _, _, command in ran] == ["/bin/bash", "/bin/bash", "/bin/sh"]
    assert ran[2][2][2].endswith("&& useradd --create-home --uid 1000 etsplat")
    assert "\\" not in ran[2][2][2]
    assert (build.root / "source" / "src" / "etsplat" / "__init__.py").is_file()
    assert not (build.root / "source" / "tests").exists()
    assert {path.name for path in (image.root / "wheels").iterdir()} == {"LICENSE", "constraints.txt"}


@pytest.mark.parametrize(
    ("text", "given", "problem"),
    [
        ("FROM a\nVOLUME /data", {}, "VOLUME: this instruction"),
        ("FROM a\nARG B=1", {"C": "2"}, "no ARG C"),
        ("FROM a\nCOPY tests /tests", {}, "lets no such file through"),
    ],
)
def test_what_the_dockerfile_cannot_have_here_is_refused(
    text: str, given: dict[str, str], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a_stage(tmp_path, monkeypatch)
    with pytest.raises(SystemExit, match=problem):
        dockerfile.build(text, tmp_path, given, {})


def test_an_image_that_nothing_stands_in_for_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="nothing stands in"):
        dockerfile.base("node:22", tmp_path)


def test_what_dockerignore_leaves_out_is_not_copied(tmp_path: Path) -> None:
    """The last rule that names a file, or a folder around it, decides."""
    (tmp_path / ".dockerignore").write_text("*\n!src\n!a.txt\n**/__pycache__\n**/*.so\n")
    for name in ("a.txt", "b.txt", "src/c.py", "src/d/e.so", "src/d/__pycache__/f.pyc", "tests/g.py", "src/d.so.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert dockerfile.context(tmp_path) == ["a.txt", "src/c.py", "src/d.so.py"]
