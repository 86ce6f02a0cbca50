"""Pages of the programs in examples/: what each is for, its picture, its source."""

import ast
from pathlib import Path

SHORTER = {
    "03_own_kernel": ("--preset", "tiny"),
    "06_scene_and_path": ("--iterations", "300", "--width", "160"),
}
"""Options with which an example takes seconds, where it does not without."""


def example_pages(folder: Path) -> dict[str, str]:
    """A page for each example, and one that lists them."""
    paths = sorted(folder.glob("*.py"))
    pages = {f"examples/{path.stem}.md": _page(path) for path in paths}
    lines = [f"- [{_title(path)}]({path.stem}.md): {_docstring(path)[0]}" for path in paths]
    toc = ["```{toctree}", ":hidden:", "", *(path.stem for path in paths), "```"]
    return pages | {"examples/index.md": "\n".join(["# Examples", "", _ABOUT, "", *lines, "", *toc, ""])}


_ABOUT = """Programs of one screen, of public names alone. Each writes a picture; `--help` lists its options, and the
tests run all of them."""


def _docstring(path: Path) -> tuple[str, str]:
    """The first paragraph and the rest, in which indented lines are commands."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    first, _, rest = text.partition("\n\n")
    lines = [line.strip() if line.strip().startswith("python ") else line for line in rest.splitlines()]
    commands = [f"```sh\n{line}\n```" if line.startswith("python ") else line for line in lines]
    return " ".join(first.split()), "\n".join(commands)


def _title(path: Path) -> str:
    return path.stem.partition("_")[2].replace("_", " ").capitalize()


def _page(path: Path) -> str:
    first, rest = _docstring(path)
    lines = [f"# {_title(path)}", "", first, "", rest, ""]
    lines += [f"![What {path.name} draws](../images/{path.stem}.png)", ""]
    if path.stem in SHORTER:
        lines += [f"(With `{' '.join(SHORTER[path.stem])}`.)", ""]
    return "\n".join([*lines, f"```{{literalinclude}} ../../../examples/{path.name}", ":language: python", "```", ""])
