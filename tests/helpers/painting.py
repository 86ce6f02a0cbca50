"""Photos of painted surfaces: what agrees between them is known."""

from dataclasses import replace

import torch

from etsplat.data.dataset import Dataset
from etsplat.data.photograph import orbit_cameras, photograph
from etsplat.data.photos import first_hits, photos_of
from etsplat.data.pictures import StoredPictures
from etsplat.io.mesh_files import MeshFile
from etsplat.ops.rasterize_opaque import render_opaque


def painted_pictures(
    vertices: torch.Tensor, faces: torch.Tensor, *, painted: bool = True
) -> tuple[torch.Tensor, torch.Tensor, Dataset]:
    """Vertices and faces in the frame of the views, and the views: of one colour, or with soft spots."""
    views = photograph(MeshFile(vertices, faces), 160, 160, supersampling=2)
    unit = views.normalization.apply(vertices)
    waves = 8 * torch.randn(3, 3, 4, generator=torch.Generator().manual_seed(1))
    phases = torch.einsum("fk,kcw->fcw", unit[faces].mean(dim=1), waves) * float(painted)
    images = render_opaque(
        unit,
        face_colors=0.5 + 0.4 * phases.sin().mean(dim=2),
        cameras=orbit_cameras(160, 160),
        faces=faces,
        supersampling=2,
    ).rgba
    return unit, faces, replace(views, images=StoredPictures(list(images)))


def mean_colors(views: Dataset, vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """(F, 3) of each face, what the training photos show there in the mean."""
    sums = torch.zeros(len(faces), 4)
    for photo in photos_of(views):
        hit = first_hits(photo, vertices, faces)[1]
        at = (hit >= 0) & (photo.pixels[0, 3] > 0.95)
        sums.index_add_(0, hit[at], torch.cat([torch.ones(int(at.sum()), 1), photo.pixels[0, :3, at].T], dim=1))
    return sums[:, 1:] / sums[:, :1].clamp_min(1)
