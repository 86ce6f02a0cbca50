"""What a piece of code calls of torch: to count it, or to do it again as a CUDA graph would."""

from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from etsplat import _native

WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "_unique2", "bincount", "equal")


_MAKING = ("empty_floats", "zero_floats", "copied_indices")
_VIEWS = ("view", "_unsafe_view", "slice", "select", "expand", "unsqueeze", "squeeze", "permute", "transpose", "t")
_VIEWS += ("detach", "as_strided", "alias", "split", "split_with_sizes", "unbind", "diagonal")


class Calls(TorchDispatchMode):
    """Remembers the names of what is called within."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.names.append(str(func))
        return func(*args, **(kwargs or {}))

    def waiting(self) -> int:
        """How many calls read something back."""
        return sum(name.split(".")[1] in WAITING for name in self.names)

    def kernels(self) -> int:
        """How many calls launch something: not those that give a view, allocate, or read back."""
        names = (name.split(".")[1] for name in self.names)
        return sum(not (name in (*WAITING, *_VIEWS) or "empty" in name) for name in names)


class Recording(TorchDispatchMode):
    """Operations of torch within, to be done again on the memory that they had; whoever launches kernels adds these.

    As in a CUDA graph numbers of the host are those of the recording, and reading something back is an error.
    """

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[Callable[[], None]] = []
        self.native: list[Tensor] = []
        making = {name: self._keeping(getattr(_native, name)) for name in _MAKING}
        self.patched = patch.multiple(_native, **making)

    def __enter__(self) -> Any:
        self.patched.start()
        return super().__enter__()

    def __exit__(self, *raised: Any) -> None:
        self.patched.stop()
        super().__exit__(*raised)

    def _keeping(self, make: Callable[..., Tensor]) -> Callable[..., Tensor]:
        """Of what native code allocates for the CPU, which stands for a device here, torch tells nothing."""

        def made(**named: Any) -> Tensor:
            self.native.append(make(**named))
            return self.native[-1]

        return made

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, kwargs = str(func).split(".")[1], kwargs or {}
        if name in WAITING:
            raise RuntimeError(f"{name} waits for the device, which a graph cannot")
        result = func(*args, **kwargs)

        def again() -> None:
            for old, new in zip(tree_leaves(result), tree_leaves(func(*args, **kwargs)), strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)

        def keep(_: Any = result) -> None:
            """Memory that was allocated is what kernels write to."""

        self.steps.append(keep if "empty" in name else again)
        return result

    @torch.no_grad()
    def replay(self) -> None:
        """All of it in order."""
        for step in self.steps:
            step()
