"""Renders the conda recipe for every platform and compares it with the installed package; `make lint` runs it."""

import re
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

from rattler_build import PlatformConfig, RenderConfig, Stage0Recipe, VariantConfig

ROOT = Path(__file__).resolve().parent.parent
PLATFORMS = ("linux-64", "linux-aarch64", "osx-arm64", "win-64")
NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
"""What conda-forge calls otherwise."""

LEFT_OUT = ("nanobind-backend",)
"""What the recipe's build does without."""


def bounds(requirements: Iterable[str]) -> dict[str, str]:
    """Lower bounds by name, of requirements of either kind."""
    pairs = (re.match(r"([\w-]+) *(?:>=([\d.]+))?", requirement) for requirement in requirements)
    return {pair[1]: pair[2] or "" for pair in pairs if pair}


def differences() -> list[str]:
    """A line for each thing that the recipe says otherwise than the package."""
    needed = [line for line in metadata.requires("etsplat") or () if "extra ==" not in line]
    wanted = {NAMES.get(name, name): bound for name, bound in bounds(needed).items() if name not in LEFT_OUT}
    wanted |= {"python": metadata.metadata("etsplat")["Requires-Python"].removeprefix(">=")}
    recipe = Stage0Recipe.from_file(ROOT / "release" / "conda" / "recipe.yaml")
    variants = VariantConfig({"cxx_compiler": ["cxx"], "c_stdlib": ["stdlib"]})
    lines = []
    for platform in PLATFORMS:
        there = PlatformConfig(target_platform=platform, host_platform=platform, build_platform=platform)
        for rendered in recipe.render(variants, RenderConfig(platform=there)):
            version, found = rendered.recipe.package.version, bounds(map(str, rendered.recipe.requirements.run))
            if version != metadata.version("etsplat"):
                lines.append(f"{platform}: version {version} instead of {metadata.version('etsplat')}")
            for name in sorted(wanted.keys() | found):
                if wanted.get(name) != found.get(name):
                    lines.append(f"{platform}: {name} {found.get(name)} instead of {wanted.get(name)}")
    return lines


if __name__ == "__main__":
    sys.exit("\n".join(differences()) or None)
