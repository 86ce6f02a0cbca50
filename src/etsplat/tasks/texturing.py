"""A light mesh of a reconstructed object: few faces, and a texture fitted to the run's photos.

The mesh is decimated, untangled and cut into charts. The texture begins with the colours of the full mesh, small, and
is fitted with the antialiased z-buffer, the picture that a viewer draws; twice it is enlarged, so that where photos
show less than its texels hold it stays smooth. The vertices follow, for the silhouettes that decimation moved, but make
no new folds, and are untangled once more. Where pictures get worse by untangling, it is left. Texels that no photo
shows take the colour of the nearest place on the surface that one does; those between charts that of charts beside
them, so that coarser levels do not bleed.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from torch import Tensor

from etsplat.data.dataset import Dataset, middles_of
from etsplat.engines.threads import num_threads
from etsplat.geometry.decimation import decimated, load_simplifier
from etsplat.geometry.distance import closest_places, closest_points
from etsplat.geometry.held_back import around_folds
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.untangle import untangle
from etsplat.geometry.unwrap import load_xatlas, texel_points, unwrapped
from etsplat.io.mesh_files import MeshFile
from etsplat.model.textured_mesh import TexturedMesh
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.texture import sample_texture
from etsplat.optim.exposure import Exposure
from etsplat.optim.gauge import Gauge
from etsplat.optim.known_exposure import KnownExposure
from etsplat.optim.loop import Event, StepEvent
from etsplat.optim.new_folds import NoNewFolds
from etsplat.optim.objective import Objective
from etsplat.optim.schedules import Schedule, exponential_decay
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.trainer import GUARD_SIDE, GUARD_VIEWS, Trainer

EPOCHS = (4, 3, 3)
"""How often every photo is seen by textures of a quarter and half of the size, and of the size itself."""

PULL, LEAST_RATE, VERTEX_FINAL = 0.12, 3e-5, 0.1
"""Adam's rate of vertices: this part of how far decimation moved the surface, median over the full mesh's vertices; the
least, where the object has radius 1; and what is left of it at the end of the last stage. Rough meshes lose their
outline to decimation, which fast vertices bring back; of smooth ones they would follow the photos' noise."""

LOOK_EVERY, FASTEST = 25, 5e-3
"""Steps after which vertices of new folds go back; and the highest rate, in mean edges: by then they moved by an eighth
of one at most, so that no face goes through another unseen."""

REACHES, WORSE = (math.inf, 0.5), 0.02
"""How far untangling may move a vertex, in lengths of its longest edge: the first by which pictures of training views
get no worse than by this part of their loss. Where none does, folds hold up the shape, as of thin parts after a short
run."""

TEXTURE_RATES, TEXTURE_FINAL = (2e-2, 1e-2, 1e-2), 0.2
"""Adam's rate of texels in each stage, and what is left of it at the stage's end."""

RIM = 1.5
"""Texels around a chart: bilinear filters at a chart's edge read its neighbours along both axes."""

SHOWN = 1e-4
"""Photos show a texel whose second moment is at least this part of the median of those that they do."""

Surface = TypeVar("Surface", TriangleMesh, TexturedMesh)

Tell = Callable[[str, int, int], None]
"""Called with a phase, steps done and steps in all."""


def check_installed() -> None:
    """Raises InputError where a package is missing; better now than after a run."""
    load_simplifier()
    load_xatlas()


def texture_object(
    mesh: MeshFile,
    views: Dataset,
    *,
    size: int,
    faces: int,
    exposures: Mapping[int, Float[Tensor, "3 3"]] | None = None,
    device: torch.device | None = None,
    seed: int = 0,
    tell: Tell = lambda phase, done, total: None,
) -> TexturedMesh:
    """Fit a light, textured mesh to photos of an object.

    Args:
        mesh: the full mesh with colours of faces or vertices, in the frame of the views.
        views: photos with transparency; those in `train` are fitted to. The object has a radius of about 1.
        size: texels along each side of the texture, a multiple of 4.
        faces: at most so many.
        exposures: what the camera made of colours, a matrix for each training view by its index; None or empty for
            photos that were all exposed alike.
        device: where it is fitted; None for the CPU.
        seed: of the order of views and the backgrounds.
        tell: is told how far it is.

    Returns:
        The mesh, on the CPU, in the frame of the views.

    Raises:
        InputError: a package is missing; the mesh does not stay whole with so few faces.
    """
    tell("Simplifying", 0, 0)
    device = device or torch.device("cpu")
    exposure = KnownExposure(exposures) if exposures else None
    if exposure is not None:
        exposure.start(views.train, 1, mesh.vertices.to(device))
    gauge = Gauge(views, middles_of(views.train, min(len(views.train), GUARD_VIEWS)), GUARD_SIDE, device)
    vertices, triangles = decimated(mesh.vertices, mesh.faces, faces)
    colors = colors_at(mesh, vertices[triangles].mean(dim=1))
    plain = TriangleMesh.from_mesh(vertices, triangles, colors=colors, opacity=None, sigma=None).to(device)
    vertices = _untangled(plain, gauge, exposure).vertices.detach().cpu()
    tell("Unwrapping", 0, 0)
    model = _unwrapped(mesh, vertices, triangles, size).to(device)
    model = _Fit(views, exposure, seed, _rate(mesh, vertices, triangles), around_folds(vertices, triangles)).fitted(
        model, tell
    )
    return _untangled(model.to(device), gauge, exposure).to(torch.device("cpu"))


@torch.no_grad()
def coarser(mesh: TexturedMesh, faces: int, size: int) -> TexturedMesh:
    """A textured mesh for larger distances: decimated, unwrapped anew, and in the colours of the given one.

    Args:
        mesh: what it is made of, with a radius of about 1.
        faces: at most so many.
        size: texels along each side. Each takes the colour of the nearest place, of the level of the given texture
            whose texels are about as large.

    Raises:
        InputError: a package is missing; the mesh does not stay whole with so few faces.
    """
    fine, triangles = mesh.surface()
    vertices, light = decimated(fine, triangles, faces)
    topology = MeshTopology.from_faces(light, len(vertices))
    if topology.is_closed():
        vertices, _ = untangle(vertices, topology, reach=REACHES[-1])
    uvs = unwrapped(vertices, light, size)
    covered, points, _ = texel_points(vertices, light, uvs, size)
    face, weights = closest_places(points, fine, triangles)
    places = (weights[..., None].float() * mesh.face_uvs.cpu()[face]).sum(dim=1)
    level = torch.full((len(places),), max(0.0, math.log2(len(mesh.texture) / size)))
    texture = vertices.new_zeros(size, size, 3)
    texture[covered] = sample_texture(mesh.texture.detach().cpu(), places, lod=level).clamp(0, 1)
    return TexturedMesh.from_mesh(vertices, light, spread(texture, covered), uvs)


def _untangled(model: Surface, gauge: Gauge, exposure: Exposure | None) -> Surface:
    """Without faces that cut through others, as far as pictures stay as good by it, where there is an inside."""
    if not model.topology.is_closed():
        return model
    objective, vertices = Objective(Photometric()), model.vertices.detach()
    limit: float | None = None
    for reach in REACHES:
        moved = untangle(vertices, model.topology, reach=reach)[0]
        if torch.equal(moved, vertices):
            break
        if limit is None:
            limit = (1 + WORSE) * gauge.measure(model, objective, exposure).loss
        found = replace(model, vertices=moved).learnable()
        if gauge.measure(found, objective, exposure).loss <= limit:
            return found
    return model


def _unwrapped(mesh: MeshFile, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"], size: int) -> TexturedMesh:
    """A light mesh in the colours of the full one, under a texture of the first stage."""
    uvs = unwrapped(vertices, faces, size)
    side = size >> (len(EPOCHS) - 1)
    covered, points, _ = texel_points(vertices, faces, uvs, side)
    texture = vertices.new_zeros(side, side, 3)
    texture[covered] = colors_at(mesh, points)
    return TexturedMesh.from_mesh(vertices, faces, spread(texture, covered), uvs)


def _rate(mesh: MeshFile, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> float:
    """That of a light mesh's vertices at the start."""
    moved = closest_points(mesh.vertices, vertices, faces)[0].sqrt().median()
    edge = (vertices[faces] - vertices[faces.roll(1, dims=1)]).norm(dim=-1).mean()
    return max(LEAST_RATE, min(PULL * float(moved), FASTEST * float(edge)))


@dataclass(frozen=True)
class _Fit:
    """What the stages of a fit have in common.

    Attributes:
        views: photos, those in `train` are fitted to.
        exposure: of those; None where they were exposed alike.
        seed: of the first stage.
        rate: of the vertices at the start.
        spared: (F,) faces that may cut through others.
    """

    views: Dataset
    exposure: Exposure | None
    seed: int
    rate: float
    spared: Bool[Tensor, " F"]

    def fitted(self, model: TexturedMesh, tell: Tell) -> TexturedMesh:
        """A model after all stages, with the texture of the first one to start from."""
        for stage in range(len(EPOCHS)):
            if stage:
                model = _with_texture(model, _enlarged(model.texture.detach()))
            trainer, done = self._trainer(model, stage), self._steps(stage)

            def hear(event: Event, done: int = done) -> None:
                if isinstance(event, StepEvent):
                    tell("Fitting the texture", done + event.iteration, self._steps(len(EPOCHS)))

            trainer.fit(self._steps(stage + 1) - done, callbacks=[hear], log_every=10)
            model = _completed(model, trainer.adam.second_moments["texture"].amax(dim=-1).cpu())
        return model

    def _steps(self, stage: int) -> int:
        """How many are made before a stage; those of all of them before the one after the last."""
        return sum(EPOCHS[:stage]) * len(self.views.train)

    def _trainer(self, model: TexturedMesh, stage: int) -> Trainer[TexturedMesh]:
        """Of one stage."""
        done, total = self._steps(stage), self._steps(len(EPOCHS))
        last = self._steps(stage + 1) - done

        def vertices(iteration: int) -> float:
            return self.rate * exponential_decay(done + iteration, total, VERTEX_FINAL)

        def texture(iteration: int) -> float:
            return TEXTURE_RATES[stage] * exponential_decay(iteration, last, TEXTURE_FINAL)

        return Trainer(
            model,
            self.views,
            Objective(Photometric()),
            NoNewFolds(self.spared, LOOK_EVERY, last),
            schedule=Schedule({"vertices": vertices, "texture": texture}),
            exposure=self.exposure,
            seed=self.seed + stage,
        )


def _completed(model: TexturedMesh, moments: Float[Tensor, "H W"]) -> TexturedMesh:
    """With texels that photos hardly show, and those between charts, from the nearest that they do.

    Adam's second moments say what photos show: those of texels that none does are zero.
    """
    vertices, faces = model.surface()
    texture, size = model.texture.detach().cpu().clamp(0, 1), len(model.texture)
    covered, points, _ = texel_points(vertices, faces, model.face_uvs.cpu(), size)
    colors, moments = texture[covered], moments[covered]
    if bool((moments > 0).any()):
        shown = moments > SHOWN * moments[moments > 0].median()
        if not bool(shown.all()):
            _, nearest = KDTree(points[shown].numpy()).query(points[~shown].numpy(), workers=num_threads())
            colors[~shown] = colors[shown][torch.from_numpy(np.asarray(nearest))]
    texture[covered] = colors
    return _with_texture(model, spread(texture, covered))


def spread(texture: Float[Tensor, "H W C"], known: Bool[Tensor, "H W"]) -> Float[Tensor, "H W C"]:
    """Every other texel takes the colour of the nearest known one if that is near, where filters at a rim read it.

    Farther away it takes the mean of what is known in the smallest block of a coarser level that it is in: no level has
    another colour by it, and large blocks of one colour hardly count in a file.
    """
    found = distance_transform_edt(~known.numpy(), return_indices=True)
    assert found is not None
    away, nearest = found
    rows, columns = torch.from_numpy(np.asarray(nearest)).long()
    near = torch.from_numpy(away <= RIM)[..., None]
    return torch.where(near, texture[rows, columns], _block_means(texture, known[..., None].to(texture)))


def _block_means(texture: Float[Tensor, "H W C"], weights: Float[Tensor, "H W 1"]) -> Float[Tensor, "H W C"]:
    """The weighted mean of each texel, or of the smallest block around it that has a weight; of any H and W."""
    height, width = weights.shape[:2]
    if bool((weights > 0).all()) or height == width == 1:
        return texture
    both = torch.cat([texture * weights, weights], dim=-1).permute(2, 0, 1)
    sums = torch.nn.functional.pad(both, (0, width % 2, 0, height % 2)).unfold(1, 2, 2).unfold(2, 2, 2).sum(dim=(3, 4))
    means = (sums[:-1] / sums[-1:].clamp_min(1.0)).permute(1, 2, 0)
    coarser = _block_means(means, sums[-1:].permute(1, 2, 0))
    doubled = coarser.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)[:height, :width]
    return torch.where(weights > 0, texture, doubled)


def _enlarged(texture: Float[Tensor, "H W 3"]) -> Float[Tensor, "2H 2W 3"]:
    """Twice as many texels along each side, bilinear between those that were."""
    planes = texture.permute(2, 0, 1)[None]
    large = torch.nn.functional.interpolate(planes, scale_factor=2, mode="bilinear", align_corners=False)
    return large[0].permute(1, 2, 0).contiguous()


def _with_texture(model: TexturedMesh, texture: Float[Tensor, "H W 3"]) -> TexturedMesh:
    return replace(model, texture=texture.to(model.vertices.device)).learnable()


def colors_at(mesh: MeshFile, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Display colours of a mesh where it is nearest to points; grey if it has none."""
    if mesh.face_colors is None and mesh.vertex_colors is None:
        return torch.full_like(points, 0.5)
    _, face = closest_points(points, mesh.vertices, mesh.faces)
    if mesh.face_colors is not None:
        return mesh.face_colors[face].to(points)
    assert mesh.vertex_colors is not None
    return mesh.vertex_colors[mesh.faces[face]].mean(dim=1).to(points)
