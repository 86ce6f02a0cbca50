"""The pages that are made of docstrings, settings, examples and README.md; and the pages that are written."""

import ast
import os
import re
import sys
from pathlib import Path

import pytest

import etsplat
from docs.pages import benchmarks, pages
from docs.pages.api import topic_of
from docs.pages.examples import SHORTER
from docs.pages.pictures import draw
from docs.pages.readme import rebased
from docs.pages.settings import TASKS, settings_page, values_of
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.settings import settings_of

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    return pages()


def test_every_public_name_is_in_the_reference_once(made: dict[str, str]) -> None:
    """As `src/etsplat/__init__.pyi` lists them, which is read here by other means than there."""
    stub = Path(etsplat.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    public = [node.names[0].asname for node in ast.parse(stub).body if isinstance(node, ast.ImportFrom)]
    text = "\n".join(made[name] for name in made if name.startswith("api/"))
    assert sorted(re.findall(r"^\.\. auto\w+:: etsplat\.(\w+)$", text, re.MULTILINE)) == sorted(map(str, public))
    for name in public:  # the list on the first page links to each as well
        assert made["api/index.rst"].count(f"`~etsplat.{name}`") == 1


def test_a_name_without_a_topic_is_refused() -> None:
    """A new module says where its names stand."""
    assert topic_of("etsplat.ops.adam")[0] == "training"  # not with the rest of `ops`
    with pytest.raises(KeyError, match="no topic"):
        topic_of("etsplat.opsy.adam")


@pytest.mark.parametrize("task", TASKS)
def test_every_setting_is_in_its_table_once(task: str) -> None:
    """With a help, and what presets make of it."""
    rows = re.findall(r"^\| `([\w.]+)` \| (.+?) \| (.+?) \| (.+) \|$", settings_page(task), re.MULTILINE)
    assert [row[0] for row in rows] == list(dict.fromkeys(row[0] for row in rows))
    assert {row[0] for row in rows} == set(settings_of(TASKS[task][0]))


def test_tables_say_where_presets_differ() -> None:
    """Presets that agree stand together; those that have the default's value, not at all."""
    row = next(line for line in settings_page("reconstruct").splitlines() if line.startswith("| `max_faces` |"))
    default = ReconstructConfig().max_faces
    assert f"| `{default}`" in row
    for preset in ("quick", "demo", "study"):
        value = ReconstructConfig.of(preset).max_faces
        assert (preset in row) == (value != default)
        assert f"`{value}`" in row


def test_values_are_named_in_words() -> None:
    known = settings_of(ReconstructConfig)
    assert values_of(known["start.shape"]) == "`auto`, `sphere`, `hull`"
    assert values_of(known["start.level"]) == "whole number, between 0 and 9"
    assert values_of(known["texture"]).endswith("or `none`")


def test_every_example_has_a_page(made: dict[str, str]) -> None:
    """With its source and its picture."""
    for path in (ROOT / "examples").glob("*.py"):
        page = made[f"examples/{path.stem}.md"]
        assert f"../../../examples/{path.name}" in page
        assert f"python examples/{path.name}" in page
        assert f"../images/{path.stem}.png" in page


def test_pictures_are_drawn_once(tmp_path: Path) -> None:
    """And again when the example has changed; whether it writes a picture or a folder with one."""
    examples, images = tmp_path / "examples", tmp_path / "images"
    examples.mkdir()
    start = "import sys, pathlib; out = pathlib.Path(sys.argv[-1])\n"
    plain, folder = examples / "a.py", examples / "b.py"
    plain.write_text(start + "out.write_text(f'{len(sys.argv)}')")
    folder.write_text(start + "out.mkdir(); (out / 'x.png').write_text('b')")
    draw(images, examples)
    assert {path.name: path.read_text() for path in images.iterdir()} == {"a.png": "3", "b.png": "b"}
    (images / "a.png").write_text("kept")
    folder.write_text(folder.read_text().replace("'b')", "'c')"))
    os.utime(folder, (2e9, 2e9))
    draw(images, examples)
    assert {path.name: path.read_text() for path in images.iterdir()} == {"a.png": "kept", "b.png": "c"}
    assert set(SHORTER) < {path.stem for path in (ROOT / "examples").glob("*.py")}


def test_parts_of_the_readme_keep_their_links() -> None:
    """They lead to the same files from elsewhere; addresses and anchors stay."""
    text = "[a](docs/b.md#c) ![d](docs/images/e.png) [f](https://g.h/i) [j](#k) [l](LICENSE)"
    moved = rebased(text, "docs/generated")
    assert moved == "[a](../b.md#c) ![d](../images/e.png) [f](https://g.h/i) [j](#k) [l](../../LICENSE)"


def test_pages_need_no_sphinx() -> None:
    """So that these tests run wherever the others do."""
    assert "sphinx" not in sys.modules


def test_every_page_is_in_the_contents() -> None:
    """A page of docs/ that the front page does not list would be found by nobody."""
    listed = set((ROOT / "docs" / "index.md").read_text(encoding="utf-8").splitlines())
    assert {path.stem for path in (ROOT / "docs").glob("*.md")} <= listed | {"index"}


RESULTS = """
### Few

| scene | | PSNR | paper: V / ours |
|---|---|---|---|
| fox | ours | **31.5** | 1 / **2** |
| fox | theirs | 30.5 | 3 / 4 |

### Many

| scene | PSNR |
|---|---|
| fox | 7 |
"""


def test_cells_of_results_are_found() -> None:
    """Within their section alone, by as many first cells as tell rows apart; one of several numbers in a cell."""
    assert benchmarks.value(RESULTS, "Few", ["fox", "ours"], "PSNR") == "**31.5**"
    assert benchmarks.value(RESULTS, "Few", ["fox", "ours"], "paper: V / ours", 1) == "**2**"
    assert benchmarks.value(RESULTS, "Many", ["fox"], "PSNR") == "7"
    for section, row, column in (("Few", ["fox"], "PSNR"), ("Many", ["fox"], "SSIM"), ("None", ["fox"], "PSNR")):
        with pytest.raises(LookupError, match=f"{section}: (2|0|no) cells fox, {column}"):
            benchmarks.value(RESULTS, section, row, column)


@pytest.mark.parametrize("page", benchmarks.PAGES)
def test_tables_beside_peers_are_those_of_results(page: str) -> None:
    """As `python -m docs.pages.benchmarks` writes them: another number among the results is another one on the page."""
    text, results = ((ROOT / name).read_text(encoding="utf-8") for name in (page, "research/results.md"))
    assert benchmarks.filled(text, results) == text
    marked = re.sub(r"<!-- table.*?<!-- end of table -->", "", text, flags=re.DOTALL)
    assert not re.search(r"^\|", marked, re.MULTILINE)  # no table is written by hand
    assert benchmarks.filled(text, results.replace("32.76", "12.34")) == text.replace("32.76", "12.34") != text
