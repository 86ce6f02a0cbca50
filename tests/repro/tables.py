"""Cases of a row: each has a name, what is to be done, and what leaks where an ``InputError`` is wanted."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest

NOTHING = pytest.fail.Exception  # is raised: what cannot be used is taken

Leak = type[BaseException]


def cases(row: int, reason: str, table: Iterable[tuple[str, Callable[..., Any], Leak | None]]) -> pytest.MarkDecorator:
    """Parametrises (act, ) by the table; every case is expected to fail with its leak, or is mended: None."""
    return pytest.mark.parametrize(
        "act",
        [
            pytest.param(
                act,
                id=name,
                marks=()
                if leak is None
                else pytest.mark.xfail(strict=True, raises=leak, reason=f"row {row}: {reason}"),
            )
            for name, act, leak in table
        ],
    )
