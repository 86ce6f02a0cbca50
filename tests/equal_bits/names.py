"""What is called otherwise in this tree than in BASE, and where bits change on purpose. The only place that says so.

Cases are written with BASE's names. Whoever renames an option, a tensor of a checkpoint or a number adds a line here.
"""

import re
from dataclasses import dataclass

OPTIONS: dict[str, dict[str, str]] = {
    "reconstruct": {},
    "train": {},
}
"""By task, what BASE's options are here: "--old": "--new", or with a value "--old value": "--new other" (which goes
first). An empty text leaves the option out. A flag that stands alone is written alone."""


@dataclass(frozen=True)
class Names:
    """How the names of one kind of thing changed.

    Attributes:
        renamed: BASE's name, a regular expression that fits all of it, and what it is here (with \\1 for groups).
        gone: names that BASE alone has.
        added: names that this tree alone has.
        ignored: names of either tree whose values depend on the clock or on versions.
    """

    renamed: dict[str, str]
    gone: frozenset[str] = frozenset()
    added: frozenset[str] = frozenset()
    ignored: frozenset[str] = frozenset()

    def here(self, name: str) -> str:
        """What BASE's name is in this tree."""
        for pattern, replacement in self.renamed.items():
            if match := re.fullmatch(pattern, name):
                return match.expand(replacement)
        return name


TENSORS = Names({})
"""Of checkpoints and of soup.safetensors."""
METRICS = Names({}, ignored=frozenset({"seconds", "seconds_per_iteration", "versions"}))
"""Of metrics.json."""
HISTORY = Names({}, ignored=frozenset({"seconds"}))
"""Of the lines of history.jsonl."""
FILES = Names({})
"""Of files in the run directory, as test/000_render.png."""

CLOCKS = {"progress": 0}
"""Tensors with an element that is a time: its index. By the names of either tree."""

CHANGED: dict[str, str] = {}
"""Cases whose bits change on purpose, and why. They must differ: a line that is not true any more is an error."""


def translated(task: str, words: list[str]) -> list[str]:
    """BASE's options, as this tree calls them."""
    table, result, position = OPTIONS[task], [], 0
    while position < len(words):
        pair = " ".join(words[position : position + 2])
        if pair in table:
            result += table[pair].split()
            position += 2
        else:
            word = words[position]
            result += table[word].split() if word in table else [word]
            position += 1
    return result
