"""Whether a reconstruction is good: its outline, its faces, its parts and holes; and what to try where it is not.

The limits are what good and bad runs were found to have; research/results.md has the numbers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from etsplat.core.spelling import either, option
from etsplat.data.dataset import Dataset
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.intersections import intersecting_faces
from etsplat.geometry.parts import Shape, shape_of
from etsplat.io.mesh_files import MeshFile, weld_vertices

Views = Literal["test", "training"]
Start = Literal["sphere", "hull", "mesh"]

GOOD_IOU = 0.97
"""Silhouette IoU that good results have at least."""

GOOD_INTERSECTING = 1.0
"""Percentage of faces that cut through others, which good results have at most."""

CONTRADICTED = 0.005
"""Share of the surface that photos contradict in one patch, which good results have at most."""

DOUBTED = 0.0025
"""Share of a start's surface in one patch, from which on its result is asked for what photos contradict."""

CLOSED = 0.005
"""Share of what photos see of an input mesh that lies far behind the result, of good results at most."""

PLAIN = 0.05
"""Share of the surface in one patch on which photos show nothing to compare: from there on the verdict says so."""

UNSEEN = 0.05
"""Share of the surface that no photo shows: from there on the verdict says so. Of a cube, its bottom is 0.17."""

CONVERGED = 0.9
"""Silhouette IoU below which a result is too far from an input mesh for a hollow to be called closed."""

FEW_PHOTOS = 16
"""With fewer training photos it is more photos that a poor outline needs."""

LACKING = 0.03
"""Part of what masks show that the visual hull leaves out: from there on a poor outline is for want of that."""

CUT_OFF = 0.005
"""Share of the visual hull's surface where the frame cuts it off, which good results have at most."""

TRAINING_VIEWS = 16
"""So many training views, evenly spaced, are looked at where there are no test views."""

_HULL_FACES = 12_500
"""Of the hull whose holes are counted: enough for spokes and crossbars that are 3 % of the object."""

_HULL_VIEWS = (16, 64)
"""The hull is carved from so many views: from more only where the few say that something is wrong."""


@dataclass(frozen=True)
class Expected:
    """What a result should look like.

    Attributes:
        shape: parts and holes, or why they are unclear, in a sentence.
        of: what has them: "input mesh" or "visual hull"; None where they are unclear.
        shown: whether silhouettes show them; a tunnel that nobody can look through is in none.
    """

    shape: Shape
    of: str | None
    shown: bool = True

    @classmethod
    def unclear(cls, reason: str) -> "Expected":
        """Nothing is known, because `reason`."""
        return cls(Shape(None, None, reason), None)


@dataclass(frozen=True)
class Judgement:
    """What metrics.json has under "judgement".

    Attributes:
        views: which photos were looked at: "test", or "training" where there are no test views.
        silhouette_iou: mean over them; None without masks.
        psnr_mesh: of the opaque mesh, mean over them, in dB.
        intersecting_percent: faces of the result that cut through others.
        parts: of the result; None, as `holes`, where it is no closed manifold.
        holes: of the result.
        expected_parts: what it should have; None, as `expected_holes`, where that is not known.
        expected_holes: what it should have.
        expected_of: "input mesh" or "visual hull"; None where neither tells.
        verdict: a sentence that begins with "good" or "poor"; of a poor result it says what is wrong and what to try,
            of a good one of photos first that it is so "in silhouettes alone", where a large piece is plain, or "where
            photos look", where they leave much of it out.
    """

    views: Views
    silhouette_iou: float | None
    psnr_mesh: float | None
    intersecting_percent: float
    parts: int | None
    holes: int | None
    expected_parts: int | None
    expected_holes: int | None
    expected_of: str | None
    verdict: str

    def to_dict(self) -> dict[str, Any]:
        """As in metrics.json."""
        return asdict(self)


def expect_mesh(truth: MeshFile, photos: Dataset, found: Shape, radius: float) -> Expected:
    """What a result for an input mesh should look like. Where `found` is something else, its `photos` are asked too.

    They may excuse what a result lacks, since no silhouette shows a tunnel that nobody can look through. Holes and
    parts that the mesh has not are wrong whatever a hull has, unless the mesh cuts through itself: then what is seen
    of it need not have its parts and holes.
    """
    shape = true_shape(truth)
    if shape.unclear:
        return Expected.unclear(f"the input mesh {shape.unclear}")
    if shape == found or expect_photos(photos, found, radius).shape != found:
        return Expected(shape, "input mesh")
    if _lacks(found, shape):
        return Expected(shape, "input mesh", shown=False)
    if _cuts_itself(weld_vertices(truth)):
        own = f"its own surface has {_counted(shape)}, the result, as silhouettes show it, {_counted(found)}"
        return Expected.unclear(f"the input mesh cuts through itself: {own}")
    return Expected(shape, "input mesh")


def _lacks(found: Shape, wanted: Shape) -> bool:
    """Whether nothing is too much in what was found."""
    return (found.parts or 0) <= (wanted.parts or 0) and (found.holes or 0) <= (wanted.holes or 0)


def _cuts_itself(welded: MeshFile) -> bool:
    return bool(intersecting_faces(welded.vertices, welded.faces).any())


def true_shape(truth: MeshFile) -> Shape:
    """The parts and holes of a mesh that is the truth; unclear also where its parts cut through each other."""
    welded = weld_vertices(truth)
    shape = shape_of(welded.vertices, welded.faces)
    if shape.parts not in (None, 1) and _cuts_itself(welded):
        return Shape(None, None, "has parts that cut through each other")
    return shape


def expect_photos(photos: Dataset, found: Shape, radius: float) -> Expected:
    """What the silhouettes say of a result with the shape `found`; `radius` as `visual_hull` takes it."""
    if not photos.has_masks:
        return Expected.unclear("the photos have no masks")
    shape = found
    for count in _HULL_VIEWS:
        vertices, faces = visual_hull(replace(photos, train=spread(photos.train, count)), _HULL_FACES, radius=radius)
        if len(faces) == 0:
            return Expected.unclear("the silhouettes have no point in common")
        shape = shape_of(vertices, faces)
        if shape == found or count >= len(photos.train):
            break
    return expect_hull(shape)


def expect_hull(shape: Shape, finer: Shape | None = None, finer_faces: int = 0) -> Expected:
    """What a result should look like whose visual hull has this shape; unclear where a `finer` one has another."""
    if finer is not None:
        has = finer.unclear or f"has {_counted(finer)}"
        faces = (option("start.hull_faces", finer_faces), option("max_faces", 2 * finer_faces))
        remedy = f"try {either(' ', ' and ').join(faces)}"
        return Expected.unclear(f"a finer visual hull {has}: {remedy}")
    return Expected.unclear(f"the visual hull {shape.unclear}") if shape.unclear else Expected(shape, "visual hull")


def spread(items: Sequence[int], count: int) -> list[int]:
    """At most so many of the items, evenly spaced."""
    kept = min(count, len(items))
    return [items[number * len(items) // kept] for number in range(kept)]


@dataclass(frozen=True)
class Run:
    """What a run was like, which decides what to try next.

    Attributes:
        begun: what it started from.
        preset: of it.
        untangled: whether faces that cut through others were smoothed away.
        photos: how many it was trained on.
        inverted: whether their masks look as if they were white outside the object.
        lacking: the part of what masks show that the hull that it started from leaves out; 0 of another start.
    """

    begun: Start
    preset: str
    untangled: bool
    photos: int
    inverted: bool = False
    lacking: float = 0.0

    @property
    def hull(self) -> str | None:
        """How to start from the hull, where it has not."""
        return option("start.shape", "hull") if self.begun == "sphere" else None

    @property
    def longer(self) -> str | None:
        """How to run longer, where it could."""
        return None if self.preset == "best" else either("--preset best", "ReconstructConfig.best()")


@dataclass(frozen=True)
class Shares:
    """Fractions of a surface on which something is wrong or not known.

    Attributes:
        contradicted: the largest patch that photos contradict.
        cut_off: where the visual hull ends because photos do, of its surface.
        closed: where the result fills a hollow of the input mesh, of what photos see of it.
        grown_over: the same of a hollow that was cut out of the hull; 0 where a mesh was photographed.
        plain: the largest patch on which photos show nothing to compare; 0 where hollows are compared with those of
            the input mesh.
        unseen: what no photo shows; 0 where a mesh was photographed, so that the rest is known.
    """

    contradicted: float = 0.0
    cut_off: float = 0.0
    closed: float = 0.0
    grown_over: float = 0.0
    plain: float = 0.0
    unseen: float = 0.0


def judge(
    views: Views,
    scores: Mapping[str, float | None],
    intersecting_percent: float,
    found: Shape,
    expected: Expected,
    shares: Shares,
    run: Run,
) -> Judgement:
    """Judges a result.

    Args:
        views: what the scores are means over.
        scores: "silhouette_iou" and "psnr_mesh".
        intersecting_percent: faces that cut through others.
        found: what the result looks like.
        expected: what it should look like.
        shares: where something is wrong with its surface, or not known.
        run: that it is of.
    """
    iou = scores["silhouette_iou"]
    poor = [
        *_unlike(found, expected, run),
        *([] if iou is None else _off(iou, views, run)),
        *_tangled(intersecting_percent, run),
        *_wrong_places(shares, converged=iou is None or iou >= CONVERGED),
    ]
    if poor and run.inverted:
        poor.insert(0, "masks are white around the object, not inside it: try them inverted")
    praise = f"on {views} views: {_praise(scores, intersecting_percent, found, expected)}"
    good = f"good {_reserved(praise, shares)}"
    if iou is None:
        good = f"not judged, since photos have no outlines to compare with: add masks (`etsplat data masks`); {praise}"
    return Judgement(
        views=views,
        silhouette_iou=iou,
        psnr_mesh=scores["psnr_mesh"],
        intersecting_percent=intersecting_percent,
        parts=found.parts,
        holes=found.holes,
        expected_parts=expected.shape.parts,
        expected_holes=expected.shape.holes,
        expected_of=expected.of,
        verdict=f"poor: {'; '.join(poor)}" if poor else good,
    )


def _unlike(found: Shape, expected: Expected, run: Run) -> list[str]:
    """What is wrong with parts and holes."""
    poor = []
    if expected.shown and _differ(found, expected.shape):
        fewer = run.begun == "hull" and (found.holes or 0) > (expected.shape.holes or 0)
        sphere = f"{option('start.shape', 'sphere')} or "
        remedy = run.hull or f"{sphere * fewer}{option('init_mesh', ...)} with a mesh that has them"
        poor.append(f"the result has {_counted(found)}, the {expected.of} {_counted(expected.shape)}: try {remedy}")
    if found.unclear and expected.of == "input mesh":
        sphere = option("start.shape", "sphere")
        poor.append(f"the result {found.unclear}, the input mesh is a closed surface: try {sphere}")
    return poor


def _off(iou: float, views: Views, run: Run) -> list[str]:
    """What is wrong with the outline."""
    if iou >= GOOD_IOU:
        return []
    mesh = option("init_mesh", ...)
    remedies = " or ".join(filter(None, (run.hull, run.longer))) or f"{mesh}, and check masks and poses"
    if run.lacking > LACKING:
        part = f"the visual hull that it started from lacks {100 * run.lacking:.0f} % of what masks show"
        remedies = f"masks that have thin parts whole, photos that show them larger, or {mesh}: {part}"
    if run.photos < FEW_PHOTOS:
        remedies = f"more photos, from all sides: it was made from {run.photos}"
    shown = f"{iou:.3f}" if round(iou, 3) < GOOD_IOU else f"{iou:.6f}"
    return [f"silhouette IoU {shown} where good results have {GOOD_IOU:.2f} on {views} views: try {remedies}"]


def _tangled(intersecting_percent: float, run: Run) -> list[str]:
    if intersecting_percent <= GOOD_INTERSECTING:
        return []
    better = run.hull or run.longer or option("init_mesh", ...)
    remedy = better if run.untangled else option("refinement.untanglings", 6)
    return [f"{intersecting_percent:.1f} % of its faces cut through others: try {remedy}"]


def _wrong_places(shares: Shares, *, converged: bool) -> list[str]:
    """What is wrong with pieces of the surface."""
    poor = []
    if shares.contradicted > CONTRADICTED:
        poor.append(
            f"photos contradict each other on {100 * shares.contradicted:.1f} % of its surface, where a hollow may be "
            "closed: try more photos that look into it, or depth maps"
        )
    if shares.cut_off > CUT_OFF:
        poor.append(
            f"the frame cuts the object off on {100 * shares.cut_off:.1f} % of the visual hull's surface, where "
            "nothing says how it goes on: try photos that show all of it"
        )
    if shares.closed > CLOSED and converged:
        remedy = f"try {option('init_mesh', ...)} with a mesh that has it, or a texture for photos to agree on"
        poor.append(
            f"on {100 * shares.closed:.1f} % of what photos show the result lies far in front of the input mesh, so a "
            f"hollow is closed: {remedy}"
        )
    if shares.grown_over > CLOSED and converged:
        poor.append(
            f"on {100 * shares.grown_over:.1f} % of what photos show the result lies far in front of the hull as it "
            "was cut open, so a film may have grown over a hollow: try more photos that look into it"
        )
    return poor


def _reserved(praise: str, shares: Shares) -> str:
    """Praise with what photos leave open: first how far it goes, and why at the end."""
    if shares.plain > PLAIN:
        praise = (
            f"in silhouettes alone, which show no hollow, {praise}; hollows were not compared: "
            f"{100 * shares.plain:.1f} % of its surface is one plain piece, where photos do not tell a side from a lid "
            "over a hollow: look at it"
        )
    if shares.unseen > UNSEEN:
        praise = (
            f"where photos look, {praise}; {100 * shares.unseen:.1f} % of its surface is in no photo, where a hollow "
            "would be closed: look at it"
        )
    return praise


def _differ(found: Shape, expected: Shape) -> bool:
    clear = not (found.unclear or expected.unclear)
    return clear and (found.parts, found.holes) != (expected.parts, expected.holes)


def _praise(scores: Mapping[str, float | None], intersecting_percent: float, found: Shape, expected: Expected) -> str:
    seen = (("silhouette IoU {:.3f}", scores["silhouette_iou"]), ("PSNR of the mesh {:.2f} dB", scores["psnr_mesh"]))
    said = [form.format(value) for form, value in seen if value is not None]
    said.append(f"{intersecting_percent:.1f} % of the faces cut through others")
    if found.unclear or expected.shape.unclear:
        reason = f"the result {found.unclear}" if found.unclear else expected.shape.unclear
        return f"{', '.join(said)}; parts and holes were not compared: {reason}"
    unseen = f"as silhouettes of the {expected.of} show it, which has {_counted(expected.shape)}"
    same = f"as the {expected.of}" if expected.shown else unseen
    return f"{', '.join(said)}; {_counted(found)}, {same}"


def _counted(shape: Shape) -> str:
    return f"{shape.parts} part{'s' * (shape.parts != 1)} and {shape.holes} hole{'s' * (shape.holes != 1)}"
