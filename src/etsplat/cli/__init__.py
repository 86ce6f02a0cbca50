"""The `etsplat` command: options, progress, errors in one line."""

from etsplat.cli.main import main as main
