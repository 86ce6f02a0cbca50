"""`etsplat view`."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from etsplat.cli.command import Command, Flag
from etsplat.core.errors import InputError
from etsplat.tasks.settings import Device


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Look around in a trained soup with a web browser; follows a run that is still going on.

    Needs viser: pip install 'etsplat[viewer]'.
    """

    EXAMPLES: ClassVar[str] = """
    etsplat view runs/kitchen
    etsplat view runs/kitchen --port 9000 --width 1600
    etsplat view runs/garden --wait
    etsplat view point_cloud_state_dict.pt --scene scenes/kitchen
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A run of `etsplat train`, finished or in progress; an empty folder in which one is to begin; or a file."""
    wait: Flag = False
    """Wait for the run to begin, if its folder is not there yet."""
    scene: Path | None = None
    """The capture's folder, if it has moved or a file is given: for its cameras."""
    device: Device | None = None
    """Where it is drawn: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    host: str = "localhost"
    """Address to listen on; 0.0.0.0 lets other machines look too."""
    port: int = 8080
    """Port to listen on; the next free one if it is in use."""
    width: int = 960
    """Width of the picture when the camera stands still."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "View":
        """Nothing depends on the arguments."""
        return cls(run_dir=tyro.MISSING)

    def run(self, arguments: Sequence[str]) -> int:
        """Serves until Ctrl-C."""
        for name, value, low, high in (("width", self.width, 16, 8192), ("port", self.port, 0, 65535)):
            if not low <= value <= high:
                raise InputError(f"{name}: is {value}; it must be between {low} and {high}")
        from etsplat.io.paths import path_remedy
        from etsplat.tasks.soup_run import open_run
        from etsplat.viewer.follow import wait_for_soup
        from etsplat.viewer.server import serve

        if not self.run_dir.exists() and not self.wait:
            remedy = f"{path_remedy(self.run_dir)} (or --wait for a run to begin there)"
            raise InputError(f"{self.run_dir}: no such file or folder; {remedy}")
        with contextlib.suppress(KeyboardInterrupt):
            if not self.run_dir.is_file():
                wait_for_soup(self.run_dir, lambda text: print(f"{text} (Ctrl-C ends it)", flush=True))
            opened = open_run(self.run_dir, self.scene, self.device)
            serve(
                opened,
                self.host,
                self.port,
                self.width,
                lambda port: print(f"http://{self.host}:{port}  (Ctrl-C ends it)", flush=True),
            )
        return 0
