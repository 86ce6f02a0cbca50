"""Rough, bitten and exact masks of a ring and a ball beside it, and how they are intersected."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter

from etsplat.core.cameras import Cameras, look_at
from etsplat.data.carving import Carving
from etsplat.data.dataset import Dataset
from etsplat.data.hull import bounding_sphere
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.data.silhouettes import Silhouette, contradicting, silhouette
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.distance import closest_points
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.parts import genera
from etsplat.io.mesh_files import MeshFile
from etsplat.ops.rasterize_opaque import render_opaque
from helpers.meshes import ring_and_ball

Mask = np.ndarray


@pytest.fixture(scope="module")
def ring() -> MeshFile:
    return ring_and_ball(0.09)


@pytest.fixture(scope="module")
def views(ring: MeshFile) -> Dataset:
    """In the unit ball around the origin."""
    return photograph(ring, 160, 160, supersampling=2)


def spoilt(views: Dataset, change: Callable[[Mask, int], Mask]) -> Dataset:
    images = [image.clone() for image in views.images]
    for index in views.train:
        before = silhouette(images[index])
        if (after := change(before, index)) is not before:
            images[index][..., 3] = torch.from_numpy(after).float()
    return replace(views, images=StoredPictures(images))


def ragged(mask: Mask, index: int) -> Mask:
    """The outline wanders by a pixel and a half, otherwise in every view."""
    noise = gaussian_filter(np.random.default_rng(index).standard_normal(mask.shape), 4)
    distance = np.asarray(distance_transform_edt(mask)) - np.asarray(distance_transform_edt(~mask))
    return distance + 1.5 * noise / noise.std() > 0


def bitten(mask: Mask, index: int) -> Mask:
    """One photo in ten lacks a disc somewhere on its outline."""
    if index % 10 != 4:
        return mask
    rows, columns = np.nonzero(mask)
    middle = np.random.default_rng(index).integers(len(rows))
    y, x = np.ogrid[: mask.shape[0], : mask.shape[1]]
    return mask & ((y - rows[middle]) ** 2 + (x - columns[middle]) ** 2 > 9**2)


def rule_of(views: Dataset) -> Carving:
    return Carving.of([Silhouette(views, index) for index in views.train], torch.zeros(3), 1.0)


def test_exact_masks_are_intersected_as_they_are(views: Dataset) -> None:
    assert rule_of(views) == Carving()


def test_masks_that_all_grow_agree(views: Dataset) -> None:
    def grown(mask: Mask, _: int) -> Mask:
        return np.asarray(distance_transform_edt(~mask)) <= 2

    assert rule_of(spoilt(views, grown)) == Carving()


def test_ragged_masks_grow_by_less_than_they_wander(views: Dataset) -> None:
    found = rule_of(spoilt(views, ragged))
    assert found.grown > 0 or found.outvoted > 0
    assert found.grown < 3


def test_of_bitten_masks_each_is_outvoted(views: Dataset, ring: MeshFile) -> None:
    """Nobody is left out, and what one photo lacks the hull has: its parts, and every point of the object."""
    some = spoilt(views, bitten)
    assert contradicting(some) == []
    assert rule_of(some).outvoted > 0
    vertices, faces = visual_hull(some, 6000)
    assert genera(faces, len(vertices)) == [1, 0]
    assert float(closest_points(views.normalization.apply(ring.vertices), vertices, faces)[0].max()) < 0.01


def test_the_sphere_around_the_object_holds_what_one_photo_lacks(views: Dataset) -> None:
    """The ball beside the ring, which is the farthest out, lacks its outer half in two photos."""
    where = torch.tensor([0.0, 0.0, 0.75])

    def without_tip(mask: Mask, index: int) -> Mask:
        if index not in views.train[3:5]:
            return mask
        camera = (
            views.viewmats[index, :3, :3] @ views.normalization.apply(where).double() + views.viewmats[index, :3, 3]
        )
        tip = (views.Ks[index] @ camera)[:2] / camera[2]
        y, x = np.ogrid[: mask.shape[0], : mask.shape[1]]
        return mask & ((y - float(tip[1])) ** 2 + (x - float(tip[0])) ** 2 > 9**2)

    whole, bitten = bounding_sphere(views), bounding_sphere(spoilt(views, without_tip))
    assert bitten[1] > 0.99 * whole[1]


@pytest.mark.parametrize("outvoted", [0, 1])
def test_depth_in_the_hull_leaves_out_the_outvoted(views: Dataset, outvoted: int) -> None:
    """A mask that is empty counts as long as nobody outvotes it; farther than anyone looks nobody judges."""
    every = views.train
    images = [image.clone() for image in views.images]
    images[every[0]][..., 3] = 0
    silhouettes = [Silhouette(replace(views, images=StoredPictures(images)), index) for index in every]
    inside, away = torch.tensor([[0.0, 0.0, 0.0]]), torch.tensor([[50.0, 0.0, 0.0]])
    of_ball = views.normalization.apply(torch.tensor([[0.0, 0.0, 0.6]]))
    assert (float(Carving(outvoted).depth(silhouettes, of_ball)) > 0) == (outvoted > 0)
    assert float(Carving(outvoted).depth(silhouettes, inside)) < 0
    few = [view for view in silhouettes if float((away @ view.viewmat[:3, :3].T + view.viewmat[:3, 3])[0, 2]) <= 0]
    assert float(Carving(outvoted).depth(few, away)) == -torch.inf


def test_what_few_photos_show_within_their_frames_is_in_the_hull() -> None:
    """Close photos of something tall: none shows all of it, and its ends are in the frames of a fifth of them."""
    vertices, faces = icosphere(4)
    tall = vertices * torch.tensor([0.3, 1.0, 0.3])
    turns = torch.arange(8) * torch.pi / 4
    heights = torch.tensor([-0.8, -0.4, 0.0, 0.4, 0.8])
    turn, height = (axis.flatten() for axis in torch.meshgrid(turns, heights, indexing="ij"))
    eyes = torch.stack([3 * turn.cos(), height, 3 * turn.sin()], dim=1)
    targets = torch.stack([0 * height, height, 0 * height], dim=1)
    viewmats = look_at(eyes, targets, torch.tensor([0.0, 1.0, 0.0]))
    Ks = torch.tensor([[200.0, 0, 32], [0, 200.0, 32], [0, 0, 1]]).expand(40, 3, 3)
    drawn = render_opaque(
        tall, cameras=Cameras(viewmats, Ks, 64, 64), faces=faces, face_colors=torch.ones(len(faces), 3)
    )
    names = [f"{index:02d}" for index in range(40)]
    close = Dataset(viewmats, Ks, StoredPictures(list(drawn.rgba)), names, train=list(range(40)), test=[])
    assert rule_of(close).quorum < 0.5
    hull, _ = visual_hull(close, 4000)
    assert float(hull[:, 1].max()) > 0.9
    assert float(hull[:, 1].min()) < -0.9
    assert float(hull[:, [0, 2]].norm(dim=1).max()) < 0.4
    center, radius = bounding_sphere(close)
    assert 0.95 < radius + float(center.norm()) < 1.3
