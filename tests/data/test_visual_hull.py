from dataclasses import replace

import pytest
import torch

import etsplat.data.visual_hull as visual_hull_module
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.data.visual_hull import outside_hull, visual_hull, without_specks
from etsplat.geometry.distance import closest_points
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.parts import face_parts, genera
from etsplat.geometry.topology import MeshTopology
from etsplat.io.mesh_files import MeshFile
from helpers.meshes import ring_and_ball


@pytest.fixture(scope="module")
def object_and_views():
    """Two parts, one hole; in the unit ball around the origin."""
    mesh = ring_and_ball(0.12)
    views = photograph(mesh, 160, 160, supersampling=2)
    return views.normalization.apply(mesh.vertices), mesh.faces, views


def test_the_hull_has_the_holes_and_parts_of_the_object(object_and_views):
    """A convex section all around: the hull is the object up to a cell; closed, oriented outwards, as fine as asked."""
    vertices, faces, views = object_and_views
    found, triangles = visual_hull(views, 4000)
    topology = MeshTopology.from_faces(triangles, len(found))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()
    assert genera(triangles, len(found)) == [1, 0]
    assert 3000 < len(triangles) < 5000
    a, b, c = found[triangles].unbind(1)
    assert float((a * torch.linalg.cross(b, c)).sum()) > 0
    assert float(closest_points(found, vertices, faces)[0].max()) < 0.05


def test_what_one_mask_of_few_excludes_is_outside(object_and_views):
    """One mask loses the upper half of its picture: no vertex is seen there, but for a cell's width.

    Of five views nobody can say which is wrong; of more, it would be outvoted.
    """
    _, _, views = object_and_views
    views = replace(views, train=views.train[:20:4])
    first = views.train[0]
    images = [image.clone() for image in views.images]
    half = len(images[first]) // 2
    assert images[first][: half - 10, :, 3].any()
    images[first][:half] = 0
    found, _ = visual_hull(replace(views, images=StoredPictures(images)), 4000)
    camera = found @ views.viewmats[first, :3, :3].float().T + views.viewmats[first, :3, 3].float()
    rows = (camera @ views.Ks[first].float().T)[:, 1] / camera[:, 2]
    assert len(found) > 1000
    assert float(rows.min()) > half - 3


def test_silhouettes_without_a_common_point_leave_nothing(object_and_views):
    _, _, views = object_and_views
    images = [image.clone() for image in views.images]
    for index in views.train[:3]:
        images[index][:] = 0
    vertices, triangles = visual_hull(replace(views, images=StoredPictures(images)), 4000)
    assert vertices.shape == (0, 3)
    assert triangles.shape == (0, 3)


def test_a_hull_that_touches_itself_is_taken_apart():
    """As wings and ears of the owl do where the grid is coarse: edges had four faces."""
    found, triangles = visual_hull(photograph(demo_object(), 64, 64, supersampling=2), 4000)
    topology = MeshTopology.from_faces(triangles, len(found))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()


@pytest.mark.parametrize(("away", "parts"), [(1.4, 2), (0.98, 1)])
def test_a_small_part_that_photos_show_apart_stays(away: float, parts: int):
    """A ball of a hundredth of the surface; one whose gap is below what the grid tells apart is a bit of the large."""
    v, f = icosphere(3)
    ball = 0.08 * v + torch.tensor([away, 0.0, 0.0])
    views = photograph(MeshFile(torch.cat([0.9 * v, ball]), torch.cat([f, f + len(v)])), 160, 160, supersampling=2)
    found, triangles = visual_hull(views, 8000)
    assert len(genera(triangles, len(found))) == parts


def test_what_was_a_part_before_a_cut_is_no_speck_after_it():
    large, small = ring_and_ball(0.12), icosphere(2)
    vertices = torch.cat([large.vertices, 0.05 * small[0] + torch.tensor([0.0, 0.0, -0.6])])
    faces = torch.cat([large.faces, small[1] + len(large.vertices)])
    views = photograph(MeshFile(vertices, faces), 160, 160, supersampling=2)
    found, triangles = visual_hull(views, 8000)
    assert len(genera(triangles, len(found))) == 3
    _, kept = without_specks(found, triangles, least=int(face_parts(triangles, len(found)).bincount().min()))
    assert len(kept) == len(triangles)
    assert len(without_specks(found, triangles)[1]) < len(triangles)


def test_what_is_free_is_asked_near_the_hull_alone_and_its_surface_is_the_same(
    object_and_views, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, _, views = object_and_views
    asked, found = [0, 0], []
    for turn, out in enumerate((visual_hull_module._OUT, torch.inf)):
        monkeypatch.setattr(visual_hull_module, "_OUT", out)

        def free(points: torch.Tensor, turn: int = turn) -> torch.Tensor:
            asked[turn] += len(points)
            return 0.3 - (points - torch.tensor([0.0, 0.8, 0.0])).norm(dim=1)

        found.append(visual_hull(views, 1000, free=free))
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
    assert asked[0] < 0.5 * asked[1]


def test_what_is_free_within_the_hull_is_no_part_of_its_surface(object_and_views):
    """Nobody sees into it."""
    _, _, views = object_and_views
    places = 2 * torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) - 1
    depth, deepest = (-outside_hull(views)(places)).max(dim=0)
    found, triangles = visual_hull(
        views, 4000, free=lambda points: 0.6 * depth - (points - places[deepest]).norm(dim=1)
    )
    assert genera(triangles, len(found)) == [1, 0]
