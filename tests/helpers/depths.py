"""A ball with true depth maps beside its photos."""

from dataclasses import replace

import torch

from etsplat.data.dataset import Dataset
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile
from etsplat.ops.rasterize_opaque import rasterize_opaque


def ball_with_depths(side: int = 48, azimuths: int = 12, change=lambda depth, view: depth) -> Dataset:
    """A ball of radius 1 in soft colours from all around, its points, and depth maps, changed by a function."""
    vertices, faces = icosphere(3)
    colors = 0.5 + 0.4 * vertices[faces].mean(dim=1)
    views = photograph(
        MeshFile(vertices, faces, face_colors=colors), side, side, elevations=(-30.0, 20.0), azimuths=azimuths
    )
    depths = []
    for index in range(len(views)):
        drawn = rasterize_opaque(vertices, cameras=views.cameras[index], faces=faces).depth
        assert drawn is not None
        depths.append(change(drawn[0, ..., 0], index))
    pictures = StoredPictures(list(views.images), depths=depths)
    return replace(views, images=pictures, exact_points=vertices.double(), point_colors=torch.full_like(vertices, 0.5))
