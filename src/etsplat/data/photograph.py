"""Ground truth of a mesh: forty pictures from a sphere around it, drawn by the z-buffer rasterizer.

The set-up (docs/conventions.md): the mesh is scaled to its bounding box's centre and a largest radius of 1; +y is up;
five elevations from -70 to 70 degrees by eight azimuths, azimuth 0 on +z; a vertical field of view of 40 degrees; the
silhouette of the unit sphere fills 90 % of the height; white albedo, or the colours of faces or vertices, under two
lights along +z and -z. A mesh with a texture is seen in the texture's own colours, without light.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from etsplat.core.cameras import Cameras, intrinsics, look_at, sphere_grid
from etsplat.core.errors import InputError
from etsplat.core.precision import usual_defaults
from etsplat.core.validation import check_count
from etsplat.data.dataset import Dataset, Normalization
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.measures import bounding_ball
from etsplat.io.mesh_files import MeshFile
from etsplat.io.textures import Texture
from etsplat.ops.rasterize_opaque import MAX_SUPERSAMPLING, rasterize_opaque, render_opaque

ELEVATIONS = (-70.0, -35.0, 0.0, 35.0, 70.0)
"""Degrees above the horizon."""

FIELD_OF_VIEW = 40.0
"""Vertical, degrees."""

FILL = 0.9
"""Part of the image height that the unit sphere's silhouette takes."""

AMBIENT, DIFFUSE = 0.4, 0.6

_STEEPEST = 1e-6
"""What is left of a line of sight, seen from above, where `look_at` no longer knows which side of a picture is up."""

CAMERA_DISTANCE = math.hypot(1.0, 1.0 / (FILL * math.tan(math.radians(FIELD_OF_VIEW / 2))))
"""A sphere of radius 1 at distance d has a silhouette of half-angle asin(1/d), whose tangent is 1/sqrt(d^2 - 1)."""


def normalize_mesh(mesh: MeshFile) -> tuple[MeshFile, Normalization]:
    """Move the bounding box's centre to the origin and scale the farthest vertex to radius 1.

    Raises:
        ValueError: it is no `MeshFile`.
        InputError: all vertices coincide.

    Example:
        >>> owl, placed = etsplat.normalize_mesh(etsplat.demo_object())
        >>> round(float(owl.vertices.norm(dim=1).max()), 4)
        1.0
    """
    if not isinstance(mesh, MeshFile):
        made = "etsplat.load_mesh reads one, etsplat.MeshFile(vertices, faces) makes one of tensors"
        raise ValueError(f"mesh must be a MeshFile, got {type(mesh).__name__}: {made}")
    center, radius = bounding_ball(mesh.vertices)
    if radius <= 0:
        raise InputError("mesh: all vertices are at one point; there is nothing to photograph")
    unit = ((mesh.vertices.double() - center) / radius).float()
    return replace(mesh, vertices=unit), Normalization(center.float(), radius)


@usual_defaults()
def photograph(
    mesh: MeshFile,
    width: int = 1024,
    height: int = 1024,
    *,
    elevations: Sequence[float] = ELEVATIONS,
    azimuths: int = 8,
    supersampling: int = 4,
    progress: Callable[[int, int], None] | None = None,
    device: torch.device | str = "cpu",
) -> Dataset:
    """Normalise a mesh and take its pictures. View index is `azimuths` * elevation + azimuth.

    Args:
        mesh: the object, in any units; in its texture, or else in its colours of faces, vertices or white under light.
        width: image width in pixels, at least `height` (the sphere is fitted to the height).
        height: image height in pixels.
        elevations: degrees, strictly between -90 and 90.
        azimuths: number of directions around +y, evenly spaced.
        supersampling: samples per pixel side.
        progress: called after each picture with (pictures taken, pictures in all).
        device: where the pictures are taken, before they come to the CPU.

    Returns:
        Views in the unit frame with float32 pictures; those with index % 5 == 2 are test views.

    Raises:
        ValueError: `width` below `height`, elevations that look along the vertical, a `supersampling` that is no
            integer from 1 to 16, or a mesh whose arrays do not belong together.
        InputError: as `normalize_mesh`.

    Example:
        >>> photos = etsplat.photograph(etsplat.demo_object(), 32, 32, elevations=(0.0,), azimuths=5, supersampling=1)
        >>> len(photos.cameras), photos.images[0].shape, list(photos.test)
        (5, torch.Size([32, 32, 4]), [2])
    """
    if width < height:
        raise ValueError(f"width: expected at least the height ({height}), got {width}")
    if not all(-90 < elevation < 90 for elevation in elevations):
        raise ValueError(f"elevations: expected degrees strictly between -90 and 90, got {list(elevations)}")
    supersampling = check_count("supersampling", supersampling, most=MAX_SUPERSAMPLING)
    unit, normalization = normalize_mesh(mesh)
    unit.check()
    cameras = orbit_cameras(width, height, elevations=elevations, azimuths=azimuths)
    vertices, faces = unit.vertices.to(device), unit.faces.to(device)
    texture = None if unit.texture is None else unit.texture.to(device)
    face_colors, corner_colors = (None if each is None else each.to(device) for each in _lit_colors(unit))
    images = []
    for view in range(len(cameras)):
        camera = cameras[view].to(device)
        if texture is None:
            image = render_opaque(
                vertices,
                face_colors=face_colors,
                corner_colors=corner_colors,
                cameras=camera,
                faces=faces,
                supersampling=supersampling,
            ).rgba[0]
        else:
            image = draw_textured(vertices, faces, texture, camera, supersampling)
        images.append(image.cpu())
        if progress is not None:
            progress(view + 1, len(cameras))
    names = [f"{view:03d}" for view in range(len(cameras))]
    test = [view for view in range(len(cameras)) if view % 5 == 2]
    train = [view for view in range(len(cameras)) if view % 5 != 2]
    return Dataset(
        cameras.viewmats.double(),
        cameras.Ks.double(),
        StoredPictures(images),
        names,
        train,
        test,
        normalization=normalization,
    )


def _lit_colors(mesh: MeshFile) -> tuple[Float[Tensor, "F 3"] | None, Float[Tensor, "F 3 3"] | None]:
    """Colours under the lights of a mesh without a texture: of its faces, or else of their corners."""
    light = shade_faces(mesh.vertices, mesh.faces)
    if mesh.face_colors is not None:
        return light * mesh.face_colors.to(light), None
    if mesh.vertex_colors is not None:
        return None, light[:, None] * mesh.vertex_colors.to(light)[mesh.faces]
    return light, None


def draw_textured(
    vertices: Float[Tensor, "V 3"],
    faces: Int64[Tensor, "F 3"],
    texture: Texture,
    camera: Cameras,
    supersampling: int,
) -> Float[Tensor, "H W 4"]:
    """One picture of a mesh in its texture's colours, premultiplied: the mean over a grid of samples in each pixel.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        texture: of these faces.
        camera: one.
        supersampling: samples along each axis of a pixel.
    """
    total = vertices.new_zeros((camera.height, camera.width, 4))
    steps = [0.5 - (step + 0.5) / supersampling for step in range(supersampling)]
    for down, across in itertools.product(steps, steps):
        Ks = camera.Ks.clone()
        Ks[:, 0, 2] += across
        Ks[:, 1, 2] += down
        seen = rasterize_opaque(vertices, cameras=replace(camera, Ks=Ks), faces=faces)
        assert seen.triangle is not None
        assert seen.barycentrics is not None
        triangle, weights = seen.triangle[0], seen.barycentrics[0]
        covered = (triangle.view(-1) >= 0).nonzero()[:, 0]
        colors = texture.colors(triangle.view(-1)[covered].long(), weights.view(-1, 3)[covered])
        total.view(-1, 4)[covered] += torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)
    return total / supersampling**2


def orbit_cameras(width: int, height: int, *, elevations: Sequence[float] = ELEVATIONS, azimuths: int = 8) -> Cameras:
    """Cameras on the sphere of radius CAMERA_DISTANCE that look at the origin, +y up; the azimuth varies fastest.

    Raises:
        ValueError: No elevation or azimuth, one straight above or below, or a size that is none of an image.

    Example:
        >>> len(etsplat.orbit_cameras(64, 64))
        40
    """
    azimuths = check_count("azimuths", azimuths)
    heights = torch.as_tensor(elevations, dtype=torch.float64)
    if not heights.numel() or not bool((heights.deg2rad().cos().abs() > _STEEPEST).all()):
        raise ValueError(f"elevations must be degrees, none of them straight above or below, got {elevations}")
    degrees = [360.0 * k / azimuths for k in range(azimuths)]
    eyes = sphere_grid(elevations, degrees, CAMERA_DISTANCE, dtype=torch.float64)
    viewmats = look_at(eyes, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    K = intrinsics(FIELD_OF_VIEW, width, height)
    return Cameras(viewmats.float(), K.expand(len(eyes), 3, 3).contiguous(), width, height)


def shade_faces(vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """White faces under ambient light and two directional lights along +z and -z, of which each face sees one.

    The colour is 0.4 + 0.6 |n_z| in all channels, n the unit face normal, whatever the orientation of the face.
    """
    corners = vertices.double()[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lambert = normals[:, 2].abs() / normals.norm(dim=1).clamp_min(1e-300)
    return (AMBIENT + DIFFUSE * lambert).float()[:, None].repeat(1, 3)
