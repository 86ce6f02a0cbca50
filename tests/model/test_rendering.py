from dataclasses import replace

import pytest
import torch

import etsplat
from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.model.soup_appearance import SoupAppearance
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
    culling = replace(soup, appearance=SoupAppearance(cull_small=True))
    drawn = soup.render(camera(), outputs=("statistics",))
    culled = culling.render(camera(), outputs=("statistics",))
    assert drawn.statistics.visible[0].tolist() == [True, True]
    assert culled.statistics.visible[0].tolist() == [True, False]
    culled.color.sum().backward()
    assert float(soup.vertices.grad[1].abs().max()) == 0
    assert float(soup.vertices.grad[0].abs().max()) > 0
    pair = culling.render(camera(2), backgrounds=torch.rand(2, 3), outputs=("normal", "statistics"))
    assert pair.color.shape == (2, 48, 48, 3)
    assert pair.statistics.visible.tolist() == [[True, False]] * 2
    torch.testing.assert_close(pair.normal[:1], culling.render(camera(), outputs=("normal",)).normal)


def test_sharp_full_triangles_look_alike_soft_and_opaque():
    """At opacity 1 and the smallest sigma the splatted picture is the z-buffer's but for the edge pixels."""
    soup = soup_of(LARGE, opacity=0.999)
    soft = replace(soup, appearance=SoupAppearance(sigma_ceiling=0.011)).render(camera(2)).color.detach()
    hard = soup.render_opaque(camera(2), supersampling=1)[..., :3]
    different = ((soft - hard).abs() > 0.02).any(dim=-1).float().mean()
    assert float(different) < 0.04
    assert float((soft - hard).abs().median()) < 0.01


def test_floor_and_ceiling_bound_what_is_drawn():
    """Opacities lie above the floor, sigma below the ceiling."""
    soup = soup_of(LARGE, TINY, opacity=0.2, sigma=1.0)
    soup.appearance = SoupAppearance(opacity_floor=0.5, sigma_ceiling=0.3)
    torch.testing.assert_close(soup.drawn_opacities, torch.full((2,), 0.6))
    torch.testing.assert_close(soup.drawn_sigma, torch.full((2,), 0.3))
    finished = soup.finished()
    torch.testing.assert_close(finished.opacities, torch.full((2,), 0.6))
    torch.testing.assert_close(finished.sigma, torch.full((2,), 0.3))


def test_faint_triangles_are_not_drawn_opaque():
    """Below opacity one half a triangle is left out of the picture and of the surface."""
    soup = soup_of(LARGE, opacity=0.3)
    assert soup.render_opaque(camera())[0, 24, 24].tolist() == [0, 0, 0, 0]
    assert len(soup.surface()[1]) == 0
    assert soup_of(LARGE).surface()[0].shape == (3, 3)


def models_of(dtype: torch.dtype) -> list:
    """One of each kind."""
    vertices, faces = etsplat.icosphere(1)
    vertices = vertices.to(dtype)
    look = {"opacity": 0.9, "sigma": 0.3}
    return [
        TriangleSoup.from_triangles(vertices[faces], torch.rand(80, 3), sh_degree=1, **look),
        etsplat.TriangleMesh.from_mesh(vertices, faces, colors=0.5, **look),
        etsplat.TriangleMesh.from_mesh(vertices, faces, colors=0.5, opacity=None, sigma=None),
        etsplat.TexturedMesh.from_mesh(vertices, faces, torch.rand(8, 8, 3, dtype=dtype), vertices[faces][..., :2]),
    ]


@pytest.mark.parametrize(("own", "given"), [(torch.float32, torch.float64), (torch.float64, torch.float32)])
def test_cameras_of_another_precision_than_a_model_are_named(own: torch.dtype, given: torch.dtype) -> None:
    for model in models_of(own):
        message = rf"cameras must be {own} like \w+\.vertices, got {given}: pass cameras\.to\("
        with pytest.raises(ValueError, match=message):
            model.render(camera().to(dtype=given))
        with pytest.raises(ValueError, match="cameras must be Cameras, got Tensor: make them by"):
            model.render(torch.eye(4))
        model.render(camera().to(dtype=own))
        if not isinstance(model, etsplat.TexturedMesh):
            with pytest.raises(ValueError, match=message):
                model.render_opaque(camera().to(dtype=given))
