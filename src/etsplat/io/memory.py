"""How much memory there is."""

import os
from collections.abc import Iterator
from pathlib import Path


def available_memory(processes: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> int:
    """Bytes that can be used without swapping; half of what is installed where the system does not tell.

    In a container, or another control group of Linux, no more than its limit leaves.

    Args:
        processes: where the system tells of processes.
        groups: where it tells of control groups, of either version.
    """
    return min([_of_the_machine(processes), *_left_in_groups(processes, groups)])


def _of_the_machine(processes: Path) -> int:
    try:
        for line in (processes / "meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    return 4 << 30


def _left_in_groups(processes: Path, groups: Path) -> Iterator[int]:
    """What the limit of this process's group leaves, and of each group around it. Cached files can be given back."""
    try:
        lines = (processes / "self" / "cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        top = groups / controllers
        most, used, cached = (
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
            if controllers
            else ("memory.max", "memory.current", "inactive_file")
        )
        folder = top / path.lstrip("/")
        # In a container the path may be that of the machine, which is not to be seen: then the top is its own group.
        for place in (folder, *folder.parents):
            limit, usage = _number(place / most), _number(place / used)
            if limit is not None and usage is not None:
                yield max(0, limit - usage + _entry(place / "memory.stat", cached))
            if place == top:
                break


def _number(path: Path) -> int | None:
    """What a file of one number holds; None where there is none, or it says "max"."""
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def _entry(path: Path, name: str) -> int:
    try:
        entries = dict(line.split(maxsplit=1) for line in path.read_text(encoding="ascii").splitlines())
        return int(entries.get(name, 0))
    except (OSError, ValueError):
        return 0
