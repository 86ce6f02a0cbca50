"""Which operations of torch a piece of code calls, and which of them would wait for a GPU."""

from typing import Any

from torch.utils._python_dispatch import TorchDispatchMode

WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "_unique2", "bincount", "equal")


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
