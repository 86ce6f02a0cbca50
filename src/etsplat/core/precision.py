"""Operations compute in the precision of their arguments."""

import sys
from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar, cast

import torch

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def as_given(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The same function, for which `torch.autocast` around it is off: bfloat16 would spoil positions and depths.

    `torch.compile` calls it as it is: there is nothing to gain in native calls, and old versions end at them.
    """

    @wraps(function)
    def called(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        if not (torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")):
            return function(*arguments, **named)
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return function(*arguments, **named)

    uncompiled = cache(lambda: cast(Callable[Arguments, Result], torch.compiler.disable(called)))

    @wraps(function)
    def chosen(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        # To disable imports the compiler, which takes seconds: only where it is at work.
        return (uncompiled() if "torch._dynamo" in sys.modules else called)(*arguments, **named)

    return chosen
