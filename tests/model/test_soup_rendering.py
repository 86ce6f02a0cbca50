import pytest
import torch

from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.model.soup_rendering import SoupAppearance, render_soup, render_soup_opaque
from etsplat.model.triangle_soup import TriangleSoup


def camera(views: int = 1, size: int = 48) -> Cameras:
    eyes = torch.tensor([[0.0, 0, 3], [0.5, 0.2, 3]])[:views]
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1, 0]))
    return Cameras(viewmats, intrinsics(40, size, size).expand(views, 3, 3), size, size)


def soup_of(*triangles, opacity: float = 0.9, sigma: float = 0.02) -> TriangleSoup:
    colors = torch.tensor([[0.8, 0.3, 0.1], [0.1, 0.4, 0.9]])[: len(triangles)]
    return TriangleSoup.from_triangles(torch.tensor(triangles), colors, opacity=opacity, sigma=sigma, sh_degree=1)


LARGE = [[-1.0, -0.8, 0], [1.0, -0.8, 0], [0.0, 1.0, 0]]
TINY = [[-0.01, -0.01, 0.1], [0.01, -0.01, 0.1], [0.0, 0.01, 0.1]]


def test_small_triangles_are_left_out_only_on_request():
    """Whose inradius is below a pixel is culled by the switch, in the picture and in the gradient."""
    soup = soup_of(LARGE, TINY, sigma=0.5)
    drawn = render_soup(soup, camera(), SoupAppearance(), statistics=True)
    culled = render_soup(soup, camera(), SoupAppearance(cull_small=True), statistics=True)
    assert drawn.statistics.visible[0].tolist() == [True, True]
    assert culled.statistics.visible[0].tolist() == [True, False]
    culled.color.sum().backward()
    assert float(soup.vertices.grad[1].abs().max()) == 0
    assert float(soup.vertices.grad[0].abs().max()) > 0
    with pytest.raises(ValueError, match="camera must be one"):
        render_soup(soup, camera(2), SoupAppearance(cull_small=True))


def test_sharp_full_triangles_look_alike_soft_and_opaque():
    """At opacity 1 and the smallest sigma the splatted picture is the z-buffer's but for the edge pixels."""
    soup = soup_of(LARGE, opacity=0.999)
    soft = render_soup(soup, camera(2), SoupAppearance(sigma_ceiling=0.011)).color.detach()
    hard = render_soup_opaque(soup, camera(2), SoupAppearance(), supersampling=1)
    different = ((soft - hard).abs() > 0.02).any(dim=-1).float().mean()
    assert float(different) < 0.04
    assert float((soft - hard).abs().median()) < 0.01


def test_floor_and_ceiling_bound_what_is_drawn():
    """Opacities lie above the floor, sigma below the ceiling."""
    soup = soup_of(LARGE, TINY, opacity=0.2, sigma=1.0)
    appearance = SoupAppearance(opacity_floor=0.5, sigma_ceiling=0.3)
    torch.testing.assert_close(appearance.opacities(soup), torch.full((2,), 0.6))
    torch.testing.assert_close(appearance.sigma(soup), torch.full((2,), 0.3))


def test_faint_triangles_are_not_drawn_opaque():
    """Below opacity one half a triangle is left out, and the background shows."""
    picture = render_soup_opaque(
        soup_of(LARGE, opacity=0.3), camera(), SoupAppearance(), background=torch.tensor([0.1, 0.2, 0.3])
    )
    torch.testing.assert_close(picture[0, 24, 24], torch.tensor([0.1, 0.2, 0.3]))
