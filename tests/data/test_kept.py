"""What is kept while a start is made."""

import torch

from etsplat.data.kept import keeping, kept

calls = []


@kept
def doubled(numbers: torch.Tensor, by: int = 2) -> torch.Tensor:
    calls.append(by)
    return numbers * by


def test_nothing_is_kept_but_while_keeping() -> None:
    calls.clear()
    numbers, others = torch.ones(3), torch.zeros(3)
    assert doubled(numbers) is not doubled(numbers)
    with keeping():
        first = doubled(numbers)
        assert doubled(numbers) is first
        assert doubled(others) is not first
        assert doubled(numbers, 3) is not first
        with keeping():
            assert doubled(numbers) is not first
        assert doubled(numbers) is first
    assert doubled(numbers) is not first
    assert calls == [2, 2, 2, 2, 3, 2, 2]
