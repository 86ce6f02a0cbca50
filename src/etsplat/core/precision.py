"""Operations compute in the precision of their arguments; runs in 32 bits, whatever torch's defaults are."""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

import torch

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

_UNCOMPILED = "etsplat runs native code here, which torch.compile cannot trace: leave fullgraph=False"


def as_given(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The same function, for which `torch.autocast` around it is off: bfloat16 would spoil positions and depths.

    What autocast has made half as precise before, such as colours of a network, is float32 again, as for all of
    torch's own operations that want that. `torch.compile` calls it as it is: there is nothing to gain in native calls,
    and old versions end at them.
    """

    @wraps(function)
    def called(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        if not (torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")):
            return function(*arguments, **named)
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            whole = {name: _whole(argument) for name, argument in named.items()}
            return cast(Any, function)(*map(_whole, arguments), **whole)

    uncompiled: list[Callable[Arguments, Result]] = []

    @wraps(function)
    def chosen(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        # To disable imports the compiler, which takes seconds: only where it is at work.
        if "torch._dynamo" not in sys.modules:
            return called(*arguments, **named)
        if not uncompiled:
            uncompiled.append(cast(Callable[Arguments, Result], torch.compiler.disable(called)))
        return uncompiled[0](*arguments, **named)

    for name, value in (("_torchdynamo_disable", True), ("_torchdynamo_disable_msg", _UNCOMPILED)):
        setattr(chosen, name, value)  # what the compiler says where it may not leave its graph
    return chosen


def _whole(argument: object) -> object:
    halved = isinstance(argument, torch.Tensor) and argument.dtype in (torch.float16, torch.bfloat16)
    return cast(torch.Tensor, argument).float() if halved else argument


@contextmanager
def usual_defaults() -> Iterator[None]:
    """Within the block what torch makes is float32 and on the CPU unless it is told otherwise, and gradients are on.

    As it is where nobody has called `torch.set_default_dtype` or `torch.set_default_device`, by whose choice random
    numbers, backgrounds and the like would be of another kind than photos and models; and outside of `torch.no_grad`
    and `torch.inference_mode`, in which nothing is learned, nor later by what the second has made.
    """
    given = torch.get_default_dtype()
    with ExitStack() as stack:
        if torch.is_inference_mode_enabled():
            stack.enter_context(torch.inference_mode(mode=False))
        if not torch.is_grad_enabled():
            stack.enter_context(torch.enable_grad())
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        if given != torch.float32:
            stack.callback(torch.set_default_dtype, given)
            torch.set_default_dtype(torch.float32)
        yield
