"""Terms of objectives: the paper's L_mesh and L_nvs, one by one and together."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import etsplat
from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.core.rasterization import Rasterization
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.metrics.depth import DepthKind
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.triangle_area import mean_area
from etsplat.optim.depth_trust import DepthTrust
from etsplat.optim.objective import Custom, Drawing, Objective, Term
from etsplat.optim.terms import named_terms
from etsplat.optim.terms.depth import Depth
from etsplat.optim.terms.mesh import EdgeLength, Laplacian, SmoothNormals, Softness
from etsplat.optim.terms.photometric import Photometric
from etsplat.optim.terms.soup import DepthNormals, Distortion, Harmonics, Opacity, Size
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.train_config import TrainConfig
from helpers.engines import device_of, on

# Two faces that share the edge (0, 2) of a folded unit square.
VERTICES = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.0, 1.0, 0.0], [0.0, 1.0, 0.25]]
FACES = [[0, 1, 2], [0, 2, 3]]
CAMERA = Cameras(torch.eye(4)[None], torch.eye(3)[None], 7, 5)


def a_mesh(sigma: float = 0.5) -> TriangleMesh:
    vertices = torch.tensor(VERTICES, dtype=torch.float64)
    return TriangleMesh.from_mesh(vertices, torch.tensor(FACES), colors=0.3, opacity=0.9, sigma=sigma)


def a_drawing(rng: torch.Generator, mesh: TriangleMesh | None = None) -> Drawing:
    color = torch.rand(1, 5, 7, 3, generator=rng, dtype=torch.float64)
    straight = torch.rand(1, 5, 7, 4, generator=rng, dtype=torch.float64)
    photo = torch.cat([straight[..., :3] * straight[..., 3:], straight[..., 3:]], dim=-1)
    background = torch.rand(1, 3, generator=rng, dtype=torch.float64)
    return Drawing(mesh or a_mesh(), CAMERA, photo, None, background, Rasterization(color, color[..., :1]))


def value(drawing: Drawing, terms: list[Term], scale: float = 1.0) -> float:
    objective = Objective(Photometric(), terms, scale=scale)
    return float(objective(drawing, objective.weights(1), scale).detach())


def distance(i: int, j: int) -> float:
    return math.dist(VERTICES[i], VERTICES[j])


def to_mean(i: int, neighbors: list[int]) -> float:
    return math.dist(VERTICES[i], [sum(VERTICES[j][k] for j in neighbors) / len(neighbors) for k in range(3)])


def unit_normal(face: list[int]) -> list[float]:
    a, b, c = (VERTICES[i] for i in face)
    u, v = [b[k] - a[k] for k in range(3)], [c[k] - a[k] for k in range(3)]
    n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    return [x / math.hypot(*n) for x in n]


EDGES = [(0, 1), (1, 2), (0, 2), (2, 3), (0, 3)]
EXPECTED = {
    "edge": sum(distance(i, j) for i, j in EDGES) / 5,
    "edge squared": sum(distance(i, j) ** 2 for i, j in EDGES) / 5,
    "normal": 1 - sum(a * b for a, b in zip(unit_normal(FACES[0]), unit_normal(FACES[1]), strict=True)),
    "laplacian": (to_mean(0, [1, 2, 3]) + to_mean(1, [0, 2]) + to_mean(2, [0, 1, 3]) + to_mean(3, [0, 2])) / 4,
    "softness": 1 / 0.5**2,
}


@pytest.mark.parametrize(
    ("name", "term"),
    [
        ("edge", EdgeLength()),
        ("edge squared", EdgeLength(power=2)),
        ("normal", SmoothNormals()),
        ("laplacian", Laplacian()),
        ("softness", Softness()),
    ],
)
def test_each_term_is_the_papers_formula(rng: torch.Generator, name: str, term: Term) -> None:
    """With one weight at 1 and scale 0.7, the objective exceeds the photometric loss by 0.7 of that term."""
    drawing = a_drawing(rng)
    assert value(drawing, [term], 0.7) - value(drawing, []) == pytest.approx(0.7 * EXPECTED[name], rel=1e-12)


def test_the_photometric_term_compares_over_the_same_background(rng: torch.Generator) -> None:
    """L_c is the mean of |color - (rgb + (1 - a) background)| with the background of the view."""
    drawing = a_drawing(rng)
    composited = drawing.photo[..., :3] + (1 - drawing.photo[..., 3:]) * drawing.background[:, None, None]
    difference = float((drawing.rendering.color - composited).abs().mean())
    assert value(drawing, [EdgeLength(1.5)], 0.0) == pytest.approx(difference, rel=1e-12)


@pytest.mark.parametrize("dssim", [0.0, 0.2])
def test_the_root_of_squares_stands_in_the_place_of_the_mean_difference(rng: torch.Generator, dssim: float) -> None:
    """Beside SSIM, whose share is the same; where the picture is the photo its gradient is finite."""
    drawing = a_drawing(rng)
    backgrounds = drawing.background
    composited = drawing.photo[..., :3] + (1 - drawing.photo[..., 3:]) * backgrounds[:, None, None]
    root = float((drawing.rendering.color - composited).square().mean().sqrt())
    mean = float((drawing.rendering.color - composited).abs().mean())
    expected = float(Photometric(dssim)(drawing)) + (1 - dssim) * (root - mean)
    assert float(Photometric(dssim, pixel="rms")(drawing)) == pytest.approx(expected, rel=1e-8)
    same = composited.clone().requires_grad_(True)
    picture = replace(drawing, rendering=Rasterization(same, same[..., :1]))
    Photometric(dssim, pixel="rms")(picture).backward()
    assert same.grad is not None
    assert float(same.grad.abs().max()) < 1e-3


@pytest.mark.parametrize("first", ["edge", "normal"])
def test_the_papers_weights_add_up(rng: torch.Generator, first: str) -> None:
    """With lambda 1.5, 0.01, 0.5 and 1e-4 the objective is L_c + gamma times the weighted sum, in whatever order."""
    weights = {"edge squared": 1.5, "normal": 0.01, "laplacian": 0.5, "softness": 1e-4}
    terms = [EdgeLength(1.5, power=2), SmoothNormals(0.01), Laplacian(0.5), Softness(1e-4)]
    drawing = a_drawing(rng)
    expected = value(drawing, []) + 0.25 * sum(weight * EXPECTED[name] for name, weight in weights.items())
    chosen = terms if first == "edge" else terms[::-1]
    assert value(drawing, chosen, 0.25) == pytest.approx(expected, rel=1e-12)


def test_softness_pushes_sigma_up(rng: torch.Generator) -> None:
    """The gradient of sigma^-2 with respect to log sigma is -2 sigma^-2: descent makes a small sigma larger."""
    drawing = a_drawing(rng, a_mesh(sigma=0.1))
    objective = Objective(Photometric(), [Softness(1e-3)])
    objective(drawing, objective.weights(1), 1.0).backward()
    assert float(drawing.model.log_sigma.grad) == pytest.approx(-2 * 1e-3 / 0.1**2, rel=1e-12)


def test_terms_of_a_mesh_refuse_a_soup(rng: torch.Generator) -> None:
    """In words, rather than by an attribute that is missing."""
    _, drawing = a_soups_drawing(rng, ("color",))
    with pytest.raises(ValueError, match="EdgeLength needs a TriangleMesh, got a TriangleSoup"):
        EdgeLength()(drawing)


def test_a_weight_follows_the_iteration_and_at_zero_nothing_is_computed(rng: torch.Generator) -> None:
    """A term that would fail is not asked before its time, nor are its outputs of the renderer."""

    def fails(drawing: Drawing) -> Tensor:
        raise RuntimeError

    late = Custom(fails, lambda iteration: float(iteration > 5), outputs=("depth",))
    objective, drawing = Objective(Photometric(), [late]), a_drawing(rng)
    assert objective.weights(5) == (0.0,)
    assert objective.outputs(objective.weights(5)) == ("color",)
    objective(drawing, objective.weights(5), 1.0)
    assert objective.outputs(objective.weights(6)) == ("color", "depth")
    with pytest.raises(RuntimeError):
        objective(drawing, objective.weights(6), 1.0)


def test_of_several_views_each_counts_its_share_and_parameters_once(rng: torch.Generator) -> None:
    """Mean over views of what looks at pictures, plus what looks at parameters alone, with the last view."""
    mesh = a_mesh()
    drawings = [a_drawing(rng, mesh) for _ in range(3)]
    bright = Custom(lambda drawing: drawing.rendering.color.mean(), 0.5, outputs=("color",))
    objective = Objective(Photometric(), [EdgeLength(1.5), bright])
    weights = objective.weights(1)
    parts = [objective(d, weights, 0.3, views=3, whole=number == 2) for number, d in enumerate(drawings)]
    seen = [value(d, [bright], 0.3) for d in drawings]
    assert float(sum(parts).detach()) == pytest.approx(sum(seen) / 3 + 0.3 * 1.5 * EXPECTED["edge"], rel=1e-12)


def test_parameters_start_where_they_are_told_to() -> None:
    """Opacity, sigma and colour come back from their parametrisation; the display colours are clamped."""
    mesh = a_mesh(sigma=0.25)
    assert mesh.opacities.tolist() == pytest.approx([0.9, 0.9])
    assert float(mesh.sigma.detach()) == pytest.approx(0.25)
    with torch.no_grad():
        mesh.colors[0] = torch.tensor([-0.5, 0.5, 1.5])
    assert mesh.display_colors[0].tolist() == [0.0, 0.5, 1.0]


SIZE = 40


def a_soups_drawing(rng: torch.Generator, outputs: tuple[str, ...], device: str = "cpu") -> tuple[Cameras, Drawing]:
    soup = TriangleSoup.from_triangles(
        0.8 * torch.randn((30, 3, 3), generator=rng),
        torch.rand((30, 3), generator=rng),
        opacity=0.6,
        sigma=0.5,
        sh_degree=0,
    ).to(torch.device(device))
    viewmats = look_at(torch.tensor([[0.6, 0.4, 3.0]]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
    camera = Cameras(viewmats, intrinsics(45, SIZE, SIZE)[None], SIZE, SIZE).to(torch.device(device))
    photo = (255 * torch.rand((1, SIZE, SIZE, 3), generator=rng)).to(device, torch.uint8)
    rendering = soup.render(camera, outputs=outputs, depth_of="centroid")
    return camera, Drawing(soup, camera, photo, None, torch.zeros(1, 3, device=device), rendering)


@pytest.mark.sanitize
def test_mean_area_agrees_with_the_float64_reference(engine, rng):
    """Value and gradient; a triangle without area has none."""
    vertices = torch.randn((5000, 3, 3), generator=rng)
    vertices[7] = vertices[7, :1]
    results = []
    for name, tensor in ((engine, vertices), (None, vertices[torch.arange(5000) != 7].double())):
        leaf = tensor.clone().requires_grad_()
        area = on(name, mean_area, leaf)
        (2.0 * area).backward()
        results.append((area.detach(), leaf.grad))
    assert float(results[0][0]) == pytest.approx(float(results[1][0]) * 4999 / 5000, rel=1e-6)
    assert float(results[0][1][7].abs().max()) == 0
    kept = results[0][1][torch.arange(5000) != 7]
    torch.testing.assert_close(kept.double(), results[1][1] * 4999 / 5000, rtol=1e-4, atol=1e-9)


@pytest.mark.sanitize
def test_mean_area_has_the_same_bits_for_any_number_of_threads(rng):
    """Ranges are added in a fixed order."""
    vertices, before = torch.randn((9000, 3, 3), generator=rng), num_threads()
    areas = []
    for count in (1, 3):
        set_num_threads(count)
        areas.append(mean_area(vertices))
    set_num_threads(before)
    assert torch.equal(areas[0], areas[1])


def test_every_term_of_a_soup_adds_with_its_weight(rng: torch.Generator, engine: str) -> None:
    """The objective is the weighted sum of the terms, each of which can be had alone."""
    kinds: dict[str, tuple[type[Term], float]] = {
        "opacity": (Opacity, 0.3),
        "size": (Size, 0.02),
        "normal": (DepthNormals, 0.5),
        "distortion": (Distortion, 2.0),
    }
    with etsplat.engine(engine):
        _, drawing = a_soups_drawing(rng, ("color", "normal", "median_depth", "distortion"), device_of(engine))

        def objective(*terms: Term) -> float:
            whole = Objective(Photometric(0.2), terms)
            return float(whole(drawing, whole.weights(1), 1.0).detach())

        plain = objective()
        terms = {name: objective(kind(weight)) - plain for name, (kind, weight) in kinds.items()}
        assert all(term > 0 for term in terms.values())
        together = objective(*(kind(weight) for kind, weight in kinds.values()))
    assert together == pytest.approx(plain + sum(terms.values()), rel=1e-5)
    assert terms["opacity"] == pytest.approx(0.3 * 0.6, rel=1e-4)
    assert terms["size"] == pytest.approx(0.02 / float(mean_area(drawing.model.vertices).detach()), rel=1e-4)


def test_spared_triangles_count_as_transparent(rng: torch.Generator) -> None:
    """The mean is still over all of them."""
    _, drawing = a_soups_drawing(rng, ("color",))
    spared = torch.arange(30) < 10
    assert float(Opacity(spared=lambda _: spared)(drawing).detach()) == pytest.approx(0.4, rel=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_harmonics_are_the_squares_of_a_triangle_in_the_mean(rng: torch.Generator, degree: int) -> None:
    """Its gradient is 2 c / N; the constant band does not count, and colours without others have 0."""
    _, drawing = a_soups_drawing(rng, ("color",))
    vertices, colors = torch.rand((7, 3, 3), generator=rng), torch.rand((7, 3), generator=rng)
    soup = TriangleSoup.from_triangles(vertices, colors, opacity=0.5, sigma=0.5, sh_degree=degree)
    with torch.no_grad():
        soup.sh_rest.copy_(torch.randn(soup.sh_rest.shape, generator=rng))
    of_soup = Harmonics()(replace(drawing, model=soup))
    of_soup.backward()
    expected = soup.sh_rest.detach().double().square().sum() / 7
    assert float(of_soup.detach()) == pytest.approx(float(expected), rel=1e-5)
    torch.testing.assert_close(soup.sh_rest.grad, 2 * soup.sh_rest.detach() / 7)
    assert soup.sh_dc.grad is None


def test_every_weight_among_the_settings_is_that_of_a_term() -> None:
    """And every term with a name has a setting."""
    groups = (ReconstructConfig().regularization, TrainConfig().loss)
    weights = {name for group in groups for name in vars(group) if name.startswith("lambda_")}
    assert weights - {"lambda_dssim"} == {f"lambda_{name}" for name in named_terms()}


def test_an_alias_of_a_type_in_a_module_of_terms_is_no_term(
    monkeypatch: pytest.MonkeyPatch, looks_like_a_class: object
) -> None:
    known = named_terms()
    monkeypatch.setattr("etsplat.optim.terms.soup.Spared", looks_like_a_class)
    assert named_terms() == known


def a_depth_drawing(depth: Tensor, said: Tensor, alpha: float = 1.0) -> Drawing:
    color = torch.zeros(1, *depth.shape, 3)
    rendering = Rasterization(color, torch.full((1, *depth.shape, 1), alpha), depth=depth[None, ..., None])
    index = torch.tensor([0])
    return Drawing(None, CAMERA, color, None, torch.zeros(1, 3), rendering, index=index, depth=said[None])


def believing(kind: DepthKind, *, inverse: bool = False, used: float = 1.0) -> DepthTrust:
    trust = DepthTrust([0])
    trust.load_state(
        {"decided": torch.tensor([1 + (kind == "pearson"), inverse, 1, 0, 0]), "used": torch.tensor([used])}
    )
    return trust


def test_depth_is_compared_where_it_is_known():
    """2 |z - d| / (z + d), mean over the known pixels; its gradient has the sign of the error and no more anywhere."""
    depth = torch.tensor([[2.0, 3.0], [4.0, 0.0]], requires_grad=True)
    said = torch.tensor([[1.0, 3.0], [0.0, 5.0]])
    loss = Depth(1.0, believing("l1"))(a_depth_drawing(depth, said))
    assert float(loss.detach()) == pytest.approx((2 * 1 / 3 + 0) / 2)
    loss.backward()
    assert depth.grad is not None
    assert depth.grad[0, 0] > 0
    assert depth.grad[1].tolist() == [0.0, 0.0]
    far = torch.full((2, 2), 1e6)
    assert float(Depth()(a_depth_drawing(depth.detach(), far))) <= 2


def test_correlation_does_not_see_scale_shift_and_few_wild_numbers():
    rng = torch.Generator().manual_seed(0)
    depth = 1 + torch.rand((20, 20), generator=rng)
    term = Depth(1.0, believing("pearson"))
    assert float(term(a_depth_drawing(depth, 3 * depth + 2))) == pytest.approx(0, abs=1e-5)
    assert float(term(a_depth_drawing(depth, 9 - 3 * depth))) == pytest.approx(2, abs=1e-5)
    wild = 3 * depth + 2
    wild[0, 0] = 1e4
    assert float(term(a_depth_drawing(depth, wild))) == pytest.approx(0, abs=1e-4)
    inverse = Depth(1.0, believing("pearson", inverse=True))
    assert float(inverse(a_depth_drawing(depth, 1 / depth))) == pytest.approx(0, abs=1e-5)


def test_a_map_that_is_not_believed_counts_nothing():
    """Nor a photo without a map, nor, as a weight, anything before maps are believed."""
    depth, said = torch.full((2, 2), 2.0), torch.full((2, 2), 3.0)
    for kind in ("l1", "pearson"):
        assert float(Depth(1.0, believing(kind, used=0.0))(a_depth_drawing(depth, said))) == 0
    assert float(Depth()(replace(a_depth_drawing(depth, said), depth=None))) == 0
    trust = believing("l1")
    objective = Objective(Photometric(), [Depth(0.5, trust)])
    assert objective.weights(1) == (0.5,)
    trust.kind = None
    assert objective.weights(1) == (0.0,)


def test_an_objective_says_what_it_is_made_of():
    def flat(drawing):
        return drawing.rendering.depth.mean()

    terms = [EdgeLength(0.5), Custom(flat, lambda iteration: 0.1, outputs="depth")]
    told = "Photometric(0.2, 'l1') + EdgeLength(0.5) + Custom(flat, <lambda>, outputs=('depth',))"
    assert repr(Objective(Photometric(0.2), terms)) == f"Objective({told}, scale=1)"
