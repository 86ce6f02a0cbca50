import math

import pytest
import torch

from etsplat import _native
from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.geometry.icosphere import icosphere
from etsplat.ops.rasterize_opaque import rasterize_opaque, render_opaque
from helpers.engines import on

IDENTITY = torch.eye(4)[None]


def flat_camera() -> torch.Tensor:
    """Projects (x, y, 1) to the pixel position (x, y)."""
    return torch.eye(3)[None]


def sphere_views(width: int, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    eyes = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.3, 3.0]])
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])).float()
    return viewmats, intrinsics(40.0, width, height).float().expand(2, 3, 3)


def soup(rng: torch.Generator, count: int, spread: float = 40.0) -> torch.Tensor:
    corners = torch.rand((count, 3, 3), generator=rng) * spread
    corners[..., 2] = 1 + torch.rand((count, 3), generator=rng)
    corners[..., :2] *= corners[..., 2:]
    return corners


@pytest.mark.parametrize("size", [(2**27 + 1, 1), (1, 2**27 + 1)])
def test_a_picture_of_more_samples_than_can_be_numbered_is_refused(size):
    """Times the samples its width does not fit into 32 bits: it came out as zeros."""
    width, height = size
    with pytest.raises(ValueError, match=r"(width|height) must be an integer from 1 to 67108864"):
        render_opaque(
            torch.rand(2, 3, 3),
            viewmats=IDENTITY,
            Ks=flat_camera(),
            width=width,
            height=height,
            face_colors=torch.rand(2, 1),
            supersampling=16,
        )


@pytest.mark.sanitize
def test_native_agrees_with_float64_reference(rng):
    """On an odd-sized image of a soup both engines see the same triangles, depths and barycentrics."""
    corners = soup(rng, 60)
    native = rasterize_opaque(corners, cameras=Cameras(IDENTITY, flat_camera(), 45, 37))
    exact = rasterize_opaque(corners.double(), cameras=Cameras(IDENTITY.double(), flat_camera().double(), 45, 37))
    assert (native.triangle == exact.triangle).float().mean() > 0.999
    same = native.triangle == exact.triangle
    torch.testing.assert_close(native.depth[same].double(), exact.depth[same], rtol=1e-5, atol=0)
    torch.testing.assert_close(native.barycentrics[same].double(), exact.barycentrics[same], rtol=0, atol=1e-6)


@pytest.mark.parametrize("colors", ["face", "vertex"])
@pytest.mark.parametrize("cull_backfaces", [False, True])
def test_opaque_native_agrees_with_float64_reference(rng, colors, cull_backfaces):
    """Supersampled pictures agree, for both ways to colour, any channel count, with and without culling."""
    vertices, faces = icosphere(2)
    viewmats, Ks = sphere_views(65, 47)
    values = {
        "face_colors": torch.rand((len(faces), 3), generator=rng) if colors == "face" else None,
        "vertex_colors": torch.rand((len(vertices), 5), generator=rng) if colors == "vertex" else None,
    }
    options = {"faces": faces, "supersampling": 3, "cull_backfaces": cull_backfaces}
    native = render_opaque(vertices, cameras=Cameras(viewmats, Ks, 65, 47), **values, **options).rgba
    exact_values = {name: value if value is None else value.double() for name, value in values.items()}
    exact = render_opaque(
        vertices.double(), cameras=Cameras(viewmats.double(), Ks.double(), 65, 47), **exact_values, **options
    ).rgba
    torch.testing.assert_close(native.double(), exact, rtol=0, atol=1e-6)


@pytest.mark.sanitize
def test_shared_edges_have_neither_crack_nor_overlap(engine, rng):
    """A jittered grid with vertices on sample centres covers each sample of its square exactly once."""
    n, size = 12, 48
    axis = torch.arange(n + 1) * (size / n)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1) + 0.5
    jitter = torch.randint(-1, 2, (n - 1, n - 1, 2), generator=rng).float()
    grid[1:-1, 1:-1] += jitter + 0.3 * torch.randn((n - 1, n - 1, 2), generator=rng)
    vertices = torch.cat([grid.reshape(-1, 2), torch.ones((n + 1) ** 2, 1)], dim=1)
    a = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + n + 2], 1), torch.stack([a, a + n + 2, a + n + 1], 1)])
    seen = torch.zeros((size + 2, size + 2), dtype=torch.int32)
    for face in faces:
        picture = on(
            engine,
            rasterize_opaque,
            vertices,
            cameras=Cameras(IDENTITY, flat_camera(), size + 2, size + 2),
            faces=face[None],
            near_plane=0.1,
        )
        seen += picture.triangle[0] == 0
    wanted = torch.zeros_like(seen)
    wanted[:size, :size] = 1  # the left and top border belong to the square, the right and bottom ones do not
    assert torch.equal(seen, wanted)


def test_nearest_wins_and_ties_go_to_the_smaller_index(engine):
    """Of coincident triangles the first is drawn; a nearer one hides both."""
    triangle = torch.tensor([[1.3, 1.1, 1.0], [30.2, 2.7, 1.0], [9.1, 28.4, 1.0]]) * torch.tensor([[1.0], [2.0], [3.0]])
    coincident = triangle.expand(2, 3, 3)
    seen = on(engine, rasterize_opaque, coincident, cameras=Cameras(IDENTITY, flat_camera(), 32, 32)).triangle
    assert set(seen.unique().tolist()) == {-1, 0}
    nearer = torch.cat([coincident, 0.5 * triangle[None]])
    seen = on(engine, rasterize_opaque, nearer, cameras=Cameras(IDENTITY, flat_camera(), 32, 32)).triangle
    assert set(seen.unique().tolist()) == {-1, 2}


def test_native_ties_do_not_depend_on_the_order_of_vertices():
    """A triangle's depths are the same bits in whatever order its vertices run, so duplicates never fight."""
    triangle = torch.tensor([[1.3, 1.1, 1.0], [30.2, 2.7, 1.0], [9.1, 28.4, 1.0]]) * torch.tensor([[1.0], [2.0], [3.0]])
    orders = [[0, 1, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0], [1, 0, 2], [0, 2, 1]]
    seen = rasterize_opaque(
        torch.stack([triangle[order] for order in orders]), cameras=Cameras(IDENTITY, flat_camera(), 32, 32)
    ).triangle
    assert set(seen.unique().tolist()) == {-1, 0}


def test_intersecting_triangles_are_split_at_their_line(engine):
    """Two planes that cross at x = 16 hide one another on either side of it."""
    left = torch.tensor([[-90.0, -90.0, 1.0], [122.0, -90.0, 1.0], [16.0, 200.0, 1.0]])
    slope = 1 / (1 + (left[:, :1] - 16) / 500)
    seen = on(
        engine, rasterize_opaque, torch.stack([left, left * slope]), cameras=Cameras(IDENTITY, flat_camera(), 32, 32)
    ).triangle[0]
    assert bool((seen[:, :16] == 0).all())
    assert bool((seen[:, 16:] == 1).all())


def test_barycentrics_reproduce_the_surface_point(engine):
    """Weights times the vertices give the point on the pixel's ray at the depth that was returned."""
    vertices, faces = icosphere(2)
    viewmats, Ks = sphere_views(40, 40)
    seen = on(engine, rasterize_opaque, vertices, cameras=Cameras(viewmats, Ks, 40, 40), faces=faces)
    for view in range(2):
        i, j = (seen.triangle[view] >= 0).nonzero(as_tuple=True)
        corners = vertices[faces[seen.triangle[view, i, j].long()]]
        point = (seen.barycentrics[view, i, j, :, None] * corners).sum(1)
        camera = point @ viewmats[view, :3, :3].T + viewmats[view, :3, 3]
        pixel = (camera @ Ks[view].T)[:, :2] / camera[:, 2:]
        torch.testing.assert_close(pixel, torch.stack([j, i], 1) + 0.5, rtol=0, atol=1e-4)
        torch.testing.assert_close(camera[:, 2], seen.depth[view, i, j, 0], rtol=1e-5, atol=0)


def test_coverage_of_a_sphere_is_its_silhouette_area():
    """The mean coverage of a fine sphere equals the area of its outline, a circle of known radius."""
    vertices, faces = icosphere(5)
    viewmat = look_at(torch.tensor([0.0, 0.0, 3.0]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])).float()[None]
    K = intrinsics(60.0, 128, 128).float()[None]
    image = render_opaque(
        vertices, cameras=Cameras(viewmat, K, 128, 128), faces=faces, face_colors=torch.ones(len(faces), 1)
    ).rgba
    radius = float(K[0, 0, 0]) / math.sqrt(3.0**2 - 1)
    assert float(image[..., 1].sum()) == pytest.approx(math.pi * radius**2, rel=2e-3)
    assert torch.equal(image[..., 0], image[..., 1])


def test_supersampling_is_the_mean_of_a_larger_image(engine):
    """The coverage at 4 x 4 samples is the box-filtered triangle mask of the image 4 times as large."""
    vertices, faces = icosphere(1)
    viewmats, Ks = sphere_views(33, 29)
    ones = torch.ones(len(faces), 1)
    image = on(
        engine, render_opaque, vertices, cameras=Cameras(viewmats, Ks, 33, 29), faces=faces, face_colors=ones
    ).rgba
    large = Ks * torch.tensor([4.0, 4.0, 1.0])[:, None]
    mask = (
        on(engine, rasterize_opaque, vertices, cameras=Cameras(viewmats, large, 132, 116), faces=faces).triangle >= 0
    ).float()
    assert torch.equal(image[..., 1], mask.view(2, 29, 4, 33, 4).mean(dim=(2, 4)))


def test_culling_draws_front_faces_only(engine):
    """A closed outward mesh looks the same with culling; turned inside out its far side shows."""
    vertices, faces = icosphere(2)
    viewmats, Ks = sphere_views(32, 32)
    colors = vertices[faces].mean(1)
    plain, culled, turned = (
        on(
            engine,
            render_opaque,
            vertices,
            cameras=Cameras(viewmats, Ks, 32, 32),
            faces=f,
            face_colors=colors,
            cull_backfaces=c,
        ).rgba
        for f, c in [(faces, False), (faces, True), (faces.flip(1), True)]
    )
    torch.testing.assert_close(plain, culled)
    assert float(plain[1, 16, 16, 2]) > 0.9
    assert float(turned[1, 16, 16, 2]) < -0.9


@pytest.mark.sanitize
def test_same_bits_for_any_number_of_threads(rng):
    """Images do not depend on the thread count, also where triangles span many tiles."""
    corners = torch.cat([soup(rng, 3000, 300.0), soup(rng, 20, 3000.0) - 1000])
    corners[..., 2] = corners[..., 2].abs() + 0.5
    colors = torch.rand((len(corners), 3), generator=rng)
    results = []
    before = num_threads()
    for count in (1, 2, 5):
        set_num_threads(count)
        image = render_opaque(corners, cameras=Cameras(IDENTITY, flat_camera(), 301, 203), face_colors=colors).rgba
        seen = rasterize_opaque(corners, cameras=Cameras(IDENTITY, flat_camera(), 301, 203))
        results.append((image, seen.triangle, seen.barycentrics, seen.depth))
    set_num_threads(before)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


@pytest.mark.sanitize
def test_same_bits_on_every_instruction_set(rng):
    """Rows are found many at once, and samples side by side, as many as registers hold: of one sample to large ones."""
    corners = torch.cat([soup(rng, 300, spread) for spread in (3.0, 30.0, 300.0)])
    size = torch.rand((len(corners), 1, 1), generator=rng)
    corners[:, 1:, :2] = corners[:, :1, :2].lerp(corners[:, 1:, :2], size)
    colors = torch.rand((len(corners), 3), generator=rng)
    cameras, results = Cameras(IDENTITY, flat_camera(), 301, 203), []
    before = _native.instruction_set()
    try:
        for name in _native.available_instruction_sets():
            _native.set_instruction_set(name)
            image = render_opaque(corners, cameras=cameras, face_colors=colors, supersampling=3).rgba
            seen = rasterize_opaque(corners, cameras=cameras)
            results.append((image, seen.triangle, seen.barycentrics, seen.depth))
    finally:
        _native.set_instruction_set(before)
    assert int((results[0][1] >= 0).sum()) > 1000
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


@pytest.mark.sanitize
def test_unusable_triangles_are_dropped_and_harm_nothing(engine):
    """NaN, Inf, behind the camera, without area or huge: none crashes, none changes what a good triangle shows."""
    good = torch.tensor([[2.0, 2.0, 1.0], [28.0, 3.0, 1.0], [10.0, 30.0, 1.0]])
    alone = on(engine, rasterize_opaque, good[None], cameras=Cameras(IDENTITY, flat_camera(), 32, 32))
    bad = []
    for value in (math.nan, math.inf, -math.inf):
        for corner in range(3):
            for axis in range(3):
                broken = good.clone()
                broken[corner, axis] = value
                bad.append(broken)
    behind = good * torch.tensor([1.0, 1.0, -1.0])
    point, line = good[:1].expand(3, 3), torch.stack([good[0], good[1], good[:2].mean(0)])
    tiny, far = good * 1e-40, torch.full((3, 3), 3e38)
    triangles = torch.stack([*bad, behind, point, line, tiny, far, good])
    seen = on(engine, rasterize_opaque, triangles, cameras=Cameras(IDENTITY, flat_camera(), 32, 32))
    assert torch.equal(seen.triangle >= 0, alone.triangle >= 0)
    assert torch.equal(seen.depth, alone.depth)


@pytest.mark.sanitize
def test_huge_triangles_fill_the_image(engine):
    """Coordinates far beyond the image are exact enough to cover it completely, with the right depth."""
    for reach in (1e3, 1e7, 1e20):
        corners = torch.tensor([[-reach, -reach, 1.0], [reach, -reach, 1.0], [0.0, reach, 1.0]])[None]
        seen = on(engine, rasterize_opaque, corners, cameras=Cameras(IDENTITY, flat_camera(), 70, 3))
        assert bool((seen.triangle == 0).all())
        torch.testing.assert_close(seen.depth, torch.ones(1, 3, 70, 1))


def test_near_plane_drops_a_crossing_triangle_whole(engine):
    """One vertex at the near plane is enough."""
    corners = torch.tensor([[2.0, 2.0, 1.0], [28.0, 3.0, 1.0], [1.0, 3.0, 0.1]])[None]
    shown = on(engine, rasterize_opaque, corners, cameras=Cameras(IDENTITY, flat_camera(), 32, 32), near_plane=0.05)
    dropped = on(engine, rasterize_opaque, corners, cameras=Cameras(IDENTITY, flat_camera(), 32, 32), near_plane=0.11)
    assert bool((shown.triangle == 0).any())
    assert bool((dropped.triangle == -1).all())


def test_empty_mesh_gives_an_empty_image(engine):
    """No triangles, or no views, are no error."""
    image = on(
        engine,
        render_opaque,
        torch.zeros(0, 3, 3),
        cameras=Cameras(IDENTITY, flat_camera(), 5, 4),
        face_colors=torch.zeros(0, 3),
    ).rgba
    assert image.shape == (1, 4, 5, 4)
    assert float(image.abs().sum()) == 0
    assert on(
        engine, rasterize_opaque, torch.zeros(1, 3, 3), cameras=Cameras(IDENTITY[:0], flat_camera()[:0], 5, 4)
    ).depth.shape == (0, 4, 5, 1)


def test_non_contiguous_input_is_read_correctly(rng):
    """Strided vertices, matrices and colours give the picture of their contiguous copies."""
    corners = soup(rng, 20).flip(1).transpose(0, 1).contiguous().transpose(0, 1)
    colors = torch.rand((3, 20), generator=rng).T
    viewmats = IDENTITY.transpose(1, 2)
    assert not corners.is_contiguous()
    assert not colors.is_contiguous()
    strided = render_opaque(corners, cameras=Cameras(viewmats, flat_camera().mT, 20, 20), face_colors=colors).rgba
    plain = render_opaque(
        corners.contiguous(), cameras=Cameras(IDENTITY, flat_camera(), 20, 20), face_colors=colors.contiguous()
    ).rgba
    assert torch.equal(strided, plain)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": torch.zeros(4, 2)}, "vertices"),
        ({"faces": torch.tensor([[0, 1, 3]])}, "faces must be indices from 0 to 2"),
        ({"faces": torch.tensor([[0.0, 1.0, 2.0]])}, "faces"),
        ({"viewmats": torch.eye(4)}, "viewmats"),
        ({"Ks": torch.eye(3).expand(2, 3, 3)}, "Ks"),
        ({"Ks": torch.eye(3).double()[None]}, "Ks"),
        ({"Ks": flat_camera() + torch.tensor([0.0, 0.1, 0.0])}, "Ks must have the form"),
        ({"viewmats": torch.eye(4)[None] + torch.eye(4).roll(1, 0)[None]}, "viewmats must have the last row"),
        ({"width": 0}, "width"),
        ({"near_plane": 0.0}, "near_plane"),
        ({"face_colors": torch.zeros(2, 3)}, "face_colors"),
        ({"vertex_colors": torch.zeros(3, 3)}, "exactly one"),
        ({"supersampling": 0}, "supersampling"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    """Each wrong argument is a ValueError that names it."""
    arguments = {
        "vertices": torch.rand(3, 3),
        "faces": torch.tensor([[0, 1, 2]]),
        "viewmats": IDENTITY,
        "Ks": flat_camera(),
        "width": 4,
        "height": 4,
        "face_colors": torch.zeros(1, 3),
    }
    with pytest.raises(ValueError, match=message):
        render_opaque(**{**arguments, **change})
