from pathlib import Path

import pytest

from etsplat.io.memory import available_memory

GIB = 1 << 30


@pytest.fixture
def machine(tmp_path: Path) -> tuple[Path, Path]:
    """A machine with 16 GiB free, whose control groups are still to be made."""
    processes, groups = tmp_path / "proc", tmp_path / "groups"
    (processes / "self").mkdir(parents=True)
    (processes / "meminfo").write_text(f"MemTotal: 999 kB\nMemAvailable: {16 << 20} kB\n")
    groups.mkdir()
    return processes, groups


def limit(folder: Path, names: tuple[str, str, str], most: str, used: int, cached: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / names[0]).write_text(f"{most}\n")
    (folder / names[1]).write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\n{names[2]} {cached}\n")


FIRST = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
SECOND = ("memory.max", "memory.current", "inactive_file")


def test_without_limits_all_that_is_free_can_be_used(machine: tuple[Path, Path]) -> None:
    assert available_memory(*machine) == 16 * GIB
    (machine[0] / "self" / "cgroup").write_text("0::/a/b\n")
    limit(machine[1] / "a", SECOND, "max", GIB, 0)
    assert available_memory(*machine) == 16 * GIB


@pytest.mark.parametrize(("line", "top", "names"), [("0::/a/b", "", SECOND), ("4:memory:/a/b", "memory", FIRST)])
def test_the_tightest_group_counts_and_cached_files_do_not(
    machine: tuple[Path, Path], line: str, top: str, names: tuple[str, str, str]
) -> None:
    """The inner group leaves 6 GiB, the outer one 8 - 5 + 1."""
    (machine[0] / "self" / "cgroup").write_text(f"9:cpu:/a/b\n{line}\n")
    limit(machine[1] / top / "a" / "b", names, str(8 * GIB), 2 * GIB, 0)
    assert available_memory(*machine) == 6 * GIB
    limit(machine[1] / top / "a", names, str(8 * GIB), 5 * GIB, GIB)
    assert available_memory(*machine) == 4 * GIB


def test_a_container_that_does_not_see_its_path_sees_its_group_at_the_top(machine: tuple[Path, Path]) -> None:
    (machine[0] / "self" / "cgroup").write_text("0::/on/the/machine\n")
    limit(machine[1], SECOND, str(3 * GIB), GIB, 0)
    assert available_memory(*machine) == 2 * GIB


def test_a_group_beyond_its_limit_leaves_nothing(machine: tuple[Path, Path]) -> None:
    (machine[0] / "self" / "cgroup").write_text("0::/\n")
    limit(machine[1], SECOND, str(GIB), 2 * GIB, 0)
    assert available_memory(*machine) == 0
