"""What Microsoft's compiler would read of the C++ has nothing in it that only GCC and Clang know.

It is tried nowhere; other checks of the wheel for Windows are in release/wheels.py.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

CSRC = Path(__file__).resolve().parent.parent / "csrc"
SOURCES = sorted(path for folder in ("cpu", "math") for path in (CSRC / folder).rglob("*") if path.is_file())
MICROSOFT = {"_MSC_VER", "_WIN32", "_M_X64", "ETSPLAT_X86", "NDEBUG"}
"""What is defined where its compiler builds for x64."""
FOREIGN = {
    "attributes of GNU": r"__attribute__|\[\[gnu::",
    "built-in functions of GNU": r"__builtin_(?!bit_cast\b)",  # that one Microsoft has, too
    "assembler": r"\b(__)?asm(__)?\b",
    "types and constants of GNU and POSIX": r"\b(__int128|typeof|ssize_t|M_PI)\b",
    "headers of GNU and POSIX": r"#\s*include\s*<(sys/|cpuid|pthread|sched|unistd|x86intrin)",
    "pragmas of others": r"#\s*pragma\s+(GCC|clang|omp)",
    "long, which has 32 bits": r"(?<!long )\blong\b(?! long)(?! index;)",  # but for what _BitScanForward asks for
}


def read_by_microsoft(text: str) -> Iterator[tuple[int, str]]:
    """Numbers and text of the lines that its preprocessor keeps, without comments."""
    text = re.sub(r"//[^\n]*|/\*.*?\*/", lambda found: "\n" * found[0].count("\n"), text, flags=re.DOTALL)
    kept = [(True, True)]  # of each condition that is open: whether its part is kept, whether a later one may be
    for number, line in enumerate(text.splitlines(), 1):
        word, _, rest = line.strip()[1:].strip().partition(" ") if line.lstrip().startswith("#") else ("", "", "")
        if word in ("if", "ifdef", "ifndef"):
            true = holds(rest) if word == "if" else (rest.strip() in MICROSOFT) == (word == "ifdef")
            kept.append((true, not true))
        elif word in ("elif", "else"):
            true = kept[-1][1] and (word == "else" or holds(rest))
            kept[-1] = (true, kept[-1][1] and not true)
        elif word == "endif":
            kept.pop()
        elif all(part for part, _ in kept):
            yield number, line
    assert len(kept) == 1


def holds(condition: str) -> bool:
    """A condition of defined(NAME), !, && and ||."""
    asked = re.sub(r"defined\((\w+)\)", lambda name: str(name[1] in MICROSOFT), condition)
    words = re.findall(r"True|False|&&|\|\||!|\(|\)|\S+", asked)
    spelled = {"&&": "and", "||": "or", "!": "not"}
    assert all(word in ("True", "False", "(", ")", *spelled) for word in words), condition
    return bool(eval(" ".join(spelled.get(word, word) for word in words)))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(CSRC)))
def test_what_microsofts_compiler_reads_is_portable(path: Path) -> None:
    for number, line in read_by_microsoft(path.read_text(encoding="utf-8")):
        for what, pattern in FOREIGN.items():
            assert not re.search(pattern, line), f"{path}:{number}: {what}"


@pytest.mark.parametrize(
    "line", ["float x __attribute__((aligned(16)));", "const long pixel = 1;", "#include <unistd.h>"]
)
def test_what_is_foreign_is_found(line: str) -> None:
    """Unless it stands where that compiler does not read."""
    hidden = f"#if defined(_MSC_VER) && !defined(__clang__)\nint a; // long\n#else\n{line}\n#endif\n"
    assert [text for _, text in read_by_microsoft(hidden)] == ["int a; "]
    shown = [text for _, text in read_by_microsoft(f"#ifndef _MSC_VER\n#elif defined(_WIN32)\n{line}\n#endif\n")]
    assert shown == [line]
    assert any(re.search(pattern, line) for pattern in FOREIGN.values())
