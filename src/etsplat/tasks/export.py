"""`etsplat.export`: a soup, or the mesh of a reconstruction, as a file for other programs, whatever it comes from."""

from pathlib import Path

import torch

from etsplat.core.errors import InputError
from etsplat.core.precision import usual_defaults
from etsplat.core.validation import first_not_finite
from etsplat.data.dataset import Dataset
from etsplat.io.mesh_files import MeshFile
from etsplat.io.paths import given_path
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_mesh import checked_for_meshes, is_reconstruction, write_mesh
from etsplat.tasks.export_soup import Export, export_soup
from etsplat.tasks.opened_runs import SoupRun, capture_at, check_not_read, open_run
from etsplat.tasks.reconstruct import ReconstructResult
from etsplat.tasks.sources import Source
from etsplat.tasks.train import TrainResult


@usual_defaults()
def export(
    source: TrainResult | ReconstructResult | TriangleSoup | str | Path,
    path: str | Path,
    config: ExportConfig | None = None,
    *,
    scene: Source | None = None,
) -> Export:
    """Writes the triangles of a scene or an object as a file for other programs, as `etsplat export` does.

    Args:
        source: the result of `train`, its folder, a soup, or a file that holds one (safetensors, ply, etz). Of the
            first two, the opaque mesh that the run made is written where the file is one of opaque triangles. Or the
            result of `reconstruct`, or its folder: a mesh, for glb, obj and ply.
        path: of the file; its suffix chooses the kind: glb, obj, ply, off, safetensors, etz, html.
        config: what is written, and how; None for the defaults.
        scene: the capture, or its folder, by which colours are baked and what nobody sees is left out; of a
            reconstruction its source. None for what the run says of it: one of a `Dataset` or `MeshFile` in memory does
            not say.

    Returns:
        What was written: `path`, `triangles`, what was `removed`, `transform`, from the capture's units and axes to
        those of the file, and `notes` where something is otherwise than one may think.

    Raises:
        InputError: nothing is left; settings that contradict each other or the kind of file; the file cannot be
            written, or `source` cannot be read.
        ValueError: `config` is of another kind.

    Example:
        >>> written = etsplat.export(result, "scene.html")  # of the example of `train`: a page
        >>> written.path.name, written.triangles > 0
        ('scene.html', True)
    """
    config = ExportConfig() if config is None else config
    if not isinstance(config, ExportConfig):
        raise ValueError(f"config must be an ExportConfig, got {type(config).__name__}")
    for name in ("texture", "faces"):
        if getattr(config, name) is not None:
            raise InputError(f"{name}: belongs to a run of reconstruct; take etsplat.texture_mesh")
    path = given_path("path", path, "the path of a file")
    if isinstance(source, TriangleMesh | MeshFile):
        writes = f"etsplat.save_mesh({path.name!r}, mesh.vertices, mesh.faces, mesh.face_colors)"
        how = f"mesh.save({path.name!r})" if isinstance(source, TriangleMesh) else writes
        raise InputError(f"source: is of type {type(source).__name__}, and no soup; {how} writes a mesh as it is")
    if isinstance(source, TriangleSoup):
        soup = source.finished().to(torch.device("cpu"))
        if (bad := first_not_finite(soup.parameters())) is not None:
            raise InputError(f"source: {bad} of the soup holds NaN or infinity, which no program reads")
        return export_soup(SoupRun(path, soup, capture_at(_of_photos(scene))), path, config)
    found = given_path(
        "source",
        source.path if isinstance(source, TrainResult | ReconstructResult) else source,
        "a result of train or reconstruct, a TriangleSoup or a path",
    )
    check_not_read(path, found)
    if is_reconstruction(found):
        return _export_mesh(found, path, config, scene)
    scene = _of_photos(scene)
    return export_soup(open_run(found, scene, "cpu"), path, config)


def _of_photos(scene: Source | None) -> Dataset | str | Path | None:
    """Raises InputError where it is a mesh, of which only reconstructions are."""
    if scene is None or isinstance(scene, Dataset):
        return scene
    return given_path("scene", scene, "a Dataset or a path")


def _export_mesh(run: Path, path: Path, config: ExportConfig, scene: Source | None) -> Export:
    notes: list[str] = []
    faces, transform = write_mesh(run, path, checked_for_meshes(path, config), scene, notes.append)
    return Export(path, faces, 0, {}, transform, tuple(notes))
