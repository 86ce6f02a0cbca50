"""A grid of soups: scenes by methods, by culling of small triangles, by settings; and what is measured of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.io.run_directory import RunDirectory
from etsplat.tasks.demos import DEMO_SCENE
from etsplat.tasks.train_config import SCENE_TYPES, TrainConfig
from studies.grid.cells import Cell
from studies.peers.settings import PEERS, Peer, PeerConfig, load_gsplat, peer_config
from studies.scenes.paper import SCENES

STUDIED = {"watch": 0, "asset": False}
"""Published numbers are of soups, trained on all training photos; a setting may say otherwise."""

CULLED = "culling"
"""What is added to the name of a method whose small triangles are culled."""

METRICS = (
    "psnr",
    "ssim",
    "ssim_interior",
    "flip",
    "lpips_3dgs",
    "lpips",
    "psnr_opaque",
    "ssim_opaque",
    "fps",
    "ms_per_million",
)


@dataclass(frozen=True)
class Scene:
    """A scene of the grid.

    Attributes:
        folder: its photos and cameras, or "demo:scene"; the folder's name is the scene's.
        scene_type: outdoor, indoor or object; None for the paper's where it is one of the paper's, else outdoor.
        setting: changes for this scene alone, such as "background=white".
    """

    folder: Path
    scene_type: str | None
    setting: str

    @property
    def name(self) -> str:
        """Of its rows and folders."""
        return "demo" if self.folder == Path(DEMO_SCENE) else self.folder.resolve().name


def read_scene_argument(text: str) -> Scene:
    """A scene as it is given on the command line: FOLDER, FOLDER:indoor, or FOLDER:object,background=white.

    Raises:
        InputError: there is no such folder.
    """
    folder, colon, rest = text.rpartition(":")
    scene_type, _, setting = rest.partition(",")
    if colon and scene_type in SCENE_TYPES:
        scene = Scene(Path(folder), scene_type, setting)
    else:
        scene = Scene(Path(text), None, "")
    if not scene.folder.is_dir() and scene.folder != Path(DEMO_SCENE):
        raise InputError(
            f"scene {scene.folder}: no such folder; fetch it with `etsplat data download`, or check the path; its kind "
            f"comes after a colon: one of {', '.join(SCENE_TYPES)}"
        )
    return scene


def make_nvs_cells(
    scenes: Sequence[Scene],
    methods: Sequence[str],
    out: Path,
    *,
    preset: str,
    culling: Sequence[bool],
    setting: str,
    settings: Sequence[str] = ("",),
    seeds: Sequence[int] = (0,),
) -> list[Cell]:
    """All runs, scene by scene; those that are finished are "done".

    With preset "paper", scenes of the paper's tables get Triangle Splatting's settings for them: kind of scene, folder
    of photos and number of triangles.

    Args:
        scenes: what is trained on.
        methods: as `TrainConfig.method`; or 3dgs and 2dgs, which have nothing to cull.
        out: folder; runs are in OUT/runs/SCENE/VARIANT.
        preset: of all runs.
        culling: whether small triangles are culled; one or both.
        setting: changes for all runs, such as "iterations=1000,width=400".
        settings: what is compared: changes on top of that, each by every one of our methods.
        seeds: each run is repeated with each of them.

    Raises:
        InputError: two scenes or settings have the same name, a change is none, or peers are asked for and cannot run
            here.
    """
    for repeated in (text for text in settings if settings.count(text) > 1):
        raise InputError(f"settings: {repeated!r} is named twice; leave one out")
    names = [scene.name for scene in scenes]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"scenes: two are named {name}; rename a folder")
    peers: list[Peer] = [peer for peer in PEERS if peer in methods]
    if peers:
        load_gsplat()
    cells = []
    for scene, name in zip(scenes, names, strict=True):
        base, images = _settings(scene, preset)
        base = base.changed({**base.read_changes(setting), **base.read_changes(scene.setting)})
        variants: dict[str, TrainConfig | PeerConfig] = {
            " ".join(filter(None, (text, method, CULLED if culled else ""))): base.changed(
                {"method": method, "drawing.cull_small": culled, **base.read_changes(text)}
            )
            for text in settings
            for culled in culling
            for method in methods
            if method not in PEERS
        }
        variants |= {str(peer): _peer(peer, base) for peer in peers}
        for seed, (variant, config) in product(seeds, variants.items()):
            folder = out / "runs" / name / (variant if len(seeds) == 1 else f"{variant} seed {seed}")
            cell = Cell(name, scene.folder, variant, replace(config, seed=seed), folder, images=images)
            cell.look()
            cells.append(cell)
    return cells


def evaluate_cells(
    cells: Sequence[Cell], lpips_weights: Path | None, progress: Callable[[int, int], None]
) -> list[dict[str, Any]]:
    """Measures every finished run that has not been measured yet, one after the other; returns a row for each.

    Speed is measured here, with nothing else running, and not while the grid runs.
    """
    from etsplat.tasks.opened_runs import open_run
    from etsplat.tasks.scoring import evaluate_run
    from studies.peers.training import evaluate_peer

    done, rows = [cell for cell in cells if cell.state == "done"], []
    for index, cell in enumerate(done):
        run = RunDirectory(cell.folder)
        if not run.evaluation_path.is_file():
            if isinstance(cell.config, PeerConfig):
                found = evaluate_peer(cell.folder, cell.config, lpips_weights)
            else:
                found = evaluate_run(open_run(cell.folder), lpips_weights=lpips_weights)
            run.write_evaluation(found)
        progress(index + 1, len(done))
        metrics, evaluation = run.read_metrics(), run.read_evaluation()
        rows.append(
            {
                "scene": cell.object,
                "variant": cell.variant,
                "seed": cell.seed,
                **{name: evaluation[name] for name in METRICS},
                "triangles": metrics["triangles"],
                "iterations": metrics["iterations"],
                "minutes": metrics["seconds"] / 60,
                "width": evaluation["width"],
                "height": evaluation["height"],
            }
        )
    return rows


def _settings(scene: Scene, preset: str) -> tuple[TrainConfig, str | None]:
    known = SCENES.get(scene.name) if preset == "paper" else None
    if known is None or scene.scene_type is not None:
        return TrainConfig.of(preset, scene.scene_type or "outdoor").changed(STUDIED), None
    config = replace(TrainConfig.of(preset, known.scene_type).changed(STUDIED), max_triangles=known.max_triangles)
    return config, known.images if (scene.folder / known.images).is_dir() else None


def _peer(peer: Peer, base: TrainConfig) -> PeerConfig:
    """The peer at the iterations and image size of our runs; without normals on objects, as in the script of 2DGS."""
    changes = {"lambda_normal": 0.0} if base.scene_type == "object" else {}
    return peer_config(
        peer,
        iterations=base.iterations,
        max_epochs=base.schedule.max_epochs,
        schedule_length=base.schedule.length,
        width=base.width,
        background="white" if base.background == "white" else "black",
        seed=base.seed,
        **changes,
    )
