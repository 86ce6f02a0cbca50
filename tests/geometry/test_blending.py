"""Values of places that have none, from the nearest places that have some."""

import torch

from etsplat.geometry.blending import blended


def test_values_are_means_of_the_eight_nearest_by_the_reciprocal_of_their_distance() -> None:
    """Compared with all distances in float64; a place that is known has its own value."""
    generator = torch.Generator().manual_seed(0)
    known, values = torch.rand(40, 3, generator=generator), torch.rand(40, 2, generator=generator)
    places = torch.cat([torch.rand(10, 3, generator=generator), known[:1]])
    found = blended(places, known, values)
    distance = (places[:10, None].double() - known.double()).norm(dim=2)
    nearest = distance.argsort(dim=1)[:, :8]
    weight = 1 / distance.gather(1, nearest)
    expected = (weight[..., None] * values.double()[nearest]).sum(dim=1) / weight.sum(dim=1, keepdim=True)
    torch.testing.assert_close(found[:10].double(), expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(found[10], values[0], rtol=1e-4, atol=1e-4)


def test_a_single_known_place_gives_its_value_to_all() -> None:
    value = torch.tensor([[0.2, 0.4, 0.6]])
    assert torch.allclose(blended(torch.rand(5, 3), torch.zeros(1, 3), value), value.expand(5, 3))
