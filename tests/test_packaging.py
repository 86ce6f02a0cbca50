"""What is installed is what the sources say, and holds together."""

import re
import subprocess
import sys
from importlib.metadata import files as distribution_files
from importlib.metadata import requires, version
from importlib.resources import files
from pathlib import Path

import pytest

from etsplat import _native
from etsplat.engines.cuda.program import source_root
from etsplat.web.pages import SCENE_SCRIPTS, SHADERS, SHARED_SCRIPTS, SORT_SHADERS

REPOSITORY = Path(__file__).resolve().parent.parent


def test_version_is_the_same_everywhere() -> None:
    """In pyproject.toml, the installed package, the newest heading of CHANGELOG.md, and what is cited."""
    places = {
        "pyproject.toml": r'^version = "(.+)"$',
        "CHANGELOG.md": r"^## (\S+)",
        "CITATION.cff": r"^version: (.+)$",
        "README.md": r"^  version = {(.+)},$",
    }
    for name, pattern in places.items():
        found = re.search(pattern, (REPOSITORY / name).read_text(encoding="utf-8"), re.MULTILINE)
        assert found, name
        assert found[1] == version("etsplat"), name


def test_layers_hold() -> None:
    """No layer imports a higher one (the contract in pyproject.toml)."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports; raise SystemExit(lint_imports())"]
    result = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout


def test_tests_mirror_the_sources() -> None:
    """Each folder of tests is named as a layer, but for helpers, and what is beside the package."""
    tests = {path.name for path in (REPOSITORY / "tests").iterdir() if path.is_dir() and any(path.glob("**/*.py"))}
    layers = {path.parent.name for path in (REPOSITORY / "src" / "etsplat").glob("*/__init__.py")}
    assert tests - layers == {"docs", "equal_bits", "fuzz", "helpers", "soak", "studies"}
    assert layers - tests == set()


def test_report_assets_are_installed() -> None:
    """The pages of reports and scenes, styles and scripts come with the package, and so does the typing marker."""
    for name in ("page.html", "page.css", "page.js", "viewer.js", "scene.html"):
        assert (files("etsplat.report") / "assets" / name).is_file()
    shaders = [f"{name}.wgsl" for name in SHADERS]
    for name in ("scene_page.html", "scene.html", "base.css", "scene.css", *SHARED_SCRIPTS, *SCENE_SCRIPTS, *shaders):
        assert (files("etsplat.web") / "assets" / name).is_file()
    for name in SORT_SHADERS:
        assert (files("etsplat.engines.webgpu") / "shaders" / f"{name}.wgsl").is_file()
    assert (files("etsplat") / "py.typed").is_file()


def test_kernel_sources_are_installed() -> None:
    """The GPU engine compiles its kernels from text that comes with the package."""
    installed = {file.as_posix() for file in distribution_files("etsplat") or []}
    assert {"etsplat/csrc/cuda/fill.cu", "etsplat/csrc/cuda/common.h", "etsplat/csrc/math/portable.h"} <= installed
    assert (source_root() / "cuda" / "fill.cu").is_file()


def test_torch_range_stays_wide() -> None:
    """The package asks for torch 2.6 or newer and pins nothing: constraints.txt does that for the checks alone."""
    needs = {re.split(r"[<>=!~; \[]", need, maxsplit=1)[0]: need for need in requires("etsplat") or []}
    assert needs["torch"] == "torch>=2.6"


def test_nothing_local_is_committed() -> None:
    """No tracked text file holds an absolute path of a home, work or temporary folder."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    local = re.compile(rb"/(?:work|home|root|Users|tmp)/\w")
    found = [name for name in listed.stdout.split("\0")[:-1] if local.search((REPOSITORY / name).read_bytes())]
    assert [name for name in found if name != "tests/test_packaging.py"] == []


def test_no_reader_is_sent_to_a_folder_that_only_its_authors_have() -> None:
    """Pages, sources and what programs say of themselves name real input as research/README.md does: data/NAME."""
    folders = ("docs", "research", "studies", "benchmarks", "examples", "src", "release", ".github")
    pages = [*REPOSITORY.glob("*.*"), *(path for name in folders for path in (REPOSITORY / name).rglob("*"))]
    texts = [path for path in pages if path.suffix in (".md", ".py", ".ipynb", ".toml", ".yml", ".yaml", ".sh")]
    assert len(texts) > 300
    named = re.compile(r"\.\./shared|shared/(?:data|prototypes|spec)")
    assert [str(path) for path in texts if named.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize(
    "page", sorted(REPOSITORY.glob("*.md")) + sorted(REPOSITORY.glob("[drs]*/*.md")), ids=lambda page: page.name
)
def test_links_lead_somewhere(page: Path) -> None:
    """Every link of a page to another file of the repository, and to a heading of it, is right."""
    for target in re.findall(r"\]\((?!https?://)([^)\s]+)\)", page.read_text(encoding="utf-8")):
        name, _, heading = target.partition("#")
        linked = page.parent / name if name else page
        assert linked.exists(), target
        if heading:
            headings = re.findall(r"^#+ (.+)$", linked.read_text(encoding="utf-8"), re.MULTILINE)
            assert heading in [re.sub(r"[^\w\- ]", "", text).lower().replace(" ", "-") for text in headings], target


@pytest.mark.sanitize
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_thread_count_can_be_set(threads: int) -> None:
    """The native pool takes any number of threads, and 0 goes back to the default."""
    before = _native.num_threads()
    _native.set_num_threads(0)
    default = _native.num_threads()
    _native.set_num_threads(threads)
    assert _native.num_threads() == threads
    _native.set_num_threads(0)
    assert _native.num_threads() == default
    _native.set_num_threads(before)


def test_thread_count_from_the_environment() -> None:
    """ETSPLAT_NUM_THREADS sets the default; what is no positive number is ignored."""
    program = "from etsplat import _native; print(_native.num_threads())"

    def threads(value: str) -> int:
        result = subprocess.run(
            [sys.executable, "-c", program], env={"ETSPLAT_NUM_THREADS": value}, capture_output=True, check=True
        )
        return int(result.stdout)

    assert threads("3") == 3
    assert threads("none") == threads("-1") >= 1
