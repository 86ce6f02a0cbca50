"""What reconstructions start from: which shape is chosen, and that runs from each end as they should."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

from etsplat.core.errors import InputError
from etsplat.data.changed_pictures import Box, cropped
from etsplat.data.dataset import Dataset
from etsplat.data.hollows import Opened
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.parts import Shape, genera, shape_of
from etsplat.io.mesh_files import MeshFile
from etsplat.io.run_directory import RunDirectory
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.optim.loop import Event, NoteEvent
from etsplat.tasks import starting_hull
from etsplat.tasks.judgement import CONTRADICTED, expect_hull
from etsplat.tasks.reconstruct import reconstruct
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.starting_hull import Hull, finer_shape, plain_hull
from etsplat.tasks.starts import Started, start_shape, within_need
from helpers.reconstructions import SHORT, KilledError, kill_at, pebble_mesh, untimed


@pytest.fixture(scope="module")
def pebble() -> MeshFile:
    return pebble_mesh()


def test_photos_start_from_the_hull_if_most_show_the_object_as_a_whole() -> None:
    """Those without transparency, and those of whose silhouettes no hull explains half, start from the sphere."""
    ball = MeshFile(*icosphere(2))
    views = photograph(ball, 48, 48, supersampling=1)
    config = ReconstructConfig.quick()

    def start(views: Dataset) -> str:
        return start_shape(config, views)

    assert start(views) == "hull"
    images = list(views.images)
    assert start(replace(views, images=StoredPictures([image[..., :3] for image in images]))) == "sphere"
    cut = [
        image.flip(0).roll(-20, dims=0) if index in views.train[::2] else image for index, image in enumerate(images)
    ]
    assert start(replace(views, images=StoredPictures(cut))) == "sphere"
    asked = ReconstructConfig.quick().changed({"start.shape": "sphere"})
    assert start_shape(asked, views) == "sphere"


def test_photos_that_together_show_all_of_an_object_start_from_the_hull() -> None:
    """Each is cut off at a side, and other photos show what it lacks; from the sphere that would stay where it is."""
    whole = photograph(MeshFile(*icosphere(2)), 48, 48, supersampling=1)
    boxes = [(Box(14, 0, 48, 48), Box(0, 0, 34, 48))[index % 2] for index in range(len(whole))]
    Ks = whole.Ks.clone()
    Ks[:, 0, 2] -= torch.tensor([float(box.left) for box in boxes])
    views = replace(whole, Ks=Ks, images=cropped(whole.images, boxes))
    assert start_shape(ReconstructConfig.quick(), views) == "hull"


def hull_shape(hull: Hull) -> Shape:
    return shape_of(hull.vertices, hull.faces)


def painted_ball() -> MeshFile:
    """A ball in stripes, on which photos agree."""
    vertices, faces = icosphere(4)
    colors = 0.5 + 0.5 * torch.sin(torch.tensor([11.0, 17.0, 23.0]) * vertices[faces].mean(dim=1))
    return MeshFile(vertices, faces, face_colors=colors)


def ring_of(thickness: float) -> MeshFile:
    ring = trimesh.creation.torus(1.0, thickness, major_sections=64, minor_sections=12)
    return MeshFile(torch.from_numpy(ring.vertices.copy()).float(), torch.from_numpy(ring.faces.copy()).long())


def test_long_runs_start_from_the_hull_of_short_ones() -> None:
    """A finer one is opened worse, and costs more; it has its faces later."""
    views = photograph(MeshFile(*icosphere(3)), 96, 96, supersampling=1)
    best, quick = (plain_hull(views, ReconstructConfig.of(preset)) for preset in ("best", "quick"))
    assert torch.equal(best.vertices, quick.vertices)
    assert torch.equal(best.faces, quick.faces)
    assert len(best.faces) < 15_000


def test_a_hull_that_lacks_thin_parts_is_known_by_what_it_leaves_uncovered() -> None:
    """A thin ring, of which a coarse grid has pieces: a finer one is taken, where a run may have so many faces.

    Otherwise the verdict compares no parts and holes, and says what to try.
    """
    views = photograph(ring_of(0.03), 128, 128, supersampling=2)
    config = ReconstructConfig.quick().changed({"start.hull_faces": 1000})
    torn, whole = (plain_hull(views, config.changed({"max_faces": faces})) for faces in (2000, 25_000))
    assert hull_shape(torn).parts == 24
    assert torn.uncovered > 0.0005
    finer = finer_shape(torn, views, config.start.radius)
    assert finer == Shape(1, 1)
    expected = expect_hull(hull_shape(torn), finer, 2 * torn.wanted)
    assert expected.of is None
    assert expected.shape.unclear == (
        "a finer visual hull has 1 part and 1 hole: try start.hull_faces=2000 and max_faces=4000"
    )
    assert hull_shape(whole) == Shape(1, 1)
    assert whole.uncovered < 0.0005
    assert finer_shape(whole, views, config.start.radius) is None


def test_of_wires_that_no_grid_of_a_run_holds_a_hull_with_thin_parts_is_taken() -> None:
    """A ring of two pixels, of which a run's grid has hardly anything, whatever its cells."""
    views = photograph(ring_of(0.012), 200, 200, supersampling=2)
    config = ReconstructConfig.quick().changed({"start.hull_faces": 600, "max_faces": 6000})
    found = plain_hull(views, config)
    assert found.thin
    assert found.uncovered < 0.0005
    assert hull_shape(found) == Shape(1, 1)
    assert finer_shape(found, views, config.start.radius) is None


def plate_of(thickness: float) -> MeshFile:
    plate = trimesh.creation.box((1.8, 1.8, thickness))
    return MeshFile(torch.from_numpy(plate.vertices.copy()).float(), torch.from_numpy(plate.faces.copy()).long())


def test_a_plate_has_a_hull_although_masks_are_empty_from_its_side() -> None:
    """It is half a pixel thick there, and thinner than cells."""
    views = photograph(plate_of(0.02), 128, 128)
    config = ReconstructConfig.quick().changed({"start.hull_faces": 2000, "max_faces": 4000})
    found = plain_hull(views, config)
    assert found.thin
    assert found.uncovered < 0.0005
    assert hull_shape(found) == Shape(1, 0)


def test_a_hull_has_no_more_faces_than_a_run_may_have(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plate that only a fine grid saw began with 53,836 of 25,000, was never divided, and cut through itself."""
    views = photograph(plate_of(0.03), 128, 128)
    config = ReconstructConfig.quick().changed({"start.hull_faces": 2000, "max_faces": 4000})

    def found_late(views: Dataset, faces: int, *, radius: float, thin: bool) -> tuple[torch.Tensor, torch.Tensor]:
        return visual_hull(views, faces if thin else 6000, radius=radius, thin=thin)

    monkeypatch.setattr(starting_hull, "visual_hull", found_late)
    found = plain_hull(views, config)
    assert found.thin
    assert len(found.faces) <= 4000
    assert hull_shape(found) == Shape(1, 0)


def rodded(*places: float) -> MeshFile:
    """A ball with slender rods beside it: a hundredth of the silhouettes."""
    body, rod = icosphere(3), icosphere(3)
    vertices, faces = [0.5 * body[0]], [body[1]]
    for place in places:
        faces.append(rod[1] + sum(len(part) for part in vertices))
        vertices.append(rod[0] * torch.tensor([0.01, 0.01, 0.45]) + torch.tensor([place, 0.0, 0.0]))
    return MeshFile(torch.cat(vertices), torch.cat(faces))


def test_rods_beside_each_other_have_more_faces() -> None:
    """As the legs of a chair, which ended without any: of as few faces, what makes them whole closes the gap."""
    views = photograph(rodded(0.7, 0.85), 200, 200, supersampling=2)
    config = ReconstructConfig.quick().changed({"start.hull_faces": 2000, "max_faces": 8000})
    found = plain_hull(views, config)
    assert found.thin
    assert found.uncovered < 0.0005
    assert hull_shape(found) == Shape(3, 0)


def test_a_rod_of_a_large_object_is_whole_in_its_hull() -> None:
    """It is a hundredth of the silhouettes, as that of a blowtorch's handle, which was gone from the start."""
    views = photograph(rodded(0.85), 200, 200, supersampling=2)
    config = ReconstructConfig.quick().changed({"start.hull_faces": 2000, "max_faces": 4000})
    found = plain_hull(views, config)
    assert found.thin
    assert found.uncovered < 0.0005
    assert len(found.faces) < 2600
    assert hull_shape(found) == Shape(2, 0)


def test_what_masks_lack_is_no_matter_of_how_fine_a_hull_is() -> None:
    """They lack it on any grid: here one in four has lost half of the object, and is outvoted by none."""
    whole = photograph(MeshFile(*icosphere(3)), 96, 96, supersampling=1)
    images = list(whole.images)
    for index in whole.train[::4]:
        images[index] = images[index].clone()
        images[index][:, 48:] = 0
    views = replace(whole, images=StoredPictures(images))
    config = ReconstructConfig.quick().changed({"start.hull_faces": 3000})
    found = plain_hull(views, config)
    assert found.uncovered > 0.05
    assert finer_shape(found, views, config.start.radius) is None


def test_settings_of_one_start_are_taken_where_it_is_chosen_as_the_run_begins(tmp_path: Path) -> None:
    """With "auto" those of the sphere have an effect or not, as the photos are."""
    views = photograph(MeshFile(*icosphere(2)), 48, 48, supersampling=1)
    config = SHORT.changed({"iterations": 2, "start.shape": "auto", "start.level": 1, "start.near": 0.5})
    reconstruct(views, tmp_path, config)
    told = json.loads((tmp_path / "config.json").read_text())["config"]["start"]
    assert (told["shape"], told["level"], told["near"]) == ("auto", 1, 0.5)


def test_a_hull_that_is_near_all_over_takes_the_fewer_iterations() -> None:
    """Neither one with hollows, nor one that photos contradict, nor a length that was asked for."""
    quick, (vertices, faces) = ReconstructConfig.quick(), icosphere(1)
    mesh = TriangleMesh.from_mesh(vertices, faces, colors=0.5, opacity=0.98, sigma=0.25)
    opened = Opened(vertices, faces, 0, CONTRADICTED, 0.05, 0.5)
    near = Started(mesh, "hull", opened)
    config, about = within_need(quick, near)
    third = 1 / 3 * quick.optimizer.lr_vertices
    changes = {"iterations": 1400, "optimizer.lr_vertices": third, "drawing.opaque_from": 0.8, "start.near_pace": 1.0}
    assert config == quick.changed(changes)
    assert about is not None
    assert "1,400 iterations, not 5,000" in about
    others = [opened._replace(**{name: value}) for name, value in (("doubtful", 0.051), ("agreed", 0.49))]
    for other in (*others, opened._replace(contradicted=0.006), None):
        assert within_need(quick, Started(mesh, "hull", other)) == (quick, None)
    for asked in ({"iterations": 4999}, {"iterations": 5001}, {"start.near_iterations": None}):
        assert within_need(quick.changed(asked), near)[1] is None
    best, sooner = ReconstructConfig.best(), {"drawing.opaque_from": 0.8}
    slower = {"optimizer.lr_vertices": 0.7 * best.optimizer.lr_vertices}
    assert within_need(best, near)[0] == best.changed({"iterations": 8000, **slower, **sooner})
    for unasked in (best.changed({"start.near_iterations": None}), ReconstructConfig.demo()):
        assert within_need(unasked, near) == (unasked.changed(sooner), None)
    kept = ReconstructConfig.paper()
    assert within_need(kept, near) == (kept, None)
    assert within_need(best.changed({"drawing.opaque_from": 0.5}), near)[0].drawing.opaque_from == 0.5


@pytest.mark.parametrize("degree", [0, 2])
def test_colours_by_direction_are_no_matter_of_how_near_a_hull_is(degree: int) -> None:
    """Triangles become opaque sooner, with harmonics too."""
    quick, (vertices, faces) = ReconstructConfig.quick().changed({"drawing.harmonics": degree}), icosphere(1)
    mesh = TriangleMesh.from_mesh(vertices, faces, colors=0.5, opacity=0.98, sigma=0.25, harmonics=degree)
    near = Started(mesh, "hull", Opened(vertices, faces, 0, CONTRADICTED, 0.05, 0.5))
    assert within_need(quick, near)[0].drawing.opaque_from == 0.8


def test_a_hull_that_was_cut_out_between_walls_moves_slowly_in_all_iterations() -> None:
    """Flaps that noise throws from the rim over a dark hollow stay there; what a soup cut has a way to go."""
    quick, (vertices, faces) = ReconstructConfig.quick(), icosphere(1)
    mesh = TriangleMesh.from_mesh(vertices, faces, colors=0.5, opacity=0.98, sigma=0.25)
    opened = Opened(vertices, faces, 0, 0.006, 1.0, 0.0)
    slower = quick.changed({"optimizer.lr_vertices": 1 / 3 * quick.optimizer.lr_vertices, "start.near_pace": 1.0})
    assert within_need(quick, Started(mesh, "hull", opened, cut="walls")) == (slower, None)
    assert within_need(quick, Started(mesh, "hull", opened, cut="soup")) == (quick, None)


def test_a_run_that_needs_fewer_iterations_is_shorter_and_says_why(tmp_path: Path) -> None:
    """In a note and in config.json; killed and resumed it has the same bits."""
    views = photograph(painted_ball(), 64, 64, supersampling=1)
    config = ReconstructConfig.tiny().changed({"start.shape": "hull", "start.near_iterations": 20})
    events = list[Event]()
    whole = reconstruct(views, tmp_path / "whole", config, callbacks=[events.append])
    assert whole.metrics["iterations"] == RunDirectory(whole.path).read_config()["iterations"] == 20
    assert any(isinstance(each, NoteEvent) and "20 iterations, not 300" in each.text for each in events)
    with pytest.raises(KilledError):
        reconstruct(views, tmp_path / "killed", config, callbacks=[kill_at(10)])
    resumed = reconstruct(views, tmp_path / "killed", config, resume=True)
    assert untimed(resumed.path) == untimed(whole.path)


def test_a_given_mesh_is_the_start(pebble: MeshFile, tmp_path: Path) -> None:
    """Started from the solution, in its own units and unwelded, a short run without subdivision stays close to it."""
    soup = MeshFile(pebble.vertices[pebble.faces].reshape(-1, 3), torch.arange(3 * len(pebble.faces)).reshape(-1, 3))
    config = SHORT.changed({"optimizer.lr_vertices": 1e-4, "max_faces": 100})
    result = reconstruct(pebble, tmp_path, config, init_mesh=soup)
    assert result.metrics["faces"] == len(pebble.faces)
    assert result.metrics["vertices"] == len(pebble.vertices)
    assert result.metrics["chamfer_exact"] < 1e-4


@pytest.mark.parametrize(
    ("scale", "offset", "told"),
    [
        (1.0, 0.0, None),
        (1.5, 2.0, None),
        (0.1, 0.0, "as large as the object"),
        (100.0, 0.0, "as large as the object"),
        (1.0, 30.0, "of the object's radii from it"),
    ],
)
def test_a_start_that_is_elsewhere_than_the_object_is_doubted(
    pebble: MeshFile, tmp_path: Path, scale: float, offset: float, told: str | None
) -> None:
    """As of other units: the run ended poor, and did not say why."""
    middle = pebble.vertices.mean(dim=0)
    other = MeshFile((pebble.vertices - middle) * scale + middle + offset, pebble.faces)
    events = list[Event]()
    config = SHORT.changed({"iterations": 1, "max_faces": 100})
    reconstruct(pebble, tmp_path, config, init_mesh=other, callbacks=[events.append])
    notes = [event.text for event in events if isinstance(event, NoteEvent) and event.text.startswith("init_mesh")]
    assert [note for note in notes if told is None or told not in note] == []
    assert len(notes) == (told is not None)


def test_a_start_from_the_hull_keeps_the_hole_and_ends_the_same_when_resumed(tmp_path: Path) -> None:
    """A torus: the sphere would span its hole; the hull has it, so the result is closed and of genus 1."""
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=32, minor_sections=16)
    source = MeshFile(torch.from_numpy(ring.vertices.copy()).float(), torch.from_numpy(ring.faces.copy()).long())
    config = SHORT.changed({"start.shape": "hull"})
    events: list[Event] = []
    whole = reconstruct(source, tmp_path / "whole", config, callbacks=[events.append])
    assert genera(whole.mesh.faces, len(whole.mesh.vertices)) == [1]
    assert any(isinstance(event, NoteEvent) and "holes in each part: [1]" in event.text for event in events)
    with pytest.raises(KilledError):
        reconstruct(source, tmp_path / "killed", config, callbacks=[kill_at(config.iterations // 2)])
    reconstruct(source, tmp_path / "killed", config, resume=True)
    assert untimed(tmp_path / "killed") == untimed(tmp_path / "whole")


def test_a_hull_needs_masks(pebble: MeshFile, tmp_path: Path) -> None:
    """Pictures without transparency are no silhouettes."""
    views = photograph(pebble, 48, 48, supersampling=1)
    opaque = [image[..., :3] for image in views.images]
    config = SHORT.changed({"start.shape": "hull"})
    with pytest.raises(InputError, match="needs masks"):
        reconstruct(replace(views, images=StoredPictures(opaque)), tmp_path, config)


def test_a_flat_mesh_is_refused_with_what_to_do() -> None:
    """Seen from its side it leaves no mask."""
    square = torch.tensor([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    sheet = MeshFile(square, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    with pytest.raises(InputError, match=r"no flat sheet.*give it a thickness"):
        plain_hull(photograph(sheet, 32, 32, supersampling=1), ReconstructConfig.tiny())
