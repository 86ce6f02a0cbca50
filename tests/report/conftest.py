"""A finished run for the tests of the report."""

from pathlib import Path

import pytest

from tests.helpers.finished_runs import write_run


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run")
