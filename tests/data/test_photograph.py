import math
from dataclasses import replace

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.demo_object import demo_object
from etsplat.data.photograph import CAMERA_DISTANCE, normalize_mesh, orbit_cameras, photograph, shade_faces
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile, load_mesh
from etsplat.io.textures import Texture
from etsplat.tasks.sources import fingerprint


@pytest.fixture(scope="module")
def sphere():
    return MeshFile(*icosphere(5))


@pytest.fixture(scope="module")
def sphere_views(sphere):
    return photograph(sphere, 96, 96)


def test_normalisation_centres_the_bounding_box_and_scales_the_farthest_vertex_to_1():
    mesh = demo_object()
    unit, normalization = normalize_mesh(mesh)
    torch.testing.assert_close(unit.vertices.amin(0), -unit.vertices.amax(0), atol=1e-6, rtol=0)
    assert float(unit.vertices.norm(dim=1).max()) == pytest.approx(1, abs=1e-6)
    torch.testing.assert_close(normalization.invert(unit.vertices), mesh.vertices, atol=1e-6, rtol=0)
    torch.testing.assert_close(normalization.apply(mesh.vertices), unit.vertices, atol=1e-6, rtol=0)


def test_the_unit_sphere_fills_nine_tenths_of_the_height(sphere_views):
    """Rows that the sphere covers, over the height; the centre column sees the full silhouette."""
    column = sphere_views.images[16][:, 47:49, 3].mean(dim=1)
    assert float(column.sum()) / 96 == pytest.approx(0.9, abs=0.005)
    assert math.tan(math.asin(1 / CAMERA_DISTANCE)) == pytest.approx(0.9 * math.tan(math.radians(20)))


def test_views_run_through_azimuths_first_with_plus_y_up():
    cameras = orbit_cameras(64, 64)
    torch.testing.assert_close(cameras.centers.norm(dim=1), torch.full((40,), CAMERA_DISTANCE))
    elevation = torch.rad2deg(torch.asin(cameras.centers[:, 1] / CAMERA_DISTANCE)).reshape(5, 8)
    torch.testing.assert_close(
        elevation, torch.tensor([-70.0, -35, 0, 35, 70])[:, None].expand(5, 8), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(cameras.centers[16], torch.tensor([0, 0, CAMERA_DISTANCE]), atol=1e-5, rtol=0)
    torch.testing.assert_close(cameras.centers[18], torch.tensor([CAMERA_DISTANCE, 0, 0]), atol=1e-5, rtol=0)
    down_in_image = cameras.viewmats[:, 1, :3]
    assert bool((down_in_image[:, 1] < -0.3).all())


def test_every_fifth_view_from_the_third_is_held_out(sphere_views):
    assert sphere_views.test == [2, 7, 12, 17, 22, 27, 32, 37]
    assert sphere_views.train == [view for view in range(40) if view % 5 != 2]
    assert sphere_views.names[7] == "007"


def test_colours_are_ambient_plus_diffuse_along_z_whatever_the_orientation(sphere):
    vertices, faces = sphere.vertices, sphere.faces
    shade = shade_faces(vertices, faces)
    centroid = torch.nn.functional.normalize(vertices[faces].mean(1), dim=1)
    torch.testing.assert_close(shade[:, 0], 0.4 + 0.6 * centroid[:, 2].abs(), atol=2e-3, rtol=0)
    assert torch.equal(shade_faces(vertices, faces.flip(1)), shade)


def test_pixels_are_the_shade_times_coverage(sphere_views):
    """From +z the middle of the sphere is lit fully; from +x its middle has only the ambient light."""
    torch.testing.assert_close(sphere_views.images[16][48, 48], torch.ones(4), atol=2e-3, rtol=0)
    torch.testing.assert_close(sphere_views.images[18][48, 48], torch.tensor([0.4, 0.4, 0.4, 1]), atol=0.02, rtol=0)
    color, alpha = torch.stack(list(sphere_views.images)).split([3, 1], dim=-1)
    assert bool((color <= alpha + 1e-6).all())
    assert bool((color >= 0.4 * alpha - 1e-6).all())
    edge = (alpha > 0) & (alpha < 1)
    assert 0.01 < float(edge.float().mean()) < 0.1


def test_the_picture_does_not_depend_on_units_or_place(sphere):
    moved = MeshFile(sphere.vertices * 250 + torch.tensor([1000.0, -20, 5]), sphere.faces)
    one = photograph(sphere, 48, 48, elevations=(10.0,), azimuths=2)
    other = photograph(moved, 48, 48, elevations=(10.0,), azimuths=2)
    assert float((one.images[0] - other.images[0]).abs().mean()) < 1e-4
    assert other.normalization.radius == pytest.approx(250, rel=1e-4)


def test_progress_counts_the_pictures(sphere):
    seen = []
    photograph(sphere, 16, 16, elevations=(0.0,), azimuths=3, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_a_mesh_at_one_point_and_impossible_views_are_refused(sphere):
    with pytest.raises(InputError, match="one point"):
        normalize_mesh(MeshFile(torch.ones(3, 3), torch.tensor([[0, 1, 2]])))
    with pytest.raises(ValueError, match="elevations"):
        photograph(sphere, 16, 16, elevations=(90.0,))
    with pytest.raises(ValueError, match="width"):
        photograph(sphere, 16, 32)
    with pytest.raises(ValueError, match=r"mesh must be a MeshFile, got str: etsplat\.load_mesh reads one"):
        photograph("ball.obj", 16, 16)


def test_the_shared_koala_stands_upright_in_its_front_view(shared_data):
    """Paws at the bottom, ears at the top: the widest part of the upper half is the ears', above the middle."""
    views = photograph(load_mesh(shared_data / "famous" / "koala.obj"), 64, 64, elevations=(0.0,), azimuths=1)
    rows = views.images[0][..., 3].sum(dim=1)
    assert int(rows.argmax()) < 32


def test_a_textured_mesh_is_photographed_in_the_colours_of_its_texture():
    """A cube, each side a picture of four colours: seen from the front they are in their places, to the bit, unlit."""
    corners = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    front = torch.tensor([[1, 5, 7], [1, 7, 3]])
    others = torch.tensor([[0, 2, 6], [0, 6, 4], [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]])
    faces = torch.cat([front, others, torch.tensor([[2, 3, 7], [2, 7, 6]])])
    pixels = torch.tensor([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], dtype=torch.uint8)
    uvs = 0.5 + 0.5 * corners[faces][..., :2]
    # Enlarged, so that between the borders of the four pixels nothing is mixed.
    texture = Texture.of([pixels.repeat_interleave(64, 0).repeat_interleave(64, 1)], torch.zeros(12).long(), uvs)
    seen = photograph(MeshFile(corners, faces, texture=texture), 64, 64).images[16]
    for row, column, color in ((24, 24, (1, 0, 0)), (24, 40, (0, 1, 0)), (40, 24, (0, 0, 1)), (40, 40, (1, 1, 0))):
        torch.testing.assert_close(seen[row, column], torch.tensor([*map(float, color), 1]), atol=1e-6, rtol=0)
    white = photograph(MeshFile(corners, faces), 64, 64).images[16]
    assert float((seen[..., 3] - white[..., 3]).abs().max()) <= 1 / 16
    assert bool((seen[..., :3] <= seen[..., 3:] + 1e-6).all())


def test_colours_of_faces_and_of_vertices_are_photographed_under_the_lights(sphere, sphere_views):
    """A sphere that is red above and blue below: half as bright in the colour of each half where white is bright."""
    halves = torch.tensor([[0.5, 0, 0], [0, 0, 0.5]])
    of_vertices = halves[(sphere.vertices[:, 1] < 0).long()]
    of_faces = halves[(sphere.vertices[sphere.faces].mean(dim=1)[:, 1] < 0).long()]
    white = sphere_views.images[16]
    for painted in (replace(sphere, vertex_colors=of_vertices), replace(sphere, face_colors=of_faces)):
        seen = photograph(painted, 96, 96).images[16]
        assert torch.equal(seen[..., 3], white[..., 3])
        for row, color in ((30, halves[0]), (66, halves[1])):
            torch.testing.assert_close(seen[row, :, :3], white[row, :, :3] * color, atol=1e-6, rtol=0)


def test_a_texture_belongs_to_the_fingerprint_of_a_source(sphere):
    texture = Texture.of(
        [torch.zeros(1, 1, 3, dtype=torch.uint8)],
        torch.zeros(len(sphere.faces)).long(),
        torch.zeros(len(sphere.faces), 3, 2),
    )
    black, white = (replace(sphere, texture=replace(texture, pixels=texture.pixels + shade)) for shade in (0, 255))
    assert len({fingerprint(mesh) for mesh in (sphere, black, white)}) == 3


def test_arrays_that_do_not_belong_together_are_named_and_colours_may_be_doubles():
    """Colours of vertices in the place of faces' ended in sizes of tensors that must match."""
    vertices, faces = icosphere(1)

    def first(mesh: MeshFile, supersampling: int = 1):
        return photograph(mesh, 8, 8, elevations=(0.0,), azimuths=5, supersampling=supersampling).images[0]

    with pytest.raises(ValueError, match=r"face_colors: expected shape \(80, 3\), got \(42, 3\)"):
        first(MeshFile(vertices, faces, face_colors=torch.ones(42, 3)))
    with pytest.raises(ValueError, match="faces: expected indices"):
        first(MeshFile(vertices, faces + 1))
    for name, count in (("face_colors", 80), ("vertex_colors", 42)):
        colors = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
        mesh = MeshFile(vertices, faces, **{name: colors})
        assert torch.equal(first(replace(mesh, **{name: colors.double()})), first(mesh))
    texture = Texture.of([torch.zeros(1, 1, 3, dtype=torch.uint8)], torch.zeros(80).long(), torch.zeros(80, 3, 2))
    for mesh in (MeshFile(vertices, faces), MeshFile(vertices, faces, texture=texture)):
        with pytest.raises(ValueError, match="supersampling must be an integer from 1 to 16"):
            first(mesh, 0)
