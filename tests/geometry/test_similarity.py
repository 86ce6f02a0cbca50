"""Turning, scaling and moving in one."""

import torch

from etsplat.geometry.similarity import Similarity, rotation_between


def example() -> Similarity:
    start, end = (torch.tensor(xyz, dtype=torch.float64) for xyz in ([0.6, 0.0, 0.8], [0.0, 1.0, 0.0]))
    return Similarity(rotation_between(start, end), 2.5, torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64))


def test_points_come_back_and_the_matrix_does_the_same(rng: torch.Generator) -> None:
    """To rounding in float64; and so does what is made of the matrix alone."""
    points = torch.randn(4, 3, 3, generator=rng, dtype=torch.float64)
    similarity = example()
    moved = similarity.apply(points)
    torch.testing.assert_close(similarity.invert(moved), points, rtol=0, atol=1e-12)
    columns = torch.cat([points, torch.ones(4, 3, 1, dtype=torch.float64)], dim=2)
    torch.testing.assert_close((columns @ similarity.matrix.T)[..., :3], moved, rtol=0, atol=1e-12)
    again = Similarity.of_matrix(similarity.matrix)
    torch.testing.assert_close(again.invert(moved), points, rtol=0, atol=1e-12)


def test_lengths_are_multiplied_by_the_scale_and_nothing_is_mirrored(rng: torch.Generator) -> None:
    points = torch.randn(2, 3, generator=rng, dtype=torch.float64)
    moved = example().apply(points)
    torch.testing.assert_close((moved[1] - moved[0]).norm(), 2.5 * (points[1] - points[0]).norm())
    assert float(torch.linalg.det(example().rotation)) > 0.999


def test_without_anything_set_not_a_bit_changes(rng: torch.Generator) -> None:
    """What is exported as it is keeps its float32."""
    points = torch.randn(50, 3, generator=rng)
    assert torch.equal(Similarity().apply(points).float(), points)


def test_an_offset_is_in_units_of_the_result() -> None:
    offset = torch.tensor([0.0, 10.0, 0.0])
    origin = torch.zeros(1, 3)
    torch.testing.assert_close(example().moved(offset).apply(origin), example().apply(origin) + offset.double())


def test_the_smallest_rotation_takes_one_direction_to_another(rng: torch.Generator) -> None:
    """Opposite directions too, by half a turn."""
    directions = torch.nn.functional.normalize(torch.randn(6, 3, generator=rng, dtype=torch.float64), dim=1)
    ends = torch.cat([directions[3:], -directions[:3]])
    for start, end in zip(torch.cat([directions[:3], directions[:3]]), ends, strict=True):
        rotation = rotation_between(start, end)
        torch.testing.assert_close(rotation @ start, end, rtol=0, atol=1e-12)
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
        assert float(torch.linalg.det(rotation)) > 0.999
