"""The commands that take a trained soup: `etsplat eval`, `etsplat render`, `etsplat export` and `etsplat view`."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro

from etsplat.cli.command import Command, Flag
from etsplat.core.errors import InputError
from etsplat.io.writers import purposes
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.settings import Device, OneOf, engine_names

if TYPE_CHECKING:
    from rich.console import Console

    from etsplat.tasks.opened_runs import SoupRun
    from etsplat.tasks.soup_selection import Crop

AnySettings = TypeVar("AnySettings")
Unnamed = Annotated[AnySettings, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]

_COLUMNS = {
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "ssim_interior": ("SSIM interior", ".4f"),
    "flip": ("FLIP", ".4f"),
    "lpips_3dgs": ("LPIPS as 3DGS", ".4f"),
    "lpips": ("LPIPS", ".4f"),
    "psnr_asset": ("PSNR, opaque mesh", ".2f"),
    "psnr_opaque": ("PSNR, soup opaque", ".2f"),
    "psnr_affine": ("PSNR, colours fitted", ".2f"),
    "psnr_aligned": ("PSNR, poses fitted", ".2f"),
}

PURPOSES = {
    **purposes(),
    "etz": "To send: small, soft, for etsplat and for what reads docs/compact_format.md.",
    "html": "To send: a page that shows the scene, soft or opaque, in browsers with WebGL 2, without a network.",
    "safetensors": "For etsplat.",
}
if TYPE_CHECKING:
    Kind = str | None
else:
    Kind = Literal[(*PURPOSES, None)]  # within: of a union tyro's errors would list them in another order each time
_FORMAT = "\n".join(
    [
        "Kind of file; by default what --out ends in, or glb. Of a reconstruction glb, obj, ply;",
        "with --texture safetensors too, for etsplat.",
        *(f"{kind}: {use}" for kind, use in PURPOSES.items()),
    ]
)


@dataclass(frozen=True, kw_only=True)
class Evaluate(Command):
    """Measure a trained soup on the views that training never saw, and how fast it is drawn.

    PSNR; SSIM zero-padded as 3DGS has it, and in the interior; FLIP; LPIPS in both conventions where its weights are.
    Beside them PSNR after a fit of the colours to each photo, which has seen what it is measured on.

    Examples:
        etsplat eval runs/kitchen
        etsplat eval runs/kitchen --lpips-weights download
        etsplat eval soup.ply --scene scenes/kitchen --out evaluation
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A run of `etsplat train`; or a file with a soup, with --scene."""
    out: Path | None = None
    """Folder for evaluation.json and pictures side by side; by default the run's, whose report is written anew."""
    scene: Path | None = None
    """The capture's folder, if it has moved or a file is given; another one of the same place wants --out."""
    device: Device | None = None
    """Where it is drawn: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    lpips_weights: Path | None = None
    """File with LPIPS's weights, or `download`; by default torch's cache is looked into."""

    def run(self, arguments: Sequence[str]) -> int:
        """Measures, writes evaluation.json, pictures and report, prints a table."""
        from rich.console import Console

        from etsplat.cli.progress import PhaseBar
        from etsplat.io.run_directory import RunDirectory, is_run
        from etsplat.report import write_report
        from etsplat.tasks.opened_runs import open_run
        from etsplat.tasks.scoring import evaluate_run

        opened = open_run(self.run_dir, self.scene, self.device)
        if opened.other_scene and self.out is None:
            raise InputError(
                f"{self.scene}: is not the scene that {self.run_dir} was trained on, by the names and poses of its "
                "photos; name a folder for what is measured on it with --out, or leave out --scene"
            )
        _say_of(opened, None)
        folder = RunDirectory(self.out or opened.folder)
        console = Console()
        with PhaseBar(console) as bar:
            found = evaluate_run(
                opened,
                lpips_weights=self.lpips_weights,
                pictures=folder.path / "evaluation",
                progress=lambda done, total: bar.show("Measuring", done, total),
            )
        folder.write_evaluation(found)
        _print(console, found)
        print(f"{folder.evaluation_path}; pictures in {folder.path / 'evaluation'}")
        if is_run(folder.path) and folder.metrics_path.is_file():
            print(write_report(folder.path))
        return 0


def _print(console: "Console", found: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table("view", box=None)
    shown = {key: column for key, column in _COLUMNS.items() if found.get(key) is not None}
    for title, _ in shown.values():
        table.add_column(title, justify="right")
    for row in [*found["views"], {**found, "name": "mean"}]:
        table.add_row(row["name"], *(f"{row[key]:{form}}" for key, (_, form) in shown.items()))
    console.print(table)
    if found["lpips"] is None and found["lpips_reason"]:
        console.print(f"LPIPS: {found['lpips_reason']}", soft_wrap=True)
    if found["other_scene"]:
        console.print("Measured on another scene than the run was trained on.", soft_wrap=True)
    threads = "1 thread" if found["threads"] == 1 else f"{found['threads']} threads"
    console.print(
        f"{found['fps']:.1f} frames/s at {found['width']}x{found['height']}, {found['ms_per_million']:.0f} ms per "
        f"million triangles ({found['triangles']:,} triangles, engine {found['engine']}, {threads})"
    )


def _say_of(opened: "SoupRun", scene: Path | None) -> None:
    """What of a file is otherwise, and that cameras are those of another scene, on purpose or by a mistyped name."""
    for note in opened.notes:
        print(f"  {note}", flush=True)
    if opened.other_scene and scene is not None:
        print(f"  {scene} is another scene than the run was trained on: cameras are those of its photos", flush=True)


def _crop(text: str | None) -> "Crop | None":
    """What --crop says."""
    from etsplat.geometry.regions import region_of

    if text is None or text == "auto":
        return text
    return region_of(text, "--crop")


@dataclass(frozen=True, kw_only=True)
class Render(Command):
    """Draw a trained soup: its test views, or a path through the scene as a video.

    Examples:
        etsplat render runs/kitchen
        etsplat render runs/kitchen --path photos
        etsplat render runs/kitchen --path orbit --frames 240
        etsplat render runs/kitchen --path ellipse --opaque --depth --normals
        etsplat render runs/kitchen --path orbit --opaque --no-sky --crop auto --clean
        etsplat render soup.ply --scene scenes/kitchen --path interpolated --format frames
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A run of `etsplat train`; or a file with a soup, with --scene."""
    out: Path | None = None
    """Folder for the pictures; by default renders/ in the run's folder."""
    scene: Path | None = None
    """The capture's folder, if it has moved or a file is given."""
    device: Device | None = None
    """Where it is drawn: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    engine: Annotated[str | None, OneOf(engine_names)] = None
    """What draws: cpu, cuda, webgpu (GPUs of AMD, Intel, Apple, NVIDIA), reference, or None for the device's own."""
    crop: str | None = None
    """Draw only triangles whose middle is in a region, in the capture's own units and axes.
    sphere:X,Y,Z,R: a ball by its middle and radius; box:X0,Y0,Z0,X1,Y1,Z1: a box by two corners;
    auto: the ball around what the photos look at."""
    settings: Unnamed[RenderConfig] = field(default_factory=RenderConfig)

    def run(self, arguments: Sequence[str]) -> int:
        """Draws, and says where the pictures are."""
        from etsplat.cli.progress import PhaseBar
        from etsplat.tasks.opened_runs import open_run
        from etsplat.tasks.render_soup import render_run

        crop = _crop(self.crop)
        opened = open_run(self.run_dir, self.scene, self.device, self.engine)
        _say_of(opened, self.scene)
        out = self.out or opened.folder / "renders"
        with PhaseBar() as bar:
            files = render_run(
                opened,
                out,
                self.settings,
                crop=crop,
                progress=lambda done, total: bar.show("Drawing", done, total),
                tell=lambda text: print(f"  {text}", flush=True),
            )
        print(f"{len(files)} files in {out}" if len(files) != 1 else files[0])
        return 0


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a trained soup or a reconstructed mesh for Blender, game engines or the web.

    It also turns another program's file into a soup.

    Examples:
        etsplat export runs/bunny --texture 2048 --faces 10000 --lods 3
        etsplat export runs/kitchen
        etsplat export runs/kitchen --format html
        etsplat export runs/kitchen --no-sky --crop auto --clean --place ground
        etsplat export runs/kitchen --crop sphere:0.2,-1,3.5,2 --up z --scale 0.01 --out kitchen.ply
        etsplat export runs/kitchen --format ply --colors keep --min-opacity 0 --up keep
        etsplat export point_cloud_state_dict.pt --format safetensors
    """

    run_dir: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A run of `etsplat train` or `etsplat reconstruct`;
    or a file: .safetensors, .etz, .pt of Triangle Splatting, Gaussian .ply, or a mesh."""
    format: Annotated[Kind, tyro.conf.arg(help=_FORMAT)] = None
    out: Path | None = None
    """The file to write; by default soup.FORMAT in the run's folder, or exported.safetensors;
    of a reconstruction textured.FORMAT, light.FORMAT with --faces alone, exported.FORMAT with neither."""
    scene: Path | None = None
    """The capture's folder, if it has moved or a file is given: for colours as the cameras saw them, and for up."""
    device: Device | None = None
    """Where it is drawn: cpu, cuda (an NVIDIA GPU), or None for cuda where there is one."""
    crop: str | None = None
    """Write only triangles whose middle is in a region, in the capture's own units and axes.
    sphere:X,Y,Z,R: a ball by its middle and radius; box:X0,Y0,Z0,X1,Y1,Z1: a box by two corners;
    auto: the ball around what the photos look at."""
    settings: Unnamed[ExportConfig] = field(default_factory=ExportConfig)

    def run(self, arguments: Sequence[str]) -> int:
        """Writes the file and says what is in it."""
        from etsplat.tasks.export_mesh import is_reconstruction
        from etsplat.tasks.export_soup import checked_for_soups, export_soup, why_soup
        from etsplat.tasks.opened_runs import check_not_read, open_run
        from etsplat.tasks.soup_selection import faint_remedy, in_words

        if is_reconstruction(self.run_dir):
            return self._export_mesh()
        for name in ("texture", "faces"):  # and --lods wants --texture
            if getattr(self.settings, name) is not None:
                raise InputError(f"--{name}: is for runs of `etsplat reconstruct`; leave it out for soups")
        crop = _crop(self.crop)
        folder = self.run_dir if self.run_dir.is_dir() else self.run_dir.parent
        out = self._out(folder, "exported" if self.format == "safetensors" else "soup")  # which a run's is
        check_not_read(out, self.run_dir, "--out ")
        if self.run_dir.exists():
            checked_for_soups(out, self.settings)  # rather than after it has been read
        opened = open_run(self.run_dir, self.scene, self.device)
        written = export_soup(opened, out, self.settings, crop)
        sky = f", {written.sky:,} of them in the object sky" if written.sky else ""
        print(f"{written.path}: {written.triangles:,} triangles{sky}")
        if written.removed:
            print(f"Left out: {in_words(written.removed)}.")
        for note in written.notes:
            print(f"  {note}")
        if opened.solid is not None and (why := why_soup(out, self.settings)):
            print(f"It is the soup, not the run's opaque mesh ({why}).")
        if written.dropped > written.triangles:
            print(f"Most of it is too faint; {faint_remedy(opened)}.")
        return 0

    def _out(self, folder: Path, name: str) -> Path:
        """The file to write."""
        from etsplat.io.paths import kind_of

        out = self.out or folder / f"{name}.{self.format or 'glb'}"
        kinds = [self.format] if self.format else list(PURPOSES)
        if kind_of(out).removeprefix(".") not in kinds:
            raise InputError(f"--out {out}: does not end in .{' or .'.join(kinds)}; rename it or change --format")
        return out

    def _export_mesh(self) -> int:
        from etsplat.cli.progress import PhaseBar
        from etsplat.tasks.export_mesh import export_mesh
        from etsplat.tasks.opened_runs import check_not_read

        if self.crop is not None:
            raise InputError("--crop: is for soups; leave it out for the mesh of a reconstruction")
        name = "textured" if self.settings.texture else "light" if self.settings.faces else "exported"
        out = self._out(self.run_dir, name)
        check_not_read(out, self.run_dir, "--out ")
        notes: list[str] = []
        with PhaseBar() as bar:
            written = export_mesh(self.run_dir, out, self.settings, self.scene, self.device, bar.show, notes.append)
        for path, faces in written.items():
            print(f"{path}: {faces:,} faces, {path.stat().st_size / 1e6:.2f} MB")
        for note in notes:
            print(f"  {note}")
        return 0


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Look around in a trained soup with a web browser; follows a run that is still going on.

    Needs viser: pip install 'etsplat[viewer]'.

    Examples:
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
    engine: Annotated[str | None, OneOf(engine_names)] = None
    """What draws: cpu, cuda, webgpu (GPUs of AMD, Intel, Apple, NVIDIA), reference, or None for the device's own."""
    host: str = "localhost"
    """Address to listen on; 0.0.0.0 lets other machines look too."""
    port: int = 8080
    """Port to listen on; the next free one if it is in use."""
    width: int = 960
    """Width of the picture when the camera stands still."""

    def run(self, arguments: Sequence[str]) -> int:
        """Serves until Ctrl-C."""
        for name, value, low, high in (("width", self.width, 16, 8192), ("port", self.port, 0, 65535)):
            if not low <= value <= high:
                raise InputError(f"{name}: is {value}; it must be between {low} and {high}")
        from etsplat.io.paths import path_remedy
        from etsplat.tasks.opened_runs import open_run
        from etsplat.viewer.follow import wait_for_soup
        from etsplat.viewer.server import serve

        if not self.run_dir.exists() and not self.wait:
            remedy = f"{path_remedy(self.run_dir)} (or --wait for a run to begin there)"
            raise InputError(f"{self.run_dir}: no such file or folder; {remedy}")
        with contextlib.suppress(KeyboardInterrupt):
            if not self.run_dir.is_file():
                wait_for_soup(self.run_dir, lambda text: print(f"{text} (Ctrl-C ends it)", flush=True))
            opened = open_run(self.run_dir, self.scene, self.device, self.engine)
            _say_of(opened, self.scene)
            if opened.gone is not None:
                print(f"  its scene {opened.gone} has gone: shown without its photos (--scene names it)", flush=True)
            serve(
                opened,
                self.host,
                self.port,
                self.width,
                lambda port: print(f"http://{self.host}:{port}  (Ctrl-C ends it)", flush=True),
            )
        return 0
