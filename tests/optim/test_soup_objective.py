import pytest
import torch

from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.engines.threads import num_threads, set_num_threads
from etsplat.model.soup_rendering import SoupAppearance, render_soup
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.triangle_area import mean_area
from etsplat.optim.soup_objective import SoupWeights, soup_objective
from helpers.engines import on

SIZE = 40


def view() -> Cameras:
    viewmats = look_at(torch.tensor([[0.6, 0.4, 3.0]]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
    return Cameras(viewmats, intrinsics(45, SIZE, SIZE)[None], SIZE, SIZE)


def soup(rng: torch.Generator) -> TriangleSoup:
    return TriangleSoup.from_triangles(
        0.8 * torch.randn((30, 3, 3), generator=rng),
        torch.rand((30, 3), generator=rng),
        opacity=0.6,
        sigma=0.5,
        sh_degree=0,
    )


@pytest.mark.sanitize
def test_mean_area_agrees_with_the_float64_reference(rng):
    """Value and gradient; a triangle without area has none."""
    vertices = torch.randn((5000, 3, 3), generator=rng)
    vertices[7] = vertices[7, :1]
    results = []
    for tensor in (vertices, vertices[torch.arange(5000) != 7].double()):
        leaf = tensor.clone().requires_grad_()
        (2.0 * mean_area(leaf)).backward()
        results.append((mean_area(tensor), leaf.grad))
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


def test_every_term_adds_with_its_weight(rng, engine):
    """The objective is the weighted sum of the terms, each of which can be had alone."""
    start, camera = soup(rng), view()
    rendering = on(
        engine,
        render_soup,
        start,
        camera,
        SoupAppearance(),
        depth="centroid",
        median_depth=True,
        normals=True,
        distortion=True,
    )
    target = (255 * torch.rand((1, SIZE, SIZE, 3), generator=rng)).to(torch.uint8)

    def objective(**weights: float) -> float:
        full = SoupWeights(**{"dssim": 0.2, "opacity": 0.0, "size": 0.0, "normal": 0.0, "distortion": 0.0, **weights})
        background = torch.zeros(1, 3)
        arguments = (rendering, target, None, background, start.vertices, start.opacities, camera, full)
        return float(on(engine, soup_objective, *arguments).detach())

    weights = {"opacity": 0.3, "size": 0.02, "normal": 0.5, "distortion": 2.0}
    plain = objective()
    terms = {name: objective(**{name: value}) - plain for name, value in weights.items()}
    assert all(term > 0 for term in terms.values())
    assert objective(**weights) == pytest.approx(plain + sum(terms.values()), rel=1e-5)
    assert terms["opacity"] == pytest.approx(0.3 * 0.6, rel=1e-4)
    assert terms["size"] == pytest.approx(0.02 / float(mean_area(start.vertices).detach()), rel=1e-4)
