"""What holds tensors, in a line: a notebook that shows a mesh is not to print all of its vertices."""

from dataclasses import fields
from typing import Any

from torch import Tensor


def short_repr(self: Any) -> str:  # by the name that a method has it by
    """For the ``__repr__`` of a dataclass: tensors by their shapes, with their dtype where that is not float32."""
    shown = ", ".join(f"{field.name}={_short(getattr(self, field.name))}" for field in fields(self))
    return f"{type(self).__name__}({shown})"


def _short(value: Any) -> str:
    if isinstance(value, Tensor):
        dtype, device = str(value.dtype).removeprefix("torch."), value.device.type
        about = [word for word, usual in ((dtype, "float32"), (device, "cpu")) if word != usual]
        return " ".join([f"<{'x'.join(map(str, value.shape)) or 'scalar'}", *about]) + ">"
    if isinstance(value, list) and len(value) > 6:
        return f"[{value[0]!r}, ... {len(value)} in all]"
    return repr(value)
