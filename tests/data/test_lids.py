"""A bowl of one sheet, open below, and a lid across it: photos look through the lid onto the inner side."""

from dataclasses import replace

import pytest
import torch

from etsplat import _native
from etsplat.core.cameras import Cameras
from etsplat.data.agreement import differences, per_pixel
from etsplat.data.dataset import Dataset
from etsplat.data.lids import _without_gaps, lids, without_lids
from etsplat.data.photograph import photograph, shade_faces
from etsplat.data.photos import first_hits, photos_of
from etsplat.data.pictures import StoredPictures
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.topology import MeshTopology
from etsplat.io.mesh_files import MeshFile
from etsplat.ops.rasterize_opaque import rasterize_opaque
from helpers.painting import mean_colors

BRIM = -0.4


def photos_and_lid(*, opened: bool) -> tuple[Dataset, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Photos of a flat-bottomed ball with or without its bottom; the whole ball, and which faces are its bottom."""
    vertices, faces = icosphere(4)
    vertices[:, 1] = vertices[:, 1].clamp_min(BRIM)
    bottom = (vertices[faces][:, :, 1] <= BRIM).all(dim=1)
    views = photograph(MeshFile(vertices, faces[~bottom] if opened else faces), 160, 160, supersampling=2)
    return views, views.normalization.apply(vertices), faces, bottom


def test_a_lid_is_found_and_nothing_else() -> None:
    views, vertices, faces, bottom = photos_and_lid(opened=True)
    found = lids(views)(vertices, faces, mean_colors(views, vertices, faces))
    assert found[bottom].float().mean() > 0.75
    assert found[~bottom].float().mean() < 0.01


def test_a_bottom_that_photos_show_is_no_lid_nor_is_what_is_left_of_an_open_surface() -> None:
    views, vertices, faces, _ = photos_and_lid(opened=False)
    assert not lids(views)(vertices, faces, mean_colors(views, vertices, faces)).any()
    views, vertices, faces, bottom = photos_and_lid(opened=True)
    assert not lids(views)(vertices, faces[~bottom], mean_colors(views, vertices, faces[~bottom])).any()


def test_a_patch_that_a_quarter_of_the_photos_show_is_no_lid() -> None:
    """As of what is glossy: the other photos' colours are by chance nearer to those of what is behind."""
    views, vertices, faces, bottom = photos_and_lid(opened=True)
    closed, *_ = photos_and_lid(opened=False)
    colors = mean_colors(views, vertices, faces)
    colors[bottom] = mean_colors(closed, vertices, faces)[bottom]
    below = sorted((view for view in views.train if views.centers[view, 1] < -0.5), key=lambda k: -views.centers[k, 1])
    pictures = list(views.images)
    for view in below[: len(below) // 4 + 1]:  # at a slant, which have the fewest pixels of it
        pictures[view] = closed.images[view]
    mixed = replace(views, images=StoredPictures(pictures))
    assert lids(views)(vertices, faces, colors)[bottom].float().mean() > 0.75
    assert not lids(mixed)(vertices, faces, colors).any()


def test_what_two_photos_see_is_no_lid() -> None:
    views, vertices, faces, _ = photos_and_lid(opened=True)
    colors = mean_colors(views, vertices, faces)
    below = [view for view in views.train if views.centers[view, 1] < -0.5]
    for left, found in ((5, True), (2, False)):
        fewer = replace(views, train=[view for view in views.train if view not in below[left:]])
        assert bool(lids(fewer)(vertices, faces, colors).any()) == found


def test_photos_are_compared_as_they_were_exposed() -> None:
    """In photos that were exposed for less a side may look like what is behind it: holes were cut into a figure."""
    for opened in (False, True):
        views, vertices, faces, bottom = photos_and_lid(opened=opened)
        colors = torch.where(bottom[:, None], 0.5, 0.25).repeat(1, 3)
        there = (~bottom).nonzero()[:, 0] if opened else torch.arange(len(faces))
        drawn = [rasterize_opaque(vertices, faces=faces[there], cameras=each).triangle for each in views.cameras]
        hits = [triangle[0].long() for triangle in drawn if triangle is not None]
        gains = [0.5 if float(center[1]) < -0.5 else 1.0 for center in views.centers]
        pictures = [
            torch.cat([gain * colors[there[hit.clamp_min(0)]], torch.ones(*hit.shape, 1)], dim=2)
            * (hit >= 0)[..., None]
            for hit, gain in zip(hits, gains, strict=True)
        ]
        exposed = replace(views, images=StoredPictures(pictures))
        matrices = {view: gains[view] * torch.eye(3) for view in views.train}
        as_it_is, told = (lids(exposed, how)(vertices, faces, colors) for how in (None, lambda known=matrices: known))
        assert as_it_is.any()
        assert bool(told.any()) == opened
        assert told[~bottom].float().mean() < 0.05  # the brim, where all is of one colour


def test_a_hull_loses_its_lid_and_one_without_stays_as_it_is() -> None:
    views, vertices, faces, bottom = photos_and_lid(opened=True)
    found, kept = without_lids(views, vertices, faces)
    topology = MeshTopology.from_faces(kept, len(found))
    assert topology.is_manifold()
    assert not topology.is_closed()
    assert abs(len(kept) - int((~bottom).sum())) < 0.25 * int(bottom.sum())
    assert found[:, 1].amin() > vertices[:, 1].amin() - 1e-6
    views, vertices, faces, _ = photos_and_lid(opened=False)
    same = without_lids(views, vertices, faces)
    assert torch.equal(same[0], vertices)
    assert torch.equal(same[1], faces)


def test_a_lid_of_which_the_inner_side_looks_otherwise_stays() -> None:
    """A hollow with walls of its own: black inside, white outside."""
    views, vertices, faces, bottom = photos_and_lid(opened=True)
    colors = mean_colors(views, vertices, faces)
    colors[~bottom] = 1 - shade_faces(vertices, faces)[~bottom]
    assert not lids(views)(vertices, faces, colors)[bottom].any()


def test_differences_are_of_the_pixels_that_show_a_face() -> None:
    views, vertices, faces, _ = photos_and_lid(opened=False)
    colors = shade_faces(vertices, faces)
    photo = photos_of(views)[0]
    hit = first_hits(photo, vertices, faces)[1]
    sums = differences(photo, hit, [hit], colors)
    seen = hit[(hit >= 0) & (photo.pixels[0, 3] > 0.95)].unique()
    assert torch.equal(sums[:, 0].nonzero()[:, 0], seen)
    pairs = MeshTopology.from_faces(faces, len(vertices)).face_pairs.long()
    assert per_pixel(sums, pairs)[seen, 0].median() < 0.01  # its own colours, but for the brim
    wrong = per_pixel(differences(photo, hit, [hit], (colors - 0.2).clamp_min(0)), pairs)[seen, 0]
    assert wrong.median() == pytest.approx(0.2, abs=0.02)


def test_a_gap_in_a_lid_belongs_to_it_and_what_is_beside_it_does_not() -> None:
    vertices, faces = icosphere(4)
    middle = vertices[faces].mean(dim=1)
    cap = middle[:, 1] > 0.5
    gap = cap & (middle[:, 0].abs() < 0.06)
    whole = _without_gaps(cap & ~gap, faces)
    inner = middle[:, 1] > 0.6
    assert gap[inner].sum() > 20
    assert whole[inner].all()
    assert whole[~cap].float().mean() < 0.005  # at the ends of the gap


def test_lines_of_sight_enter_and_leave_as_two_drawings_say() -> None:
    generator = torch.Generator().manual_seed(0)
    vertices, faces = icosphere(3)
    vertices = vertices * (0.7 + 0.6 * torch.rand(len(vertices), 1, generator=generator))  # spikes, so several layers
    faces = faces[len(faces) // 4 :]  # so that backs are seen
    colors = torch.rand(len(faces), 3, generator=generator)
    backs_seen = 0
    for photo in photos_of(photograph(MeshFile(vertices, faces), 70, 60, elevations=(20.0,), azimuths=4)):
        corners = vertices[faces]
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        turned = ((corners[:, 0] - photo.center) * normals).sum(dim=1) > 0
        camera = Cameras(photo.viewmat[None], photo.K[None], 70, 60)
        front = rasterize_opaque(vertices, faces=faces, cameras=camera)
        assert front.triangle is not None
        assert front.depth is not None
        assert torch.equal(first_hits(photo, vertices, faces)[1], front.triangle[0].long())
        assert torch.equal(first_hits(photo, vertices, faces)[0], front.depth[0, ..., 0])
        nearest = front.triangle[0].long()
        backs = rasterize_opaque(vertices, faces=faces[turned], cameras=camera).triangle
        assert backs is not None
        behind = backs[0].long()
        both = (nearest >= 0) & ~turned[nearest.clamp_min(0)] & (behind >= 0)
        entered, left = torch.empty_like(nearest), torch.empty_like(nearest)
        _native.enter_and_leave(**photo.drawing(vertices, faces), turned=turned, entered=entered, left=left)
        assert both.sum() > 300
        backs_seen += int((turned[nearest.clamp_min(0)] & (nearest >= 0)).sum())
        assert torch.equal(entered, torch.where(both, nearest, -1))
        assert torch.equal(left, torch.where(both, turned.nonzero()[:, 0][behind.clamp_min(0)], -1))

        at = (entered >= 0) & (photo.pixels[0, 3] > 0.95)
        errors = [(photo.pixels[0, :3, at].T - colors[shown[at]]).abs().mean(dim=1) for shown in (entered, left)]
        columns = torch.stack([torch.ones(len(errors[0])), *errors], dim=1)
        expected = torch.zeros(len(faces), 3).index_add(0, entered[at], columns)
        torch.testing.assert_close(differences(photo, entered, [entered, left], colors), expected)
    assert backs_seen > 5
