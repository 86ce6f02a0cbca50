"""Light textured meshes: on a sphere whose colours and photos are known."""

from dataclasses import replace

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.photograph import normalize_mesh, photograph
from etsplat.geometry.decimation import decimated
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.intersections import count_self_intersections
from etsplat.geometry.topology import MeshTopology
from etsplat.geometry.unwrap import texel_points
from etsplat.io.mesh_files import MeshFile
from etsplat.model.textured_mesh import TexturedMesh
from etsplat.optim.strategies import Fixed
from etsplat.tasks import texturing
from etsplat.tasks.scoring import Scorer
from etsplat.tasks.texturing import coarser, texture_object

pytest.importorskip("xatlas")
pytest.importorskip("fast_simplification")

SIZE, FACES = 64, 300
SCENE = tuple[MeshFile, Dataset]


@pytest.fixture(scope="module")
def scene() -> SCENE:
    """A sphere in smooth colours, photographed."""
    vertices, faces = icosphere(3)
    mesh = MeshFile(vertices, faces, face_colors=0.5 + 0.4 * torch.sin(3 * vertices[faces].mean(dim=1)))
    views = photograph(mesh, 48, 48, supersampling=2)
    return normalize_mesh(mesh)[0], views


@pytest.fixture(scope="module", autouse=True)
def short():
    """Two epochs of each stage."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(texturing, "EPOCHS", (2, 1, 1))
        yield


@pytest.fixture(scope="module")
def light(scene: SCENE, short: None) -> TexturedMesh:
    mesh, views = scene
    return texture_object(mesh, views, size=SIZE, faces=FACES)


def quality(model: TexturedMesh, views: Dataset) -> float:
    found = Scorer(views, torch.device("cpu"), supersampling=2).opaque(model, views.test)["psnr_mesh"]
    assert found is not None
    return found


def test_it_shows_what_the_photos_show_with_few_faces(scene: SCENE, light: TexturedMesh) -> None:
    assert light.count <= FACES
    assert light.texture.shape == (SIZE, SIZE, 3)
    assert MeshTopology.from_faces(light.faces, len(light.vertices)).is_closed()
    assert quality(light, scene[1]) > 32


def test_colours_come_from_the_photos(scene: SCENE, light: TexturedMesh) -> None:
    """A mesh without any ends near the one that had them from the start."""
    mesh, views = scene
    grey = texture_object(replace(mesh, face_colors=None), views, size=SIZE, faces=FACES)
    assert quality(grey, views) > quality(light, views) - 2


def test_the_same_seed_gives_the_same_bits(scene: SCENE, light: TexturedMesh) -> None:
    mesh, views = scene
    again = texture_object(mesh, views, size=SIZE, faces=FACES)
    assert torch.equal(light.texture, again.texture)
    assert torch.equal(light.vertices, again.vertices)
    assert not torch.equal(light.texture, texture_object(mesh, views, size=SIZE, faces=FACES, seed=1).texture)


def test_what_no_photo_shows_takes_the_colour_of_what_is_next_to_it(scene: SCENE) -> None:
    """Photos from above alone, of a sphere that the run left red where they do not look."""
    mesh, views = scene
    above = [index for index in views.train if views.centers[index][1] > 1]
    assert above
    red = mesh.face_colors.new_tensor([1.0, 0.0, 0.0]).expand(len(mesh.faces), 3)
    found = texture_object(replace(mesh, face_colors=red), replace(views, train=above), size=SIZE, faces=FACES)
    assert not bool((found.texture.detach() == red[0]).all(dim=-1).any())


def test_sheets_that_decimation_crosses_are_apart_again(scene: SCENE) -> None:
    mesh, views = scene
    vertices = torch.cat([mesh.vertices, 0.96 * mesh.vertices])
    faces = torch.cat([mesh.faces, mesh.faces.flip(1) + len(mesh.vertices)])
    assert count_self_intersections(*decimated(vertices, faces, FACES)) > 0
    light = texture_object(MeshFile(vertices, faces), views, size=SIZE, faces=FACES)
    assert count_self_intersections(light.vertices.detach(), light.faces) == 0


def test_folds_that_hold_up_the_shape_stay(scene: SCENE) -> None:
    """Two spheres in one, so near that untangling would ruin both."""
    mesh, views = scene
    vertices = torch.cat([mesh.vertices, 0.98 * mesh.vertices])
    faces = torch.cat([mesh.faces, mesh.faces.flip(1) + len(mesh.vertices)])
    assert quality(texture_object(MeshFile(vertices, faces), views, size=SIZE, faces=FACES), views) > 24


def test_vertices_make_no_folds_on_the_way(scene: SCENE, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sphere that is to shrink, with another one within, through which its vertices would go."""
    mesh, views = scene
    vertices = torch.cat([1.1 * mesh.vertices, 1.02 * mesh.vertices])
    faces = torch.cat([mesh.faces, mesh.faces.flip(1) + len(mesh.vertices)])
    monkeypatch.setattr(texturing, "LEAST_RATE", 3e-3)
    monkeypatch.setattr(texturing, "_untangled", lambda model, *_: model)

    def folds() -> int:
        light = texture_object(MeshFile(vertices, faces), views, size=SIZE, faces=len(faces))
        return count_self_intersections(light.vertices.detach(), light.faces)

    assert folds() == 0
    monkeypatch.setattr(texturing, "NoNewFolds", lambda *_: Fixed())
    assert folds() > 0


def test_the_outline_that_decimation_lost_comes_back_the_faster_the_more_it_is(
    scene: SCENE, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a rough sphere, whose decimation is another rough sphere."""
    mesh, views = scene
    noise = torch.randn((len(mesh.vertices), 1), generator=torch.Generator().manual_seed(0))
    rough = replace(mesh, vertices=mesh.vertices * (1 + 0.03 * noise))
    adaptive = texture_object(rough, views, size=SIZE, faces=FACES)
    monkeypatch.setattr(texturing, "PULL", 0.0)
    slow = texture_object(rough, views, size=SIZE, faces=FACES)
    assert quality(adaptive, views) > quality(slow, views) + 1


def test_exposures_are_not_part_of_the_result(scene: SCENE, light: TexturedMesh) -> None:
    """Of photos that are said to be half as bright as the object, it gets twice their brightness."""
    mesh, views = scene
    half = {view: 0.5 * torch.eye(3) for view in views.train}
    bright = texture_object(mesh, views, size=SIZE, faces=FACES, exposures=half)
    texels = light.texture.detach()
    dark = texels <= texels.quantile(0.1)  # twice that is a colour too
    ratio = bright.texture.detach()[dark].mean() / texels[dark].mean()
    assert float(ratio) == pytest.approx(2, abs=0.25)  # after so few steps


def test_it_tells_how_far_it_is(scene: SCENE) -> None:
    mesh, views = scene
    told: list[tuple[str, int, int]] = []
    texture_object(mesh, views, size=SIZE, faces=FACES, tell=lambda *event: told.append(event))
    assert [phase for phase, _, _ in told[:2]] == ["Simplifying", "Unwrapping"]
    done = [done for _, done, _ in told[2:]]
    assert done == sorted(done)
    assert told[-1] == ("Fitting the texture", 4 * len(views.train), 4 * len(views.train))


def test_a_coarser_level_shows_the_same_from_farther_away(scene: SCENE, light: TexturedMesh) -> None:
    """A quarter of the faces, half the texels along each side, closed, and not much worse."""
    far = coarser(light, light.count // 4, SIZE // 2)
    assert far.count <= light.count // 4
    assert far.texture.shape == (SIZE // 2, SIZE // 2, 3)
    assert MeshTopology.from_faces(far.faces, len(far.vertices)).is_closed()
    assert quality(far, scene[1]) > 25
    again = coarser(light, light.count // 4, SIZE // 2)
    assert torch.equal(far.texture, again.texture)


def test_colours_of_a_coarser_level_are_those_of_the_place(light: TexturedMesh) -> None:
    """Of a texture whose colours are positions they stay so."""
    vertices, faces = light.surface()
    covered, points, _ = texel_points(vertices, faces, light.face_uvs, SIZE)
    texture = torch.zeros(SIZE, SIZE, 3)
    texture[covered] = 0.5 + 0.4 * points
    placed = replace(light, texture=texturing.spread(texture, covered)).learnable()
    far = coarser(placed, light.count // 4, SIZE // 2)
    covered, points, _ = texel_points(*far.surface(), far.face_uvs, SIZE // 2)
    error = (far.texture.detach()[covered] - (0.5 + 0.4 * points)).abs()
    assert float(error.median()) < 0.02
    assert float(error.max()) < 0.15


@pytest.mark.parametrize("shape", [(64, 64), (52, 37), (1, 9)])
def test_one_texel_colours_all_that_is_between_charts(shape: tuple[int, int], rng: torch.Generator) -> None:
    known = torch.zeros(shape, dtype=torch.bool)
    known[0, 3] = True
    one = torch.rand(3, generator=rng)
    assert torch.equal(texturing.spread(known[..., None] * one, known), one.expand(*shape, 3))


def test_no_coarser_level_of_a_chart_has_the_colours_of_another(rng: torch.Generator) -> None:
    """A block of any level that holds a part of one chart has its colours alone; texels beside a chart, the nearest."""
    known = torch.zeros(64, 64, dtype=torch.bool)
    known[5:60, 3:6] = known[8:40, 34:60] = True
    texture = known[..., None] * torch.rand((64, 64, 3), generator=rng)
    texture[:, :32, 2], texture[:, 32:, 2] = 0, known[:, 32:].float()
    filled = texturing.spread(texture, known)
    assert torch.equal(filled[known], texture[known])
    assert torch.equal(filled[40, 35:59], texture[39, 35:59])
    assert set(filled[:, :32, 2].flatten().tolist()) == {0.0}
    assert set(filled[:, 32:, 2].flatten().tolist()) == {1.0}
