"""The description of the native calls for Python, from the module itself: `python -m tests.helpers.stubs FILE`."""

import subprocess
import sys
from pathlib import Path

from nanobind.stubgen import StubGen

from etsplat import _native


def native_stub() -> str:
    """What src/etsplat/_native.pyi has to be."""
    generator = StubGen(module=_native, quiet=True)
    generator.put(_native)
    text = generator.get()
    for command in (["check", "--fix", "--quiet", "--select", "I"], ["format", "--quiet"]):
        ruff = [sys.executable, "-m", "ruff", *command, "--stdin-filename", "src/etsplat/_native.pyi", "-"]
        text = subprocess.run(ruff, input=text, capture_output=True, text=True, check=True).stdout
    return text


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(native_stub(), encoding="utf-8")
