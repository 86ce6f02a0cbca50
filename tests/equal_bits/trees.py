"""The two trees: a copy of this one, and BASE in a git work tree with a native build of its own."""

import hashlib
import importlib.util
import json
import os
import platform
import queue
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

from .runner import Job

ROOT = Path(__file__).resolve().parents[2]
RUNNER = Path(__file__).with_name("runner.py")

PINNED = {
    "ETSPLAT_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_CBWR": "COMPATIBLE",
    "ATEN_CPU_CAPABILITY": "avx2" if platform.machine() in ("x86_64", "AMD64") else "default",
    "CUDA_VISIBLE_DEVICES": "",
    "PYTHONHASHSEED": "0",
    "PYTHONSAFEPATH": "1",
    "NO_COLOR": "1",
}


class Tree:
    """One of the two.

    Attributes:
        package: folder of the package that runs.
    """

    def __init__(self, package: Path, path: str) -> None:
        """Starts nothing yet; `path` is PYTHONPATH. `python -S` leaves out the editable install of this tree."""
        self.package = package
        self._command = [sys.executable, "-S", str(RUNNER), str(package)]
        self._environment = {**os.environ, **PINNED, "PYTHONPATH": path}
        self._idle: queue.SimpleQueue[subprocess.Popen[str]] = queue.SimpleQueue()

    def run(self, job: Job, instruction_set: str) -> int:
        """Runs a command line as `runner` says; returns the exit status. May be called from several threads."""
        try:
            process = self._idle.get_nowait()
        except queue.Empty:
            command = [*self._command, instruction_set]
            pipe = subprocess.PIPE
            process = subprocess.Popen(command, env=self._environment, stdin=pipe, stdout=pipe, text=True)
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(job) + "\n")
        process.stdin.flush()
        answer = process.stdout.readline()
        if not answer:
            raise RuntimeError(f"the runner of {self.package} ended with status {process.wait()}")
        self._idle.put(process)
        return int(answer)


def this_tree(folder: Path) -> Tree:
    """The tree that this file is in, with the native build that is installed; copied, so that it may be worked on."""
    from etsplat import _native

    shutil.copytree(ROOT / "src" / "etsplat", folder / "etsplat")
    shutil.copytree(ROOT / "csrc", folder / "etsplat" / "csrc")  # where a wheel has it
    shutil.copy(_native.__file__, folder / "etsplat")
    return _tree(folder)


def base_tree(commit: str, folder: Path) -> Tree:
    """The tree of a commit; checked out and built in `folder` at the first call.

    Its package alone is installed there; the interpreter's other packages are used.
    """
    with locked(folder):
        if not (folder / "site").is_dir():
            _build(commit, folder)
    return _tree(folder / "site")


def names_of(folder: Path) -> ModuleType | None:
    """The `names` of the tree that `base_tree` built in a folder; None of one from before there were any."""
    path = folder / "tree" / "tests" / "equal_bits" / "names.py"
    if not path.is_file():
        return None
    spec = importlib.util.spec_from_file_location("names_of_base", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # dataclasses look for it there
    spec.loader.exec_module(module)
    return module


def resolve_commit(name: str) -> str:
    """The full hash of a commit that exists; ends the process for any other."""
    found = subprocess.run(
        ["git", "rev-parse", "--verify", "--quiet", f"{name}^{{commit}}"], cwd=ROOT, capture_output=True, text=True
    )
    if found.returncode:
        sys.exit(f"equal-bits: {name} is no commit of this repository; give one with BASE=")
    return found.stdout.strip()


def machine() -> tuple[str, str]:
    """(the engine's instruction set to pin, a short hash of all that bits depend on beside the trees)."""
    from etsplat import _native

    instruction_set = _native.available_instruction_sets()[0]
    packages = {name: version(name) for name in ("torch", "numpy", "scipy", "pillow", "trimesh")}
    about = [platform.machine(), _processor(), instruction_set, PINNED, sys.version, packages]
    return instruction_set, digest(about)


def digest(value: object) -> str:
    """A short hash."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:12]


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """One process at a time."""
    import fcntl  # not everywhere, and the tests of the comparison do without

    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _build(commit: str, folder: Path) -> None:
    print(f"equal-bits: building {commit[:12]} in {folder} (once)", flush=True)
    tree, draft = folder / "tree", folder / "site.draft"
    shutil.rmtree(draft, ignore_errors=True)
    shutil.rmtree(tree, ignore_errors=True)
    subprocess.run(["git", "worktree", "prune"], cwd=ROOT, check=True)
    subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(tree), commit], cwd=ROOT, check=True)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-build-isolation"]
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(
        [*pip, "--no-deps", "--target", str(draft), str(tree)],
        cwd=folder,
        env={**os.environ, "PATH": tools},
        check=True,
    )
    draft.rename(folder / "site")


def _tree(site: Path) -> Tree:
    return Tree(site / "etsplat", os.pathsep.join([str(site), *_sites()]))


def _sites() -> list[str]:
    """Folders of packages that the interpreter has, without those that editable installs of this tree add."""
    sites = [sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), *sys.path]
    return list(dict.fromkeys(path for path in sites if Path(path).name in ("site-packages", "dist-packages")))


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith("model name")), platform.processor())
