"""How messages spell settings."""

import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from etsplat.core.spelling import as_option, by_options, either, file_kind, option, spelled_as_options

SPELLED = [
    (("start.shape", "hull"), "--start.shape hull", 'start.shape="hull"'),
    (("start.hull_faces", 0), "--start.hull-faces 0", "start.hull_faces=0"),
    (("max_triangles", 20000), "--max-triangles 20000", "max_triangles=20000"),
    (("up", "y", "z"), "--up y or z", 'up="y" or "z"'),
    (("resume", True), "--resume", "resume=True"),
    (("loss.flips", False), "--loss.no-flips", "loss.flips=False"),
    (("scene", ...), "--scene", "scene="),
    (("min_opacity",), "--min-opacity", "min_opacity"),
]


@pytest.mark.parametrize(("given", "options", "python"), SPELLED)
def test_a_setting_is_spelled_for_whoever_has_called(given: tuple[str, object], options: str, python: str) -> None:
    assert option(*given) == python
    with spelled_as_options():
        assert option(*given) == options
        with spelled_as_options(False):
            assert option(*given) == python
        assert option(*given) == options
    assert option(*given) == python
    assert as_option(*given) == options


def test_what_has_another_way_in_python_is_said_in_its_words() -> None:
    assert either("--overwrite", "another folder") == "another folder"
    assert file_kind("glb", "obj") == "a path that ends in .glb or .obj"
    with spelled_as_options():
        assert either("--overwrite", "another folder") == "--overwrite"
        assert file_kind("glb", "obj") == "--format glb or obj"


def test_all_threads_of_a_command_spell_options_and_nobody_after_it() -> None:
    """Viewers, and what reads photos, have threads of their own, also such as were there before."""
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(option, "resume", True).result() == "resume=True"
        with spelled_as_options():
            assert pool.submit(option, "resume", True).result() == "--resume"
        with pytest.raises(SystemExit), spelled_as_options():
            sys.exit(2)  # as commands end
        assert pool.submit(by_options).result() is False
