"""Derivatives in forward mode, which no operation has."""

from typing import Any, NoReturn


def refuse_forward_mode(ctx: Any, *tangents: Any) -> NoReturn:
    """The `jvp` of autograd functions. Raises RuntimeError, as autograd does of what it cannot differentiate."""
    raise RuntimeError(
        "etsplat has no derivatives in forward mode (torch.autograd.forward_ad): take backward(), torch.autograd.grad, "
        "or the difference of two pictures"
    )
