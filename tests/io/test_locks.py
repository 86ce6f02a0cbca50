"""A run has one writer, for as long as that lives."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from etsplat.core.errors import InputError
from etsplat.io import locks
from etsplat.io.locks import check_nobody_writes, writing_run
from etsplat.io.run_directory import RunDirectory, is_run

pytest.importorskip("fcntl")

HOLDER = """
import os, sys, time
from pathlib import Path
from etsplat.io.locks import writing_run
with writing_run(Path(sys.argv[1]), print):
    if os.fork() == 0:  # a child that outlives its parent holds nothing, from when it runs at all
        print("holds", flush=True)
    time.sleep(60)
    os._exit(0)
"""


def never(text):
    raise AssertionError(text)


def test_a_second_writer_is_told_who_the_first_is(tmp_path):
    with writing_run(tmp_path / "run", never):
        for attempt in (
            lambda: writing_run(tmp_path / "run", never).__enter__(),
            lambda: check_nobody_writes(tmp_path / "run"),
        ):
            with pytest.raises(InputError, match=rf"run: process {os.getpid()} on .* is writing this run; wait"):
                attempt()
        assert os.listdir(tmp_path / "run") == [".lock"]
    assert os.listdir(tmp_path / "run") == []
    check_nobody_writes(tmp_path / "run")
    check_nobody_writes(tmp_path / "absent")
    with writing_run(tmp_path / "run", never):
        pass


def test_the_lock_of_a_killed_process_is_gone_and_its_folder_still_free(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == "holds\n"
            with pytest.raises(InputError, match=f"process {holder.pid} on "):
                check_nobody_writes(tmp_path)
            holder.kill()
            holder.wait()
            assert os.listdir(tmp_path) == [".lock"]
            check_nobody_writes(tmp_path)
            with writing_run(tmp_path, never):
                RunDirectory.create(tmp_path, {"task": "train", "config": {}})
        finally:
            os.killpg(holder.pid, signal.SIGKILL)
    assert is_run(tmp_path)
    assert not (tmp_path / ".lock").exists()


def test_a_lock_that_its_holder_removes_meanwhile_is_taken_anew(tmp_path, monkeypatch):
    """Otherwise a third would find no file, make one, and write too."""
    lock, opened = locks.lock_file, []

    def late(file):
        opened.append(file)
        if len(opened) == 1:
            (tmp_path / ".lock").unlink()
        lock(file)

    monkeypatch.setattr(locks, "lock_file", late)
    with writing_run(tmp_path, never):
        assert len(opened) == 2
        with pytest.raises(InputError, match="is writing this run"):
            check_nobody_writes(tmp_path)


def test_without_locks_the_run_goes_on_and_says_so(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", refuse)
    told = []
    with writing_run(tmp_path, told.append):
        check_nobody_writes(tmp_path)
    assert "there are no file locks here" in told[0]
    assert len(told) == 1
    assert os.listdir(tmp_path) == []
