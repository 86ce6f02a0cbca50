"""Pages that are parts of README.md, so that the site and the repository say the same."""

import posixpath
import re
from pathlib import Path

_LINK = re.compile(r"(\]\()(?!https?:|mailto:|#)([^)\s]+)(\))")


def readme_pages(root: Path) -> dict[str, str]:
    """What stands before the first heading, for the front page to include; and the quickstart."""
    text = (root / "README.md").read_text(encoding="utf-8")
    intro = text.partition("\n")[2].partition("\n## ")[0].strip()
    start, end = text.index("## Try it"), text.index("## Read on")
    return {
        "introduction.txt": rebased(intro, "docs") + "\n",
        "quickstart.md": "# Quickstart\n\n" + rebased(text[start:end].rstrip(), "docs/generated") + "\n",
    }


def rebased(text: str, folder: str) -> str:
    """Markdown of the root with its links to files as they are seen from a folder."""
    return _LINK.sub(lambda link: link[1] + posixpath.relpath(link[2], folder) + link[3], text)
