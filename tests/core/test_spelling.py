"""How messages spell settings, and that none outside of the command line spells its options by itself."""

import ast
import inspect
import re
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import etsplat
from etsplat.core.spelling import as_option, by_options, either, file_kind, option, spelled_as_options
from etsplat.io.run_readme import readme_of
from etsplat.tasks.settings import settings_of

PACKAGE = Path(etsplat.__file__).parent

OTHERS = {
    ("data/formats/opensfm.py", "--camera-lens"): "of OpenDroneMap",
    ("data/frames.py", "--out"): "a command for a shell",
    ("data/load.py", "--out"): "a command for a shell",
    ("engines/cuda/compile.py", "--std"): "of NVRTC",
    ("engines/cuda/compile.py", "--fmad"): "of NVRTC",
    ("engines/cuda/compile.py", "--ftz"): "of NVRTC",
    ("engines/cuda/compile.py", "--gpu-architecture"): "of NVRTC",
    ("io/photos.py", "--out"): "a command for a shell",
    ("report/cards.py", "--lpips-weights"): "a command for a shell",
    ("report/command.py", "--out"): "a command for a shell",
    ("report/curves.py", "--"): "a style of lines",
    ("report/sweep_page.py", "--part"): "a variable of CSS",
    ("tasks/sweeps/ray_cluster.py", "--head"): "of Ray",
    ("tasks/sweeps/sweep.py", "--config"): "of what reads the words of a command line",
    ("tasks/sweeps/sweep.py", "--seeds"): "of what reads the words of a command line",
    ("tasks/sweeps/tuning.py", "--search"): "of what reads the words of a command line",
    ("viewer/panel.py", "--path"): "a command for a shell",
}
"""Options in texts outside of `cli/`, each with its reason; everything else is spelled by `core/spelling.py`."""

COMMANDS_ALONE = {"crop", "path", "host", "port", "cluster"}
"""Arguments of functions that no public one has: only commands call these."""

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


def test_the_readme_of_a_run_is_for_whoever_made_it() -> None:
    assert "continues with resume=True; safe to delete" in readme_of("train")
    assert "few faces under a texture, of texture= or of etsplat.texture_mesh\n" in readme_of("reconstruct")
    with spelled_as_options():
        assert "continues with --resume; safe to delete" in readme_of("train")
        assert "of --texture or of etsplat export --texture\n" in readme_of("reconstruct")
    assert "continues when Trainer.fit is called for it again; safe" in readme_of("fit")


def test_no_text_outside_of_the_command_line_spells_its_options() -> None:
    """What `option` or `either` say is spelled for both; every other exception is listed, and there."""
    found = {(file, name) for file, tree in _modules() for name in _spelled_in(tree)}
    assert sorted(found - OTHERS.keys()) == [], "spell settings by `option` of core/spelling.py"
    assert sorted(OTHERS.keys() - found) == [], "these are no longer there"


def test_what_is_spelled_for_python_is_there() -> None:
    """By its name, as an argument of a public function or a setting of a config, which takes such a value."""
    configs = (etsplat.ReconstructConfig, etsplat.TrainConfig, etsplat.ExportConfig)
    calls = (etsplat.reconstruct, etsplat.train, etsplat.export, etsplat.texture_mesh, etsplat.load_dataset)
    arguments = {name for call in calls for name in inspect.signature(call).parameters} | COMMANDS_ALONE
    named = [(file, *given) for file, tree in _modules() for given in _options_in(tree)]
    assert len(named) > 50
    for file, name, values in named:
        settings = [settings_of(kind)[name] for kind in configs if name in settings_of(kind)]
        assert settings or name in arguments, (file, name)
        for value in values if settings else ():
            assert any(setting.problem(value) is None for setting in settings), (file, name, value)


def _modules() -> Iterator[tuple[str, ast.Module]]:
    """All but the command line, and what spells for both."""
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE).as_posix()
        if not file.startswith("cli/") and file != "core/spelling.py":
            yield file, ast.parse(path.read_text(encoding="utf-8"))


def _spelled_in(tree: ast.Module) -> Iterator[str]:
    """The options in a module's texts: not in docstrings, nor in what `either` says to the command line."""
    leaving = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for call in _calls(tree, "either"):
        leaving |= {id(node) for node in ast.walk(call.args[0])}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in leaving:
            yield from re.findall(r"(?<![\w-])--(?:[a-z][\w.-]*\w|$)", node.value)


def _options_in(tree: ast.Module) -> Iterator[tuple[str, list[object]]]:
    """What `option` is called with, where that is written there."""
    for call in _calls(tree, "option"):
        name, *values = call.args
        if isinstance(name, ast.Constant):
            known = [value.value for value in values if isinstance(value, ast.Constant)]
            yield str(name.value), [value for value in known if value is not ...]


def _calls(tree: ast.Module, name: str) -> Iterator[ast.Call]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == name:
            yield node
