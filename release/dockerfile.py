"""Runs the Dockerfile where there is no Docker: each stage in a Debian that debootstrap makes, as root.

python release/dockerfile.py FOLDER [ARG=VALUE ...] [--bind PATH ...]

The lines are those of the file. In the place of the image that a stage begins with is the Debian it is named after,
with the Python that runs this in /usr/local. Network, certificates and pip's settings are this machine's; --bind shows
a stage more of it, such as a folder of wheels that those settings name. At the end the image's user runs its entry
point: help, doctor and the tiny demo, in a folder that lies at the image's working directory.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LIBRARIES = "libbz2-1.0,libffi8,liblzma5,libncursesw6,libreadline8,libsqlite3-0,libssl3,libuuid1,zlib1g"
"""What Python's own modules ask for, on Debian 12."""
PACKAGES = f"ca-certificates,netbase,tzdata,{LIBRARIES}"
OF_THIS_MACHINE = ("/etc/resolv.conf", "/etc/hosts", "/etc/pip.conf", "/etc/ssl/certs")
PATH = "/usr/local/bin:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin"


@dataclass
class Stage:
    """A file system, and how commands are run in it."""

    root: Path
    variables: dict[str, str] = field(default_factory=dict)
    shell: list[str] = field(default_factory=lambda: ["/bin/sh", "-c"])
    folder: str = "/"
    user: int = 0
    entry: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)

    def path(self, name: str) -> Path:
        """Where a name of the file's lies here; relative ones begin at the working directory."""
        return self.root / os.path.join(self.folder, name).lstrip("/")

    def run(self, command: Sequence[str], binds: Mapping[Path, str]) -> None:
        """Runs a command; its mounts are its own, and gone with it.

        Raises:
            SystemExit: it failed.
        """
        lines = []
        mounts = {Path("/dev/shm"): "/dev/shm", **binds}
        for path, place in mounts.items():
            target = self.root / place.lstrip("/")
            target.parent.mkdir(parents=True, exist_ok=True)
            target.mkdir(exist_ok=True) if path.is_dir() else target.touch()
            lines.append(f"mount --bind {shlex.quote(str(path))} {shlex.quote(str(target))}")
        lines.append(f"mount -t proc proc {shlex.quote(str(self.root / 'proc'))}")
        group, home = self._account()
        inherited = {name: value for name, value in os.environ.items() if re.fullmatch(r"PIP_\w+|\w+_proxy", name)}
        variables = {"PATH": PATH, "HOME": home, **inherited, **self.variables}
        words = ["chroot", f"--userspec={self.user}:{group}", str(self.root), "env", "-i", f"--chdir={self.folder}"]
        words += [f"{name}={value}" for name, value in variables.items()]
        lines.append("exec " + shlex.join([*words, *command]))
        print(f"{self.root.name}: {shlex.join(command)}", flush=True)
        done = subprocess.run(["unshare", "--mount", "sh", "-ec", "\n".join(lines)], check=False)
        if done.returncode != 0:
            raise SystemExit(f"{self.root.name}: ended with {done.returncode}")

    def _account(self) -> tuple[int, str]:
        """Group and home of the user, as the stage has them."""
        for line in (self.root / "etc" / "passwd").read_text(encoding="utf-8").splitlines():
            _, _, user, group, _, home, _ = line.split(":")
            if int(user) == self.user:
                return int(group), home
        return 0, "/"


def instructions(text: str) -> Iterator[tuple[str, str]]:
    """Words and what follows them, line by line; comments and broken lines are as Docker has them."""
    text = re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE)
    for line in re.sub(r"\\\n", "", text).splitlines():
        word, _, rest = line.strip().partition(" ")
        if word:
            yield word, rest.strip()


def context(root: Path) -> list[str]:
    """Files of a folder that its .dockerignore lets through."""
    lines = (root / ".dockerignore").read_text(encoding="utf-8").split()
    if any(line.startswith("!") and "/" in line for line in lines):
        raise SystemExit(".dockerignore: exceptions within folders are not known here")
    rules = [(re.compile(_pattern(line.removeprefix("!"))), line.startswith("!")) for line in lines]

    def kept(name: str) -> bool:
        found = [keeps for pattern, keeps in rules if pattern.fullmatch(name)]
        return found[-1] if found else True

    files = []
    for folder, folders, names in os.walk(root):
        within = os.path.relpath(folder, root)
        folders[:] = [name for name in folders if kept(os.path.normpath(f"{within}/{name}"))]
        files += [path for name in names if kept(path := os.path.normpath(f"{within}/{name}"))]
    return sorted(files)


def _pattern(rule: str) -> str:
    """A regular expression for what a rule names, and for all that lies within."""
    parts = {"**/": "(?:.*/)?", "*": "[^/]*"}
    return "".join(parts.get(part, re.escape(part)) for part in re.split(r"(\*\*/|\*)", rule)) + "(?:/.*)?"


def base(image: str, folder: Path) -> Path:
    """A Debian in the place of an image of Python; made once.

    Raises:
        SystemExit: the image is none of Python's slim ones.
    """
    named = re.fullmatch(r"python:([\d.]+)-slim-(\w+)", image)
    if named is None:
        raise SystemExit(f"{image}: nothing stands in for this image here")
    version = sysconfig.get_python_version()
    print(f"{image}: Debian {named[2]} with Python {version} stands in for it", flush=True)
    root = folder / f"{named[2]}-{version}"
    if root.is_dir():
        return root
    unfinished = root.with_name(root.name + ".part")
    subprocess.run(["debootstrap", "--variant=minbase", f"--include={PACKAGES}", named[2], str(unfinished)], check=True)
    library = Path(sysconfig.get_path("stdlib"))
    left_out = shutil.ignore_patterns("__pycache__", "site-packages", "test", "idle_test", "config-*", "*.a")
    shutil.copytree(library, unfinished / "usr" / "local" / "lib" / library.name, symlinks=True, ignore=left_out)
    shutil.copytree(sysconfig.get_path("include"), unfinished / "usr" / "local" / "include" / library.name)
    shutil.copy2(Path(sys.base_prefix, "bin", f"python{version}"), unfinished / "usr/local/bin/python")
    for shared in Path(sys.base_prefix, "lib").glob("libpython*.so*"):
        shutil.copy2(shared, unfinished / "usr/local/lib", follow_symlinks=False)
    Stage(unfinished).run(["sh", "-c", "ldconfig && python -m ensurepip"], {})
    return unfinished.rename(root)


def build(text: str, folder: Path, given: Mapping[str, str], binds: Mapping[Path, str]) -> list[Stage]:
    """Runs the lines of a Dockerfile and returns its stages; the last is the image.

    Raises:
        SystemExit: a line failed or is not known here, or nothing asks for a value that was given.
    """
    stages: dict[str, Stage] = {}
    asked = {rest.partition("=")[0] for word, rest in instructions(text) if word == "ARG"}
    if unknown := given.keys() - asked:
        raise SystemExit(f"the Dockerfile has no ARG {', '.join(sorted(unknown))}")
    for word, rest in instructions(text):
        if word == "FROM":
            image, _, name = rest.partition(" AS ")
            root = folder / (name or "image")
            shutil.rmtree(root, ignore_errors=True)
            subprocess.run(["cp", "-a", "--reflink=auto", str(base(image, folder)), str(root)], check=True)
            stages[root.name] = Stage(root)
            continue
        stage = list(stages.values())[-1]
        if word == "SHELL":
            stage.shell = json.loads(rest)
        elif word == "ARG":
            name, equals, value = rest.partition("=")
            if equals or name in given:
                stage.variables[name] = given.get(name, value)
        elif word == "RUN":
            stage.run([*stage.shell, rest], binds)
        elif word == "COPY":
            copy(rest.split(), stage, stages)
        elif word == "WORKDIR":
            stage.folder = rest
            stage.path("").mkdir(parents=True, exist_ok=True)
        elif word == "USER":
            stage.user = int(rest)
        elif word == "ENTRYPOINT":
            stage.entry = json.loads(rest)
        elif word == "CMD":
            stage.command = json.loads(rest)
        else:
            raise SystemExit(f"{word}: this instruction is not known here")
    return list(stages.values())


def copy(words: list[str], stage: Stage, stages: Mapping[str, Stage]) -> None:
    """COPY: a folder of another stage, or of the checkout what .dockerignore lets through: all of it, or one file."""
    if words[0].startswith("--from="):
        source = stages[words[0].removeprefix("--from=")]
        shutil.copytree(source.path(words[1]), stage.path(words[2]), dirs_exist_ok=True)
        return
    name, place = words
    files = [file for file in context(ROOT) if name in (".", file)]
    if not files:
        raise SystemExit(f"COPY {name}: .dockerignore lets no such file through")
    for file in files:
        target = stage.path(place) / file
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / file, target)
    print(f"{stage.root.name}: {len(files)} files copied", flush=True)


def megabytes(root: Path) -> int:
    """What the files of a stage take."""
    found = subprocess.run(["du", "-sxm", "--apparent-size", str(root)], capture_output=True, text=True, check=True)
    return int(found.stdout.split()[0])


def main() -> None:
    """Builds, runs the entry point as the image's user, and removes the stages, not the Debian."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("args", nargs="*", metavar="ARG=VALUE")
    parser.add_argument("--bind", nargs="+", default=[], metavar="PATH")
    options = parser.parse_args()
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    given = dict(item.split("=", 1) for item in options.args)
    binds = {Path(path): path for path in (*OF_THIS_MACHINE, *options.bind) if Path(path).exists()}
    stages = build((ROOT / "Dockerfile").read_text(encoding="utf-8"), folder, given, binds)
    image = stages[-1]
    print(f"image: {megabytes(image.root)} MB", flush=True)
    data = folder / "data"
    data.mkdir(exist_ok=True)
    os.chown(data, image.user, image.user)
    for command in (image.command, ["doctor"], ["demo", "--preset", "tiny", "--out", "demo", "--overwrite"]):
        image.run([*image.entry, *command], {data: image.folder})
    for stage in stages:
        shutil.rmtree(stage.root)
    print(f"image: demo/report.html has {(data / 'demo' / 'report.html').stat().st_size} bytes")


if __name__ == "__main__":
    main()
