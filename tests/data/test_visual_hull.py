from dataclasses import replace

import pytest
import torch
import trimesh

from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.distance import closest_points
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.parts import genera
from etsplat.geometry.topology import MeshTopology
from etsplat.io.mesh_files import MeshFile


@pytest.fixture(scope="module")
def ring_and_ball():
    """A torus with a ball beside it: two parts, one hole; in the unit ball around the origin."""
    ring = trimesh.creation.torus(0.5, 0.12, major_sections=48, minor_sections=24)
    v, f = icosphere(3)
    w = torch.from_numpy(ring.vertices.copy()).float()
    vertices = torch.cat([w, 0.15 * v + torch.tensor([0.0, 0.0, 0.6])])
    faces = torch.cat([torch.from_numpy(ring.faces.copy()).long(), f + len(w)])
    views = photograph(MeshFile(vertices, faces), 160, 160, supersampling=2)
    return views.normalization.apply(vertices), faces, views


def test_the_hull_has_the_holes_and_parts_of_the_object(ring_and_ball):
    """A convex section all around: the hull is the object up to a cell; closed, oriented outwards, as fine as asked."""
    vertices, faces, views = ring_and_ball
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


def test_what_one_mask_excludes_is_outside(ring_and_ball):
    """One mask loses the upper half of its picture: no vertex is seen there, but for a cell's width."""
    _, _, views = ring_and_ball
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


def test_silhouettes_without_a_common_point_leave_nothing(ring_and_ball):
    _, _, views = ring_and_ball
    images = [image.clone() for image in views.images]
    images[views.train[0]][:] = 0
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
