"""Pages of the site that are made of what stands elsewhere: docstrings, settings, examples, README.md, CHANGELOG.md."""

from pathlib import Path

from docs.pages.api import api_pages
from docs.pages.examples import example_pages
from docs.pages.pictures import draw
from docs.pages.readme import readme_pages
from docs.pages.settings import settings_pages

ROOT = Path(__file__).resolve().parent.parent.parent


def pages() -> dict[str, str]:
    """The text of every page, by its file within docs/generated."""
    return {**readme_pages(ROOT), **api_pages(), **settings_pages(), **example_pages(ROOT / "examples")}


def write_all(folder: Path) -> None:
    """Writes what has changed, since Sphinx reads again what is newer, and takes away what there is no more."""
    wanted = pages()
    for path in [path for path in folder.rglob("*") if path.suffix in (".md", ".rst", ".txt")]:
        if str(path.relative_to(folder)) not in wanted:
            path.unlink()
    for name, text in wanted.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    draw(folder / "images", ROOT / "examples")
