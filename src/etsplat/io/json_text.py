"""JSON that somebody else wrote, and whether it says what it must."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import NoneType
from typing import Any, get_args

from etsplat.core.errors import InputError

_LARGEST = {int: 1e15, float: 1e30}
"""Of numbers: nobody counts further, and what is computed from them stays finite."""

_NAMES = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    dict: "an object",
    NoneType: "null",
}


def parse_json(text: str | bytes) -> Any:
    """What a text says; a mark of its byte order, as some editors put it first, says nothing.

    Raises:
        ValueError: it is not JSON, or nested deeper than Python can follow.
    """
    try:
        return json.loads(text.removeprefix("\ufeff") if isinstance(text, str) else text)
    except RecursionError as error:
        raise ValueError("nested too deep") from error


def is_number(value: object) -> bool:
    """Whether a value is a number that can be computed and drawn with: no NaN, infinity, or what overflows."""
    return _is_a(value, float)


def entries_problem(found: object, kinds: Mapping[str, Any], needed: Iterable[str]) -> str | None:
    """What is wrong with the entries of a JSON object, or None.

    Args:
        found: what a file says.
        kinds: of entries by dotted name, those of groups before what is in them: int, float (any number), str, dict,
            or a union of these and None. Entries that have no kind may be anything.
        needed: the names of those that must be there, null only if their kind says so. Others may be missing.
    """
    if not isinstance(found, dict):
        return "holds no JSON object"
    needed = set(needed)
    for name, kind in kinds.items():
        *groups, last = name.split(".")
        place: Any = found
        for group in groups:
            place = place.get(group, {}) if isinstance(place, dict) else {}
        if last not in place:
            if name in needed:
                return f"lacks `{name}`"
            continue
        options = get_args(kind) or (kind,)
        if not any(_is_a(place[last], option) for option in options):
            expected = " or ".join(_NAMES[option] for option in options)
            return f"`{name}` is {json.dumps(place[last])[:40]}, but must be {expected}"
    return None


def check_entries(path: Path, found: object, kinds: Mapping[str, Any], needed: Iterable[str] = ()) -> None:
    """Sees to it that a file of a run says what it must; see `entries_problem`.

    Raises:
        InputError: it does not.
    """
    if problem := entries_problem(found, kinds, needed):
        raise InputError(f"{path}: {problem}; delete it and run again")


def as_json(value: object) -> Any:
    """A value as it is read back from JSON."""
    return json.loads(json.dumps(value))


def json_differences(stored: Any, given: Any) -> list[str]:
    """What differs between two values, as "key=stored (not given)"."""
    if not isinstance(stored, dict) or not isinstance(given, dict):
        return [] if stored == given else [f"{stored} (not {given})"]
    keys = [*stored, *(key for key in given if key not in stored)]
    found = []
    for key in keys:
        before, now = stored.get(key), given.get(key)
        if isinstance(before, dict) and isinstance(now, dict):
            found += [f"{key}.{difference}" for difference in json_differences(before, now)]
        elif before != now:
            found.append(f"{key}={before} (not {now})")
    return found


def _is_a(value: Any, kind: type) -> bool:
    if kind not in _LARGEST:
        return isinstance(value, kind)
    numbers = (int, float) if kind is float else int
    return isinstance(value, numbers) and not isinstance(value, bool) and abs(value) <= _LARGEST[kind]
