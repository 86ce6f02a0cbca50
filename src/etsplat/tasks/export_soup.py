"""A soup as a file for other programs: colours baked, what is not wanted left out, turned, scaled and placed."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.core.spelling import either, file_kind, option
from etsplat.data.where_up import noted_up, told_up, up_of
from etsplat.geometry.similarity import Similarity
from etsplat.io.atomic import atomic_write
from etsplat.io.georeference import Georeference
from etsplat.io.mesh_files import save_triangles
from etsplat.io.paths import kind_of
from etsplat.io.writers import suffixes, writer_of
from etsplat.model.solid_soup import SolidSoup
from etsplat.model.soup_appearance import OPAQUE_FROM
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import GEOREFERENCE_NOTE, UP_NOTE, TriangleSoup
from etsplat.ops.soup_colors import soup_colors
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_mesh import check_stored
from etsplat.tasks.opened_runs import SoupRun, training_cameras
from etsplat.tasks.placing import apart_from_world, check_placed, leave_unplaced, placed_record, placement
from etsplat.tasks.scene_page import compact_bytes, scene_of, small_camera
from etsplat.tasks.soup_selection import Crop, Reason, Selection, select, surroundings_of
from etsplat.web.pages import render_scene_page

WHOLE = (".safetensors", ".etz", ".html")
"""Kinds of files that hold a soup as soft as it is, in the units and axes of its capture."""

_STRAYS = 0.01
"""Share of a soup's corners beyond its extent at either end of an axis."""


@dataclass(frozen=True)
class Export:
    """What was written.

    Attributes:
        path: the file.
        triangles: in it, the sky's too.
        sky: those of the sky, where they are an object of their own.
        removed: how many were left out, by the reason (`etsplat.tasks.soup_selection.REASONS`).
        transform: from the capture's own units and axes to those of the file.
        notes: a sentence where something is otherwise than one may think, as where the capture has gone.
    """

    path: Path
    triangles: int
    sky: int
    removed: Mapping[Reason, int]
    transform: Similarity
    notes: tuple[str, ...] = ()

    @property
    def dropped(self) -> int:
        """How many were left out as too faint."""
        return self.removed.get("faint", 0)


def export_soup(run: SoupRun, path: Path | str, config: ExportConfig, crop: Crop | None = None) -> Export:
    """Write a soup to `path`, whose suffix chooses the format: one of `WHOLE`, or of `etsplat.io.writers`.

    Args:
        run: the soup, and where it is known its capture.
        path: of the file.
        config: what is written, and how.
        crop: what is kept of the soup, in the capture's own units and axes.

    Raises:
        InputError: settings that contradict each other; nothing is left; the file cannot be written.
    """
    path = Path(path)
    config = checked_for_soups(path, config)
    keeps_all = kind_of(path) in WHOLE
    soft = keeps_all or config.alpha or config.colors == "keep"
    apart = config.sky == "apart" and not keeps_all and "objects" in writer_of(path).HOLDS
    least = (0.0 if keeps_all or config.alpha else OPAQUE_FROM) if config.min_opacity is None else config.min_opacity
    if run.solid is not None and not keeps_all and why_soup(path, config) is None:
        if config.min_opacity is not None:
            soup = option("triangles", "soup")
            raise InputError(
                f"{option('min_opacity')}: the opaque mesh has no fainter triangles; leave it out, or {soup}"
            )
        run = replace(run, soup=run.solid)
    chosen = select(
        run,
        crop=crop,
        clean=config.clean,
        sky=apart or config.sky == "joined" or (config.sky == "apart" and (keeps_all or config.colors == "keep")),
        min_opacity=least,
        opaque=not soft,
    )
    if keeps_all:
        _write_whole(run, path, config, chosen)
        written = Export(path, int(chosen.kept.sum()), 0, chosen.removed, Similarity())
    else:
        written = _write(run, path, config, chosen, apart=apart)
    notes = (
        *run.notes,
        *_without_capture(run, path, config),
        *_not_turned(run, path, config),
        *_unknown_sky(run, config),
    )
    return replace(written, notes=notes)


def why_soup(path: Path, config: ExportConfig) -> str | None:
    """The setting by which a file of triangles has those of the soup, and not a run's opaque mesh; None if none has."""
    reasons = {
        option("alpha", True): config.alpha,
        option("colors", "keep"): config.colors == "keep",
        option("triangles", "soup"): config.triangles == "soup",
    }
    return None if kind_of(path) in WHOLE else next((reason for reason, holds in reasons.items() if holds), None)


def checked_for_soups(path: Path, config: ExportConfig) -> ExportConfig:
    """With axes that are chosen.

    Raises InputError for settings that files of a kind have no room for, or that contradict each other; there is no
    such folder.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; create the folder first")
    config = replace(config, up=config.up or ("keep" if config.colors == "keep" else "y"))
    check_stored(path, config)
    moved = config.scale != 1 or config.place != "keep"
    if kind_of(path) in WHOLE:
        if moved or config.up == "z":
            raise InputError(f"{path}: keeps the units and axes of the capture; {leave_unplaced()}")
        return config
    holds = writer_of(path).HOLDS
    if config.colors == "keep" and ("numbers" not in holds or config.up != "keep"):
        need = f"{file_kind(*(suffix[1:] for suffix in suffixes('numbers')))} and {option('up', 'keep')}"
        raise InputError(f"colours that depend on the direction ({option('colors', 'keep')}) need {need}")
    if config.alpha and "alpha" not in holds:
        other = either("another --format", "a path with another ending")
        raise InputError(
            f"{path}: files of this kind hold no opacities; leave out {option('alpha')}, or choose {other}"
        )
    check_placed(path, config)
    return config


def _write_whole(run: SoupRun, path: Path, config: ExportConfig, chosen: Selection) -> None:
    """What was chosen of the soup in one of the kinds `WHOLE`."""
    soup = chosen.of(run.soup)
    if kind_of(path) == ".safetensors":
        soup.save(path)
        return
    with atomic_write(path) as temporary:
        if kind_of(path) == ".etz":
            temporary.write_bytes(compact_bytes(soup, run.capture))
            return
        solid = _chosen_solid(run, config, chosen)
        temporary.write_text(render_scene_page(scene_of(run, soup, solid)), encoding="utf-8", errors="replace")


def _chosen_solid(run: SoupRun, config: ExportConfig, chosen: Selection) -> SolidSoup | None:
    """The opaque mesh without what the soup is left without, for pages; None if there is none."""
    solid = run.soup if isinstance(run.soup, SolidSoup) else run.solid
    if solid is None or config.triangles == "soup":
        return None
    shown = replace(run, soup=solid)
    return solid.kept(select(shown, crop=chosen.crop, clean=config.clean, sky=config.sky != "none", opaque=True).kept)


def _write(run: SoupRun, path: Path, config: ExportConfig, chosen: Selection, *, apart: bool) -> Export:
    """Colours, places and numbers of what was chosen."""
    soup, kept = run.soup, chosen.kept
    sky = (chosen.sky & kept)[kept].cpu() if apart else torch.zeros(int(kept.sum()), dtype=torch.bool)
    if bool(sky.all()):
        remedy = f"train with {option('asset', True)}, or take {option('sky', 'joined')}"
        raise InputError(f"{run.path}: nothing but its sky is left; {remedy}")
    if isinstance(soup, SolidSoup):
        colors = soup.corner_colors[kept]
    elif config.colors == "mean" and run.capture is not None:
        colors = bake_colors(soup, training_cameras(run.capture))[kept]
    else:
        colors = soup.display_colors()[kept]
    opacities = soup.drawn_opacities.detach()[kept]
    vertices = soup.vertices.detach()[kept].cpu()
    if bool(sky.any()) and chosen.surroundings is not None:
        turned = sky & chosen.surroundings.facing_outwards(vertices)  # in a file it is seen from inside alone
        vertices[turned] = vertices[turned].flip(1)
        if isinstance(soup, SolidSoup):
            colors[turned.to(colors.device)] = colors[turned.to(colors.device)].flip(1)
    transform = transform_of(run, config, vertices[~(chosen.sky[kept].cpu())])
    known = config if _up(run) is not None else replace(config, up="keep")  # the file must not say that it is upright
    georeference = _georeference(run)
    near, world = apart_from_world(transform, config, georeference)
    vertices = near.apply(vertices).float()
    if config.alpha:
        colors = torch.cat([colors, opacities[:, None]], dim=1)
    numbers = {"opacity": opacities, "sigma": soup.drawn_sigma.detach()[kept]}
    if config.colors == "keep":
        numbers |= _coefficients(soup, kept)
    save_triangles(
        path,
        vertices,
        colors,
        weld=config.weld or isinstance(soup, SolidSoup),  # whose neighbours share corners as they are
        numbers=numbers,
        comment=f"etsplat {soup.appearance.kernel} {soup.appearance.distance}",
        record=_record(soup, known, chosen, transform, georeference),
        sky=sky if bool(sky.any()) else None,
        world=world,
        compress=config.compress,
    )
    return Export(path, len(vertices), int(sky.sum()), chosen.removed, transform)


def transform_of(run: SoupRun, config: ExportConfig, corners: Float[Tensor, "N 3 3"]) -> Similarity:
    """The `placement` of a soup; nothing is turned where nobody knows where up is."""
    return placement(run.path, config, corners, _up(run), _georeference(run), _STRAYS)


def _up(run: SoupRun) -> Float[Tensor, "3"] | None:
    """Where up is, by the place in the world, the cameras, or a file that was turned already."""
    up = told_up(_georeference(run))
    if up is None and run.capture is not None:
        up = up_of(run.capture)
    return noted_up(run.soup.notes.get(UP_NOTE)) if up is None else up


def _without_capture(run: SoupRun, path: Path, config: ExportConfig) -> tuple[str, ...]:
    """What is otherwise in a file because the capture has gone or is another, and the remedy; nothing if nothing is."""
    if run.other_scene and kind_of(path) != ".safetensors":
        return ("it is of another scene than the run was trained on: colours and what is seen are by its photos",)
    kind = kind_of(path)
    triangles = kind not in WHOLE
    one_color = config.colors == "mean" and not isinstance(run.soup, SolidSoup) and run.soup.drawn_degree > 0
    effects = {
        "colours are what is the same from every side": triangles and one_color,
        "nothing is turned, since nobody knows where up is": _lacks_up(run, path, config),
        "triangles are in order of opacity and size, not of what photos show": kind in (".etz", ".html"),
        "there are no photos on the page": kind == ".html",
    }
    said = "; ".join(effect for effect, holds in effects.items() if holds)
    gone = f"its scene {run.gone} has gone: {said} ({option('scene', ...)} names it)"
    return (gone,) if run.gone is not None and said else ()


def _lacks_up(run: SoupRun, path: Path, config: ExportConfig) -> bool:
    """Whether a file would be turned if anybody knew where up is."""
    turned = kind_of(path) not in WHOLE and config.up != "keep" and config.place != "world"
    return turned and _up(run) is None


def _not_turned(run: SoupRun, path: Path, config: ExportConfig) -> tuple[str, ...]:
    """That `up` had no effect, where the scene has not gone, which says so itself; nothing if it had one."""
    if run.gone is not None or not _lacks_up(run, path, config):
        return ()
    why = f"nobody knows where up is ({option('scene', ...)} names the capture)"
    if run.capture is not None:
        why = "the cameras contradict each other about where up is"
    return (f"nothing is turned, since {why}: +{config.up} is up if it was before",)


def _unknown_sky(run: SoupRun, config: ExportConfig) -> tuple[str, ...]:
    """That nothing is left out as sky because nobody knows where that is; nothing if somebody does."""
    if config.sky != "none" or Surroundings.NOTE in run.soup.notes or surroundings_of(run) is not None:
        return ()
    named = "" if run.capture is not None else f" ({option('scene', ...)} names the capture, whose points tell)"
    return (f"no triangle is left out as sky, since nobody knows where that is{named}",)


def _georeference(run: SoupRun) -> Georeference | None:
    """Where the capture lies in the world: as the soup says, or else the capture; None where neither does."""
    if (note := run.soup.notes.get(GEOREFERENCE_NOTE)) is not None:
        return Georeference.from_json(note, run.path)
    return None if run.capture is None else run.capture.georeference


def _record(
    soup: TriangleSoup,
    config: ExportConfig,
    chosen: Selection,
    transform: Similarity,
    georeference: Georeference | None,
) -> dict[str, Any]:
    """What the file says of how it was made and where its sky is; where it comes back as the same soup, all of that."""
    look = {"appearance": json.loads(soup.appearance.structure.to_json()), "notes": dict(soup.notes)}
    sky = {name: note for name, note in soup.notes.items() if name == Surroundings.NOTE}
    return {
        **(look if config.colors == "keep" else {"notes": sky} if sky else {}),
        **placed_record(config, transform, georeference),
        **{name: getattr(config, name) for name in ("sky", "clean")},
        "crop": None if chosen.crop is None else str(chosen.crop),
        "removed": dict(chosen.removed),
    }


@torch.no_grad()
def bake_colors(soup: TriangleSoup, cameras: list[Cameras]) -> Float[Tensor, "N 3"]:
    """One colour for every triangle: the mean of what the cameras see, weighted by how much each sees of it.

    The weight is the largest blend weight of any pixel. A triangle that nobody sees has the part of its colour that is
    the same from every side.
    """
    device = soup.vertices.device
    total, weight = torch.zeros(len(soup), 3, device=device), torch.zeros(len(soup), 1, device=device)
    for camera in cameras:
        small = small_camera(camera).to(device)
        seen = soup.render(small, outputs=("statistics",)).statistics
        assert seen is not None
        colors = soup_colors(soup.vertices, soup.sh_dc, soup.sh_rest, small.centers, soup.drawn_degree)[0]
        total += seen.max_weight[0, :, None] * colors.clamp(0, 1)
        weight += seen.max_weight[0, :, None]
    return torch.where(weight > 0, total / weight.clamp_min(1e-12), soup.display_colors())


def _coefficients(soup: TriangleSoup, kept: Tensor) -> dict[str, Tensor]:
    """The harmonics by the names that Gaussian scenes use: f_rest lists all of red, then green, then blue."""
    dc, rest = soup.sh_dc.detach()[kept, 0], soup.sh_rest.detach()[kept].transpose(1, 2).flatten(1)
    named = {f"f_dc_{channel}": dc[:, channel] for channel in range(3)}
    return named | {f"f_rest_{index}": rest[:, index] for index in range(rest.shape[1])}
