import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.model.soup_files import SoupFile, load_soup, save_soup
from etsplat.model.soup_rendering import SoupAppearance
from etsplat.model.triangle_soup import TriangleSoup


@pytest.fixture
def soup(rng):
    made = TriangleSoup.from_triangles(
        torch.randn(7, 3, 3, generator=rng), torch.rand(7, 3, generator=rng), opacity=0.4, sigma=0.6, sh_degree=2
    )
    with torch.no_grad():
        made.sh_rest += torch.randn(7, 8, 3, generator=rng)
    return made


def test_a_soup_returns_bit_for_bit_with_how_it_is_drawn(tmp_path, soup):
    appearance = SoupAppearance(kernel="bilateral", cull_small=True, near_plane=0.3, sigma_ceiling=0.5)
    saved = SoupFile(soup, appearance, (1.0, 0.5, 0.0), {"iteration": "30000"})
    save_soup(tmp_path / "soup.safetensors", saved)
    loaded = load_soup(tmp_path / "soup.safetensors")
    for name, tensor in loaded.soup.parameters().items():
        assert torch.equal(tensor, getattr(soup, name).detach())
        assert not tensor.requires_grad
    assert (loaded.appearance, loaded.background, loaded.notes) == (appearance, saved.background, saved.notes)


def test_an_unlimited_softness_returns_as_unlimited(tmp_path, soup):
    save_soup(tmp_path / "soup.safetensors", SoupFile(soup))
    assert load_soup(tmp_path / "soup.safetensors").appearance == SoupAppearance()


@pytest.mark.parametrize("part", [0.0, 0.02, 0.5, 0.99])
def test_files_cut_anywhere_are_one_line_input_errors(tmp_path, soup, part):
    path = tmp_path / "soup.safetensors"
    save_soup(path, SoupFile(soup))
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * part)])
    with pytest.raises(InputError, match=r"soup\.safetensors: cannot be read") as raised:
        load_soup(path)
    assert "\n" not in str(raised.value)


def test_missing_files_and_nan_are_input_errors(tmp_path, soup):
    with pytest.raises(InputError, match="no such file"):
        load_soup(tmp_path / "absent.safetensors")
    with torch.no_grad():
        soup.sigma_raw[3] = torch.nan
    save_soup(tmp_path / "soup.safetensors", SoupFile(soup))
    with pytest.raises(InputError, match="sigma_raw holds NaN"):
        load_soup(tmp_path / "soup.safetensors")
    with pytest.raises(ValueError, match="suffix"):
        save_soup(tmp_path / "soup.bin", SoupFile(soup))
