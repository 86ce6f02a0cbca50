"""Operations compute in the precision of their arguments."""

from collections.abc import Callable
from contextlib import ExitStack
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def as_given(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The same function, for which `torch.autocast` around it is off: bfloat16 would spoil positions and depths."""

    @wraps(function)
    def called(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        active = [device for device in ("cpu", "cuda") if torch.is_autocast_enabled(device)]
        with ExitStack() as stack:
            for device in active:
                stack.enter_context(torch.autocast(device, enabled=False))
            return function(*arguments, **named)

    return called
