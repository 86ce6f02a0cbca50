"""A sky that walls hide is told from one that photos show."""

import torch

import etsplat
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import StoredPictures
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.optim.hidden_sky import HiddenSky

WALL, SKY = 5.0, 10.0


def looking(views: int) -> Dataset:
    """Views beside each other, along z."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(-0.2, 0.2, views, dtype=torch.float64)
    Ks = etsplat.intrinsics(60.0, 64, 48).double()[None].repeat(views, 1, 1)
    photos = StoredPictures(torch.zeros(views, 48, 64, 3))
    return Dataset(viewmats, Ks, photos, [str(view) for view in range(views)], train=list(range(views)), test=[])


def triangle(*corners: tuple[float, float, float], opacity: float = 0.99) -> TriangleSoup:
    color = torch.full((1, 3), 0.5)
    return TriangleSoup.from_triangles(torch.tensor([corners]), color, opacity=opacity, sigma=0.02, sh_degree=0)


def patch(x: float, z: float, opacity: float = 0.99) -> TriangleSoup:
    return triangle((x - 1, -1, z), (x + 1, -1, z), (x, 1, z), opacity=opacity)


def scene(opacity: float, *others: TriangleSoup) -> TriangleSoup:
    """A wall on the left, a patch of the sky behind it, one where there is no wall, and one behind the cameras."""
    soup = triangle((-12, -8, WALL), (0, -8, WALL), (0, 8, WALL), opacity=opacity)
    for other in (patch(-3, SKY), patch(3, SKY), patch(0, -SKY), *others):
        soup = soup.joined(other)
    return soup


def sky_of(soup: TriangleSoup, views: int = 5) -> list[bool]:
    def far(vertices: torch.Tensor) -> torch.Tensor:
        return vertices[..., 2].abs().mean(dim=1) > (WALL + SKY) / 2

    return HiddenSky(looking(views), far)(soup).tolist()


def test_what_is_behind_a_wall_is_hidden_and_what_photos_show_is_not():
    """The wall itself is no sky; what is in no photo is hidden as well."""
    assert sky_of(scene(0.99)) == [False, True, False, True]


def test_a_wall_through_which_less_than_half_of_the_light_comes_hides():
    assert sky_of(scene(0.6)) == [False, True, False, True]
    assert sky_of(scene(0.3)) == [False, False, False, True]


def test_layers_of_a_sky_are_shown_together():
    """Each has less than half of the light."""
    layers = [patch(3, SKY + 0.01 * layer, 0.3) for layer in range(4)]
    assert sky_of(scene(0.99, *layers))[4:] == [False] * 4


def test_one_photo_is_enough_to_show_a_sky():
    assert sky_of(scene(0.99), views=1) == [False, True, False, True]


def test_nothing_changes_in_the_soup():
    soup = scene(0.99)
    before = {name: tensor.clone() for name, tensor in soup.state().items()}
    sky_of(soup)
    assert all(torch.equal(tensor, before[name]) for name, tensor in soup.state().items())


def test_a_soup_without_a_sky():
    soup = scene(0.99)
    found = HiddenSky(looking(3), lambda vertices: torch.zeros(len(vertices), dtype=torch.bool))(soup)
    assert not bool(found.any())
