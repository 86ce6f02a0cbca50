"""Whether a result is called good or poor, and what is said of a poor one."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

from etsplat import reconstruct
from etsplat.data.photograph import photograph
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.parts import Shape
from etsplat.io.mesh_files import MeshFile
from etsplat.tasks.judgement import (
    Expected,
    Judgement,
    Run,
    Shares,
    Start,
    expect_hull,
    expect_mesh,
    expect_photos,
    judge,
    spread,
)
from etsplat.tasks.reconstruct_config import ReconstructConfig

BALL, RING = Shape(1, 0), Shape(1, 1)
GOOD = {"silhouette_iou": 0.99, "psnr_mesh": 31.0}


def ring() -> MeshFile:
    mesh = trimesh.creation.torus(1.0, 0.3, major_sections=32, minor_sections=16)
    return MeshFile(torch.from_numpy(mesh.vertices.copy()).float(), torch.from_numpy(mesh.faces.copy()).long())


def ball(size: float = 1.0, x: float = 0.0) -> MeshFile:
    vertices, faces = icosphere(2)
    return MeshFile(size * vertices + torch.tensor([x, 0.0, 0.0]), faces)


def bent_rod() -> MeshFile:
    """Around a ring, and a little farther."""
    mesh = trimesh.creation.cylinder(0.3, 1.0, sections=16).subdivide_to_size(0.25)
    x, y, along = torch.from_numpy(mesh.vertices.copy()).float().unbind(1)
    angle = 2.1 * torch.pi * along
    places = torch.stack([(1 + x) * angle.cos(), (1 + x) * angle.sin(), y], dim=1)
    return MeshFile(places, torch.from_numpy(mesh.faces.copy()).long())


def joined(*meshes: MeshFile) -> MeshFile:
    offsets = torch.tensor([0, *(len(mesh.vertices) for mesh in meshes)]).cumsum(0)
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=False)]
    return MeshFile(torch.cat([mesh.vertices for mesh in meshes]), torch.cat(faces))


def judged(
    found: Shape = BALL,
    expected: Shape = BALL,
    scores: Mapping[str, float | None] = GOOD,
    intersecting: float = 0.0,
    *,
    begun: Start = "sphere",
    preset: str = "quick",
    untangled: bool = True,
    photos: int = 40,
    inverted: bool = False,
    lacking: float = 0.0,
    shown: bool = True,
    **shares: float,
) -> Judgement:
    wanted = Expected(expected, None if expected.unclear else "input mesh", shown)
    run = Run(begun, preset, untangled, photos, inverted, lacking)
    return judge("test", scores, intersecting, found, wanted, Shares(**shares), run)


def test_a_patch_that_photos_contradict_is_told():
    assert judged(contradicted=0.004).verdict.startswith("good")
    verdict = judged(contradicted=0.028).verdict
    assert verdict == (
        "poor: photos contradict each other on 2.8 % of its surface, where a hollow may be closed: "
        "try more photos that look into it, or depth maps"
    )


def test_a_plain_piece_is_told_where_nothing_else_is_wrong():
    assert "hollow" not in judged(plain=0.04).verdict
    verdict = judged(plain=0.139).verdict
    assert verdict.startswith("good in silhouettes alone, which show no hollow, on test views: silhouette IoU 0.990, ")
    assert verdict.endswith(
        "; hollows were not compared: 13.9 % of its surface is one plain piece, where photos do not tell a side from a"
        " lid over a hollow: look at it"
    )
    assert "plain piece" not in judged(plain=0.139, contradicted=0.028).verdict


def test_what_is_in_no_photo_is_told_of_a_good_result():
    """It stays good: hardly a capture has the side on which its object stands."""
    assert "no photo" not in judged(unseen=0.04).verdict
    verdict = judged(unseen=0.159).verdict
    assert verdict.startswith("good where photos look, on test views: silhouette IoU 0.990, ")
    assert verdict.endswith("; 15.9 % of its surface is in no photo, where a hollow would be closed: look at it")
    both = judged(unseen=0.159, plain=0.139).verdict
    assert both.startswith("good where photos look, in silhouettes alone, which show no hollow, on test views: ")


def test_few_photos_are_the_first_thing_to_mend_of_a_poor_outline():
    off = {**GOOD, "silhouette_iou": 0.813}
    assert judged(scores=off, photos=3, begun="hull").verdict == (
        "poor: silhouette IoU 0.813 where good results have 0.97 on test views: "
        "try more photos, from all sides: it was made from 3"
    )
    assert "more photos" not in judged(scores=off, photos=16).verdict
    assert judged(photos=3).verdict.startswith("good")


def test_a_hull_that_lacks_thin_parts_is_what_a_poor_outline_is_for_want_of():
    off = {**GOOD, "silhouette_iou": 0.724}
    verdict = judged(scores=off, begun="hull", preset="quick", lacking=0.1298).verdict
    assert verdict.endswith("or init_mesh=: the visual hull that it started from lacks 13 % of what masks show")
    assert "lacks" not in judged(scores=off, begun="hull", preset="quick", lacking=0.02).verdict
    assert judged(begun="hull", lacking=0.1298).verdict.startswith("good")


def test_masks_that_look_inverted_are_said_first_of_a_poor_result():
    off = {**GOOD, "silhouette_iou": 0.86}
    verdict = judged(scores=off, expected=Shape(8, 8), inverted=True).verdict
    assert verdict.startswith("poor: masks are white around the object, not inside it: try them inverted; the result")
    assert judged(inverted=True).verdict.startswith("good")


def test_where_no_photo_says_how_an_object_goes_on_is_told():
    assert judged(cut_off=0.004).verdict.startswith("good")
    assert judged(cut_off=0.016).verdict == (
        "poor: the frame cuts the object off on 1.6 % of the visual hull's surface, where nothing says how it goes on: "
        "try photos that show all of it"
    )


def test_a_hollow_of_the_input_mesh_that_is_closed_is_told():
    assert judged(closed=0.004).verdict.startswith("good")
    assert judged(closed=0.023).verdict == (
        "poor: on 2.3 % of what photos show the result lies far in front of the input mesh, so a hollow is closed: "
        "try init_mesh= with a mesh that has it, or a texture for photos to agree on"
    )


def test_a_film_over_a_hollow_that_was_cut_open_is_told():
    assert judged(grown_over=0.004).verdict.startswith("good")
    assert judged(grown_over=0.012).verdict == (
        "poor: on 1.2 % of what photos show the result lies far in front of the hull as it was cut open, so a film may "
        "have grown over a hollow: try more photos that look into it"
    )


def test_no_hollow_is_called_closed_before_the_outline_is_near():
    assert "hollow" in judged(closed=0.165, scores={**GOOD, "silhouette_iou": 0.93}).verdict
    assert "hollow" not in judged(closed=0.165, scores={**GOOD, "silhouette_iou": 0.76}).verdict


def test_of_a_good_result_nothing_is_said_but_its_numbers():
    verdict = judged().verdict
    assert verdict.startswith("good on test views: silhouette IoU 0.990, PSNR of the mesh 31.00 dB, 0.0 % of the faces")
    assert verdict.endswith("1 part and 0 holes, as the input mesh")
    assert "try" not in verdict


def test_photos_without_masks_have_no_outline_to_judge():
    assert judged(scores={"silhouette_iou": None, "psnr_mesh": 20.0}).verdict.startswith(
        "not judged, since photos have no outlines to compare with: add masks (`etsplat data masks`); on test views:"
    )


def test_other_parts_and_holes_are_said_with_what_to_try():
    found = judged(expected=Shape(2, 4))
    assert found.verdict == (
        'poor: the result has 1 part and 0 holes, the input mesh 2 parts and 4 holes: try start.shape="hull"'
    )
    assert (found.parts, found.holes, found.expected_parts, found.expected_holes) == (1, 0, 2, 4)


def test_a_hull_with_other_holes_has_other_remedies():
    """A sphere can do something about holes that are too many, not about those that lack."""
    mesh = "try init_mesh= with a mesh that has them"
    assert judged(found=Shape(1, 2), expected=Shape(1, 8), begun="hull").verdict.endswith(mesh)
    sphere = mesh.replace("try ", 'try start.shape="sphere" or ')
    assert judged(found=Shape(1, 8), expected=Shape(1, 2), begun="hull").verdict.endswith(sphere)


def test_holes_that_no_silhouette_shows_are_not_held_against_a_result():
    found = judged(expected=Shape(1, 12), shown=False)
    assert found.verdict.endswith(
        "1 part and 0 holes, as silhouettes of the input mesh show it, which has 1 part and 12 holes"
    )
    assert found.expected_holes == 12


@pytest.mark.parametrize(
    ("preset", "remedy"),
    [("quick", 'start.shape="hull" or ReconstructConfig.best()'), ("best", 'start.shape="hull"')],
)
def test_a_poor_outline_is_said(preset, remedy):
    verdict = judged(scores={**GOOD, "silhouette_iou": 0.92}, preset=preset).verdict
    assert verdict == f"poor: silhouette IoU 0.920 where good results have 0.97 on test views: try {remedy}"
    close = judged(scores={**GOOD, "silhouette_iou": 0.96978}, preset=preset).verdict
    assert close.startswith("poor: silhouette IoU 0.969780 where good results have 0.97 on")


@pytest.mark.usefixtures("command_line")
def test_what_to_try_is_an_option_where_the_command_line_runs():
    """Elsewhere, as the other tests here have it, what a function or a config takes."""
    off = judged(scores={**GOOD, "silhouette_iou": 0.92}, preset="quick", untangled=False, intersecting=3.14).verdict
    assert "on test views: try --start.shape hull or --preset best; " in off
    assert off.endswith("cut through others: try --refinement.untanglings 6")
    finer = expect_hull(Shape(1, 0), Shape(1, 1), 2000).shape.unclear
    assert finer == "a finer visual hull has 1 part and 1 hole: try --start.hull-faces 2000 --max-faces 4000"


def test_faces_that_cut_through_others_are_said():
    assert judged(intersecting=3.14).verdict == 'poor: 3.1 % of its faces cut through others: try start.shape="hull"'
    assert judged(intersecting=3.14, untangled=False).verdict.endswith("try refinement.untanglings=6")
    assert judged(intersecting=0.9).verdict.startswith("good")


def test_an_open_result_of_a_closed_input_is_poor():
    found = judged(found=Shape(None, None, "is not closed"), begun="hull")
    assert found.verdict == (
        'poor: the result is not closed, the input mesh is a closed surface: try start.shape="sphere"'
    )


def test_an_open_input_is_said_and_not_compared():
    found = judged(expected=Shape(None, None, "the input mesh is not closed"))
    assert found.verdict.endswith("parts and holes were not compared: the input mesh is not closed")
    assert (found.expected_of, found.expected_parts) == (None, None)


def test_an_input_mesh_is_welded_and_counted():
    """A ring whose faces share no vertex; and a ball inside of another, which nobody sees."""
    torus = ring()
    apart = MeshFile(torus.vertices[torus.faces].reshape(-1, 3), torch.arange(3 * len(torus.faces)).reshape(-1, 3))
    photos = photograph(torus, 32, 32, supersampling=1)
    assert expect_mesh(apart, photos, RING, 1.05) == Expected(RING, "input mesh")
    assert expect_mesh(joined(ball(), ball(0.5)), photos, BALL, 1.05) == Expected(BALL, "input mesh")
    assert expect_mesh(joined(ball(), ball(x=3)), photos, Shape(2, 0), 1.05).shape == Shape(2, 0)


def test_inputs_whose_parts_are_unclear_say_why():
    photos = photograph(ball(), 16, 16, supersampling=1)
    opened = ball()
    opened = replace(opened, faces=opened.faces[1:])
    assert expect_mesh(opened, photos, BALL, 1.05).shape.unclear == "the input mesh is not closed"
    crossing = expect_mesh(joined(ball(), ball(x=1)), photos, BALL, 1.05)
    assert crossing.shape.unclear == "the input mesh has parts that cut through each other"


def test_silhouettes_tell_whether_a_ring_is_a_ring():
    """What the result is does not decide what they show; and a hole of the mesh that they do show counts."""
    photos = photograph(ring(), 96, 96, supersampling=1)
    assert expect_photos(photos, RING, 1.05) == Expected(RING, "visual hull")
    assert expect_photos(photos, BALL, 1.05) == Expected(RING, "visual hull")
    assert expect_mesh(ring(), photos, BALL, 1.05).shown
    assert not expect_mesh(ring(), photograph(ball(), 48, 48, supersampling=1), BALL, 1.05).shown


def test_holes_that_the_input_mesh_has_not_are_wrong_though_the_hull_has_them_too():
    """A hull may have a hole that is none of the object's, and so excuses none of a result's."""
    expected = expect_mesh(ball(), photograph(ring(), 96, 96, supersampling=1), RING, 1.05)
    assert expected == Expected(BALL, "input mesh")


def test_a_mesh_that_cuts_through_itself_has_not_the_holes_that_are_seen():
    """The ends of a bent rod in each other: a ring to look at, without a hole as a surface."""
    photos = photograph(bent_rod(), 96, 96, supersampling=1)
    assert expect_mesh(bent_rod(), photos, BALL, 1.05) == Expected(BALL, "input mesh")
    assert expect_mesh(bent_rod(), photos, RING, 1.05).shape.unclear == (
        "the input mesh cuts through itself: its own surface has 1 part and 0 holes, the result, as silhouettes show"
        " it, 1 part and 1 hole"
    )


def test_views_are_spread_evenly():
    assert spread(range(10), 5) == [0, 2, 4, 6, 8]
    assert spread([3, 5], 16) == [3, 5]


def test_a_run_from_photos_alone_ends_with_a_verdict_everywhere(tmp_path: Path):
    """A ring from a sphere, without test views: poor, by the training views; in metrics, README.txt and result."""
    photos = photograph(ring(), 48, 48, supersampling=1)
    photos = replace(photos, train=sorted([*photos.train, *photos.test]), test=[])
    config = ReconstructConfig.tiny().changed({"iterations": 5})
    result = reconstruct(photos, tmp_path / "run", config)
    found = result.metrics["judgement"]
    assert result.metrics["silhouette_iou"] is None
    assert (found["views"], found["expected_of"]) == ("training", "visual hull")
    assert 0 < found["silhouette_iou"] < 0.97
    assert (found["parts"], found["holes"], found["expected_holes"]) == (1, 0, 1)
    assert result.verdict.startswith("poor: the result has 1 part and 0 holes, the visual hull 1 part and 1 hole: try")
    readme = (tmp_path / "run" / "README.txt").read_text()
    assert readme.endswith(f"\nThe result is {result.verdict}.\n")
    assert len(re.findall("The result is", readme)) == 1
    assert "The result is poor" in result._repr_html_()
