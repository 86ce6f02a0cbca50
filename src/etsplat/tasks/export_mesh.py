"""The mesh of a reconstruction as a file for other programs: as it is, with fewer faces, or light under a texture."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.precision import usual_defaults
from etsplat.core.spelling import either, file_kind, option
from etsplat.data.dataset import Dataset
from etsplat.data.where_up import told_up, up_of
from etsplat.engines.choice import resolve_device
from etsplat.engines.threads import one_torch_thread
from etsplat.geometry.decimation import decimated
from etsplat.geometry.similarity import Similarity
from etsplat.io.georeference import GEOREFERENCE_FILE, Georeference
from etsplat.io.mesh_files import MeshFile, load_mesh, save_mesh
from etsplat.io.meshopt import load_meshopt
from etsplat.io.paths import given_path, kind_of
from etsplat.io.run_directory import RunDirectory, is_run
from etsplat.io.writers import suffixes
from etsplat.model.textured_mesh import TexturedMesh
from etsplat.tasks.demos import DEMO_OBJECT
from etsplat.tasks.export_config import LIGHT_FACES, ExportConfig, texture_problem
from etsplat.tasks.normal_map import normal_map_of
from etsplat.tasks.opened_runs import capture_at, read_record
from etsplat.tasks.placing import apart_from_world, check_placed, leave_unplaced, placed_record, placement
from etsplat.tasks.reconstruct_config import Pictures, ReconstructConfig
from etsplat.tasks.refined_cameras import refined_capture
from etsplat.tasks.running import Result
from etsplat.tasks.settings import settings_of
from etsplat.tasks.sources import Source, directions_digest, fingerprint, load_source, make_subject
from etsplat.tasks.texturing import Tell, check_installed, coarser, colors_at, texture_object

Note = Callable[[str], None]

_OF_MESHES = ("texture", "faces", "normals", "occlusion", "lods", "compress", "pictures", "up", "scale", "place")
"""Settings that meshes of reconstructions know."""


@dataclass(frozen=True)
class Reconstruction:
    """A finished run of `etsplat reconstruct`.

    Attributes:
        path: the run directory.
        mesh: its result, in the frame of the views.
        views: its photos, in the frame where the object has radius 1.
        exposures: colour matrices of the training views by their index; empty where the run learned none.
        device: where it is drawn.
    """

    path: Path
    mesh: MeshFile
    views: Dataset
    exposures: Mapping[int, Float[Tensor, "3 3"]]
    device: torch.device

    @classmethod
    def of(cls, run: RunDirectory, views: Dataset, device: torch.device) -> "Reconstruction":
        """Of a run that has its mesh, and its photos, those that watched it too.

        Raises:
            InputError: there is no mesh, or a file is damaged.
        """
        mesh = load_mesh(_mesh_of(run))
        views = refined_capture(views, run.path)
        mesh = replace(mesh, vertices=views.normalization.apply(mesh.vertices))
        known = _exposures(run, views)
        if known:
            views = replace(views, train=sorted(known))  # of those that watched the run it is not known
        return cls(run.path, mesh, views, known, device)

    def textured(
        self, size: int, faces: int, seed: int = 0, tell: Tell = lambda phase, done, total: None
    ) -> TexturedMesh:
        """A light mesh under a texture, in the frame of the views; see `texture_mesh`."""
        return texture_object(
            self.mesh,
            self.views,
            size=size,
            faces=faces,
            exposures=self.exposures,
            device=self.device,
            seed=seed,
            tell=tell,
        )

    def in_own_units(self, mesh: TexturedMesh) -> TexturedMesh:
        """A mesh in the units of the input."""
        return replace(mesh, vertices=self.views.normalization.invert(mesh.vertices.detach())).learnable()


def is_reconstruction(path: Path) -> bool:
    """Whether a folder holds a run of `etsplat reconstruct`."""
    return is_run(path) and RunDirectory(path).read_config()["task"] == ReconstructConfig.TASK


def open_reconstruction(
    path: Path | str,
    scene: Source | None = None,
    device: str | None = None,
    tell: Tell = lambda phase, done, total: None,
) -> Reconstruction:
    """Open a run with its photos; those of a mesh are taken again.

    Args:
        path: the run directory.
        scene: the folder, mesh or data set that the run is of, where it has moved or is not known.
        device: "cpu", "cuda", or None for cuda where there is a GPU.
        tell: is told how far it is.

    Raises:
        InputError: it is no such run, has no mesh yet, or its photos have gone or changed.
    """
    run, place = RunDirectory(Path(path)), resolve_device(device, None)
    if not is_reconstruction(run.path):
        raise InputError(f"{path}: is no run of `etsplat reconstruct`, whose photos a texture is made of; name one")
    _mesh_of(run)
    record = read_record(
        run, ReconstructConfig, ["resolution", "pictures.supersampling", "refine_cameras"], "paths.source", "source"
    )
    paths, then, source = record["paths"], record["config"], _source_of(run, scene)
    config = ReconstructConfig(
        resolution=then["resolution"], pictures=Pictures(supersampling=then["pictures"]["supersampling"])
    )
    tell("Reading the photos", 0, 0)
    loaded, _ = load_source(source, replace(config, refine_cameras=then["refine_cameras"]), paths.get("masks"))
    if fingerprint(loaded) != record["source"].get("fingerprint"):
        name = "the data set" if isinstance(source, Dataset) else source
        raise InputError(f"{path}: {name} is not what the run was made of; name that with {option('scene', ...)}")
    views, _ = make_subject(loaded, replace(config, watch=0), partial(tell, "Photographing"), place)
    return Reconstruction.of(run, views, place)


def _exposures(run: RunDirectory, views: Dataset) -> dict[int, Float[Tensor, "3 3"]]:
    matrices = run.read_exposure().get("matrices", {})
    return {view: torch.tensor(matrices[name]) for view in views.train if (name := views.names[view]) in matrices}


@one_torch_thread()
@usual_defaults()
def texture_mesh(
    run: Result | Path | str,
    *,
    size: int = 2048,
    faces: int = LIGHT_FACES,
    scene: Source | None = None,
    device: str | None = None,
    seed: int = 0,
    tell: Tell = lambda phase, done, total: None,
) -> TexturedMesh:
    """A light mesh of a reconstructed object: few faces under a texture, both fitted to the run's training photos.

    Needs xatlas and fast-simplification: pip install 'etsplat[texture]'.

    Args:
        run: the result of `reconstruct`, or the directory of a finished run.
        size: texels along each side of the texture, a multiple of 4 from 64 to 8192.
        faces: at most so many.
        scene: the folder, mesh or data set that the run is of, where it has moved or was in memory.
        device: "cpu", "cuda", or None for cuda where there is a GPU.
        seed: of the order of the photos and the backgrounds; one gives the same bits on the same machine.
        tell: is called with a phase, steps done and steps in all.

    Returns:
        The mesh in the units of the input, on the CPU; `save` writes GLB or OBJ.

    Raises:
        InputError: a package is missing, the run or its photos cannot be used, or a number is out of range.

    Example:
        >>> asset = etsplat.texture_mesh(result, size=64, faces=100)  # of the example of `etsplat.reconstruct`
        >>> asset.texture.shape, asset.count <= 100
        (torch.Size([64, 64, 3]), True)
        >>> asset.save("owl.glb")
    """
    if problem := texture_problem(size, "size"):
        raise InputError(problem)
    ExportConfig(texture=size, faces=faces)
    check_installed()
    path = given_path("run", run.path if isinstance(run, Result) else run, "a result of reconstruct or a path")
    opened = open_reconstruction(path, scene, device, tell)
    return opened.in_own_units(opened.textured(size, faces, seed, tell))


def export_mesh(
    run: Path,
    path: Path,
    config: ExportConfig,
    scene: Path | None = None,
    device: str | None = None,
    tell: Tell = lambda phase, done, total: None,
    note: Note = lambda text: None,
) -> dict[Path, int]:
    """Write the mesh of a run of `etsplat reconstruct`; the suffix of `path` chooses the format.

    `note` is called with a sentence where something is otherwise than one may think.

    Returns:
        The files, that at `path` first, and how many faces are in each.

    Raises:
        InputError: settings that meshes do not know; as `texture_mesh`; the file cannot be written.
    """
    config = checked_for_meshes(path, config)
    if config.texture is not None:
        return _export_textured(run, path, config, scene, device, tell, note)
    return {path: write_mesh(run, path, config, scene, note)[0]}


def checked_for_meshes(path: Path, config: ExportConfig) -> ExportConfig:
    """With axes that are chosen. Raises InputError for settings that meshes do not know, or files of this kind."""
    for name in settings_of(ExportConfig):
        if name not in _OF_MESHES and getattr(config, name) != getattr(ExportConfig(), name):
            ours = ", ".join(map(option, _OF_MESHES))
            raise InputError(f"{option(name)}: is for soups; of a reconstruction's mesh there are {ours}")
    config = replace(config, up=config.up or "keep")
    check_stored(path, config)
    return config


def write_mesh(run: Path, path: Path, config: ExportConfig, scene: Source | None, note: Note) -> tuple[int, Similarity]:
    """`export_mesh` without a texture: how many faces, and the way from the input's units and axes to the file's."""
    if kind_of(path) not in (kinds := suffixes("vertex_colors")):
        raise InputError(f"{path}: a mesh is not written into files of this kind; choose one of {', '.join(kinds)}")
    mesh = load_mesh(_mesh_of(RunDirectory(run)))
    if config.faces is not None and config.faces < len(mesh.faces):
        vertices, faces = decimated(mesh.vertices, mesh.faces, config.faces)
        colors = colors_at(mesh, vertices[faces].mean(dim=1))
        mesh = MeshFile(vertices, faces, face_colors=colors)
    check_placed(path, config)
    if scene is not None and config.up == "keep":
        upright = option("up", "y", "z")
        note(f"{option('scene')} has no use here: its photos say where up is, with {upright}, and make a texture")
    transform, near, far, record = _placement(RunDirectory(run), config, scene, mesh.vertices, note)
    vertices, by_face, by_vertex = near.apply(mesh.vertices).float(), mesh.face_colors, _only_by_vertex(mesh)
    how = {"world": far, "compress": config.compress, "record": record}
    save_mesh(path, vertices, mesh.faces, by_face, vertex_colors=by_vertex, **how)
    return len(mesh.faces), transform


def _export_textured(
    run: Path,
    path: Path,
    config: ExportConfig,
    scene: Path | None,
    device: str | None,
    tell: Tell,
    note: Note,
) -> dict[Path, int]:
    """The light mesh at `path`, and its coarser levels beside it, each made of the one before."""
    assert config.texture is not None
    kinds = [suffix[1:] for suffix in suffixes("texture")]
    if kind_of(path) not in (*suffixes("texture"), ".safetensors"):
        raise InputError(f"{path}: files of this kind hold no texture; choose {file_kind(*kinds)}")
    if config.normals and kind_of(path) != ".glb":
        without = f"leave out {option('normals')}, or choose {file_kind('glb')}"
        raise InputError(f"{path}: files of this kind hold no normal map; {without}")
    if kind_of(path) in suffixes("texture"):
        check_placed(path, config)
    elif (config.up, config.scale, config.place) != ("keep", 1.0, "keep"):
        raise InputError(f"{path}: keeps units and axes; {leave_unplaced()}, or choose {file_kind(*kinds)}")
    if not path.parent.is_dir():  # rather than after a minute
        raise InputError(f"{path}: there is no folder {path.parent}; create the folder first")
    check_installed()
    opened, written = open_reconstruction(run, scene, device, tell), {}
    corners = opened.views.normalization.invert(opened.mesh.vertices)
    _, near, far, record = _placement(RunDirectory(run), config, scene, corners, note)
    mesh = opened.textured(config.texture, config.faces or LIGHT_FACES, tell=tell)
    for level in range(config.lods + 1):
        if level:
            tell("Making coarser levels", level, config.lods)
            mesh = coarser(mesh, max(4, mesh.count // 4), config.texture >> level)
        place = path.with_name(f"{path.stem}_lod{level}{path.suffix}") if level else path
        relief = normal_map_of(mesh, opened.mesh, occlusion=config.occlusion) if config.normals else None
        relief = None if relief is None else relief.turned(near.rotation)
        placed = opened.in_own_units(mesh)
        placed = replace(placed, vertices=near.apply(placed.vertices.detach()).float()).learnable()
        placed.save(place, relief, world=far, compress=config.compress, pictures=config.pictures, record=record)
        written[place] = mesh.count
    return written


def check_stored(path: Path, config: ExportConfig) -> None:
    """Raises InputError where a file of this kind cannot be stored as the settings say, or a package is missing."""
    for name in ("compress", "pictures"):
        if getattr(config, name) != getattr(ExportConfig(), name) and kind_of(path) not in suffixes("compressed"):
            without = f"leave out {option(name)}, or choose {file_kind('glb')}"
            raise InputError(f"{path}: is not stored in another way; {without}")
    if config.compress == "meshopt":
        load_meshopt()


def _placement(
    run: RunDirectory,
    config: ExportConfig,
    scene: Source | None,
    vertices: Float[Tensor, "V 3"],
    note: Note,
) -> tuple[Similarity, Similarity, Georeference | None, dict[str, Any]]:
    """How vertices in the units of the input are moved: in all, and as a part in the file and an offset beside it.

    Last, what the file says of it, by which it is led back.
    """
    file = run.path / GEOREFERENCE_FILE
    georeference = Georeference.read(file) if file.is_file() else None
    up = None if config.up == "keep" else _up(run, scene, georeference, note)
    if up is None and config.up != "keep" and config.place != "world":
        note(f"nothing is turned, since photos do not say where up is: +{config.up} is up if it was in the input")
    transform = placement(run.path, config, vertices, up, georeference)
    return transform, *apart_from_world(transform, config, georeference), placed_record(config, transform, georeference)


def _up(
    run: RunDirectory, scene: Source | None, georeference: Georeference | None, note: Note
) -> Float[Tensor, "3"] | None:
    """Where up is; None for the object of a mesh, whose photos say nothing, and where photos contradict each other."""
    told = told_up(georeference)
    if told is not None:
        return told
    source = _source_of(run, scene)
    if isinstance(source, MeshFile):
        return None
    if not isinstance(source, Dataset) and (str(source) == DEMO_OBJECT or Path(source).is_file()):
        return None
    photos = capture_at(source)
    if photos is None:
        return None
    if _is_of_others(run, photos):
        named = f"which {option('scene', ...)} names"
        note(f"it is turned by the photos of another scene than the run was made of, {named}")
    return up_of(photos)


def _is_of_others(run: RunDirectory, photos: Dataset) -> bool:
    """Whether a run was made of a mesh, or of other photos, as far as it says."""
    config = run.read_config("paths.source")
    source = config["paths"]["source"]
    of_mesh = source is not None and (source == DEMO_OBJECT or Path(source).is_file())
    return of_mesh or config.get("views", held := directions_digest(photos)) != held


def _source_of(run: RunDirectory, scene: Source | None) -> Source:
    """What a run is of. Raises InputError where nobody says, or it has gone."""
    if isinstance(scene, Dataset | MeshFile):
        return scene
    if scene is not None:
        return given_path("scene", scene, "a path, a MeshFile or a Dataset")
    source = run.read_config("paths.source")["paths"]["source"]
    if source is None:
        raise InputError(
            f"{run.path}: does not say what it is of, a Dataset or a mesh in memory perhaps; "
            f"name the folder with its photos with {either('--scene', 'scene=, or hand it in again')}"
        )
    if source != DEMO_OBJECT and not Path(source).exists():
        now = f"name where it is now with {option('scene', ...)}"
        raise InputError(f"{run.path}: what it is of, {source}, has gone; {now}")
    return source


def _only_by_vertex(mesh: MeshFile) -> Tensor | None:
    return None if mesh.face_colors is not None else mesh.vertex_colors


def _mesh_of(run: RunDirectory) -> Path:
    path = run.mesh_path(".ply")
    if not path.is_file():
        finish = f"let the run finish, continue it with {option('resume', True)}"
        raise InputError(f"{run.path}: has no {path.name} (yet); {finish}")
    return path
