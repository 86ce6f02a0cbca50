import json
from dataclasses import replace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import etsplat
from etsplat.core.errors import InputError
from etsplat.model.soup_appearance import SoupAppearance
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
    appearance = SoupAppearance("bilateral", cull_small=True, near_plane=0.3, background=(1, 0.5, 0), sigma_ceiling=0.5)
    saved = replace(soup, appearance=appearance, notes={"iteration": "30000"})
    saved.save(tmp_path / "soup.safetensors")
    loaded = TriangleSoup.load(tmp_path / "soup.safetensors")
    for name, tensor in loaded.parameters().items():
        assert torch.equal(tensor, getattr(soup, name).detach())
        assert not tensor.requires_grad
    assert (loaded.appearance, loaded.notes) == (appearance, saved.notes)


def test_an_unlimited_softness_returns_as_unlimited(tmp_path, soup):
    soup.save(tmp_path / "soup.safetensors")
    assert TriangleSoup.load(tmp_path / "soup.safetensors").appearance == SoupAppearance()


@pytest.mark.parametrize("part", [0.0, 0.02, 0.5, 0.99])
def test_files_cut_anywhere_are_one_line_input_errors(tmp_path, soup, part):
    path = tmp_path / "soup.safetensors"
    soup.save(path)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * part)])
    with pytest.raises(InputError, match=r"soup\.safetensors: cannot be read") as raised:
        TriangleSoup.load(path)
    assert "\n" not in str(raised.value)


def test_missing_files_and_nan_are_input_errors(tmp_path, soup):
    with pytest.raises(InputError, match="no such file"):
        TriangleSoup.load(tmp_path / "absent.safetensors")
    with pytest.raises(ValueError, match="suffix"):
        soup.save(tmp_path / "soup.bin")
    path = tmp_path / "soup.safetensors"
    soup.save(path)
    with safe_open(path, "pt") as opened:
        metadata = opened.metadata()
    with torch.no_grad():
        soup.sigma_raw[3] = torch.nan
    with pytest.raises(ValueError, match="sigma_raw holds NaN"):
        soup.save(path)
    with pytest.raises(InputError, match="source: sigma_raw of the soup holds NaN"):
        etsplat.export(soup, tmp_path / "soup.ply")
    save_file(soup.state(), path, metadata=metadata)
    with pytest.raises(InputError, match="sigma_raw holds NaN"):
        TriangleSoup.load(path)
    with pytest.raises(InputError, match=r"is a folder; of a run take soup\.safetensors in it"):
        etsplat.load_soup(tmp_path)


@pytest.mark.parametrize("kernel", ["nope", 5])
def test_a_kernel_that_is_not_known_is_an_input_error(tmp_path, soup, kernel):
    path = tmp_path / "soup.safetensors"
    soup.save(path)
    with safe_open(path, "pt") as opened:
        metadata = dict(opened.metadata())
    metadata["appearance"] = json.dumps({**json.loads(metadata["appearance"]), "kernel": kernel})
    save_file(load_file(path), path, metadata=metadata)
    with pytest.raises(InputError, match=r"soup\.safetensors.*kernel"):
        TriangleSoup.load(path)


@pytest.mark.parametrize("kind", ["ply", "etz", "glb"])
def test_files_of_other_kinds_are_read_by_their_reader(tmp_path, kind):
    """`load` said that a header was too large."""
    path = tmp_path / f"soup.{kind}"
    triangles = TriangleSoup.from_triangles(torch.rand(9, 3, 3), 0.5, opacity=0.9, sigma=0.5, sh_degree=0)
    etsplat.export(triangles, path)
    with pytest.raises(InputError, match=r"is no \.safetensors; etsplat\.load_soup reads other kinds of files"):
        TriangleSoup.load(path)
    assert len(etsplat.load_soup(path)) == 9
