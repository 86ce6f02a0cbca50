from dataclasses import replace

import pytest
import torch

from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.demo_object import demo_object
from etsplat.data.hull import axes_meeting_point, bounding_sphere
from etsplat.data.load import load_dataset
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile
from etsplat.ops.rasterize_opaque import render_opaque


@pytest.fixture(scope="module")
def owl_views():
    return photograph(demo_object(), 128, 128, supersampling=1)


def pictures(mesh, eyes, target, width=64, height=48, fov=50.0):
    viewmats = look_at(eyes, target, torch.tensor([0.0, 1.0, 0.05]))
    Ks = intrinsics(fov, width, height).repeat(len(eyes), 1, 1)
    images = render_opaque(
        mesh.vertices,
        cameras=Cameras(viewmats, Ks, width, height),
        faces=mesh.faces,
        face_colors=torch.ones(len(mesh.faces), 3),
    ).rgba
    names = [f"v{k}" for k in range(len(eyes))]
    return Dataset(viewmats.double(), Ks.double(), StoredPictures(images), names, list(range(len(eyes))), [])


def test_axes_that_meet_give_their_point():
    target = torch.tensor([0.4, -1.2, 3.0])
    eyes = target + torch.tensor([[3.0, 0, 0], [0, 0.5, 2], [-1, 1, 5], [2, 2, 2]])
    torch.testing.assert_close(
        axes_meeting_point(look_at(eyes, target, torch.tensor([0.0, 1, 0]))).float(), target, atol=1e-4, rtol=0
    )


def test_the_sphere_encloses_the_object_and_is_not_much_larger(owl_views):
    """The hull contains the object; its farthest point exceeds the object's by at most a tenth here."""
    center, radius = bounding_sphere(owl_views)
    vertices = owl_views.normalization.apply(demo_object().vertices)
    assert float(center.norm()) < 1e-4
    assert 1 <= radius < 1.1
    assert float((vertices - center).norm(dim=1).max()) <= radius


def test_the_sphere_follows_units_and_place():
    """An object far from the origin, a thousand times larger, off the cameras' common point."""
    vertices, faces = icosphere(3)
    mesh = MeshFile(300 * vertices + torch.tensor([5000.0, 100, 0]), faces)
    target = torch.tensor([5050.0, 100, 0])
    directions = icosphere(0)[0]
    views = pictures(mesh, target + 1500 * directions, target)
    center, radius = bounding_sphere(views)
    torch.testing.assert_close(center, target, atol=0.5, rtol=0)
    assert 350 <= radius < 400


def test_photos_of_different_sizes_and_of_bytes_give_the_same_sphere(owl_views):
    """Every second photo is half as large; then all are bytes."""
    center, radius = bounding_sphere(owl_views)
    half = owl_views.halved()
    chosen = [(half if index % 2 else owl_views) for index in range(len(owl_views))]
    Ks = torch.stack([dataset.Ks[index] for index, dataset in enumerate(chosen)])
    photos = [dataset.images[index] for index, dataset in enumerate(chosen)]
    mixed = replace(owl_views, Ks=Ks, images=StoredPictures(photos))
    for dataset in (mixed, replace(mixed, images=StoredPictures([(255 * photo).byte() for photo in photos]))):
        there, reach = bounding_sphere(dataset)
        torch.testing.assert_close(there, center, atol=1e-6, rtol=0)
        assert reach == pytest.approx(radius, rel=0.02)


def test_the_sphere_of_the_shared_lego_covers_every_silhouette(shared_data):
    """A mask pixel is explained by the sphere only if its viewing ray passes through it: true of all of them."""
    views = load_dataset(shared_data / "scenes" / "lego_blender", masks_as="alpha", width=100)
    center, radius = bounding_sphere(views)
    assert 1.1 < radius < 1.6  # the model's farthest corner is about 1.4 from the origin
    for index in range(0, len(views), 5):
        row, column = (views.images[index][..., 3] > 0.5).nonzero().T
        pixel = torch.stack([column + 0.5, row + 0.5, torch.ones(len(row))], dim=1)
        viewmat = views.viewmats[index].float()
        ray = torch.nn.functional.normalize(pixel @ torch.linalg.inv(views.Ks[index].float()).T, dim=1)
        middle = viewmat[:3, :3] @ center + viewmat[:3, 3]
        assert float(torch.linalg.cross(ray, middle.expand_as(ray)).norm(dim=1).max()) <= radius


def test_views_without_masks_or_with_an_empty_or_full_mask_are_refused(owl_views):
    def with_alpha(index, value):
        images = torch.stack(list(owl_views.images))
        images[index, ..., 3] = value
        return replace(owl_views, images=StoredPictures(images))

    with pytest.raises(InputError, match="neither transparency nor masks, or these are white all over"):
        bounding_sphere(with_alpha(slice(None), 1.0))
    with pytest.raises(InputError, match="view 005: its mask is empty"):
        bounding_sphere(with_alpha(5, 0.0))
    with pytest.raises(InputError, match="view 009: its mask covers the whole image"):
        bounding_sphere(with_alpha(9, 1.0))


def test_cameras_that_cannot_work_are_refused(owl_views):
    mesh = MeshFile(*icosphere(2))
    eyes = 4 * icosphere(0)[0]
    inside = pictures(mesh, torch.cat([eyes, torch.tensor([[0.0, 0, 0.2]])]), torch.zeros(3))
    inside.images[-1][:10] = 0  # a hole in the wall, or the mask would cover the whole image
    with pytest.raises(InputError, match="view v12: its camera is inside the object"):
        bounding_sphere(inside)
    photos = StoredPictures(list(inside.images)[:2])
    away = Dataset(inside.viewmats[:2], inside.Ks[:2], photos, ["a", "b"], [0, 1], [])
    flipped = away.viewmats.clone()
    flipped[1, :3] = torch.diag(torch.tensor([-1.0, 1, -1], dtype=torch.float64)) @ flipped[1, :3]
    with pytest.raises(InputError, match="looks away"):
        bounding_sphere(replace(away, viewmats=flipped))
    parallel = away.viewmats[:1].repeat(2, 1, 1)
    parallel[1, 0, 3] += 1
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    with pytest.raises(InputError, match="all cameras look away from the object; the poses have other axes"):
        bounding_sphere(replace(owl_views, viewmats=flip @ owl_views.viewmats))
    with pytest.raises(InputError, match="views: 1 to train on; an object needs photos from around it"):
        bounding_sphere(replace(away, train=[0], test=[1]))
    with pytest.raises(InputError, match="parallel"):
        bounding_sphere(replace(away, viewmats=parallel))


def test_masks_that_contradict_the_poses_are_refused(owl_views):
    """Masks mirrored in half of the views, far off the axis, leave no common point."""
    images = torch.zeros(len(owl_views), 128, 128, 4)
    images[:, :6, :6] = 1
    with pytest.raises(InputError, match="no point in common"):
        bounding_sphere(replace(owl_views, images=StoredPictures(images)))
