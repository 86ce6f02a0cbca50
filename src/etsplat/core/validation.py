"""Checks of tensor arguments; every failure is a ValueError that names the argument, what it got and what it wants."""

import math
import operator
from collections.abc import Mapping, Sequence
from numbers import Real

import numpy as np
import torch
from torch import Tensor

from etsplat import _native

Shape = tuple[str | int, ...]

_ROUNDED = 1e-3
"""In the last row of a world-to-camera matrix, at most, beside its 1: products of matrices leave less."""


def check_shape(name: str, tensor: Tensor, *shapes: Shape, sizes: dict[str, int] | None = None) -> None:
    """Match ``tensor`` to one of ``shapes`` and remember the sizes of the letters in it.

    Args:
        name: The argument, for the message.
        tensor: What was given.
        shapes: Acceptable shapes; a letter stands for a size.
        sizes: Letters with known sizes, shared by the checks of several arguments; letters first met here are added.

    Raises:
        ValueError: It is no tensor, has no memory of its own or is within a transform of torch.func, or no shape
            matches.
    """
    sizes = {} if sizes is None else sizes
    if not isinstance(tensor, Tensor):
        full = isinstance(tensor, Real) and () not in shapes
        remedy = f": pass torch.full(shape, {tensor})" if full else _remedy(name, tensor)
        got = f"{type(tensor).__name__}{remedy}"
        raise ValueError(f"{name} must be a tensor of shape {_written(shapes)}, got {got}")
    check_native(name, tensor)
    for shape in shapes:
        if len(shape) != tensor.ndim:
            continue
        found = dict(sizes)
        for letter, size in zip(shape, tensor.shape, strict=True):
            if size != (found.setdefault(letter, size) if isinstance(letter, str) else letter):
                break
        else:
            sizes.update(found)
            return
    letters = {s for shape in shapes for s in shape if isinstance(s, str) and s in sizes}
    known = ", ".join(f"{letter}={sizes[letter]}" for letter in sorted(letters))
    wanted = _written(shapes) + (" with " + known if known else "")
    raise ValueError(f"{name} must have shape {wanted}, got {tuple(tensor.shape)}")


def _written(shapes: Sequence[Shape]) -> str:
    """As Python writes them."""
    return " or ".join("(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")" for shape in shapes)


def dense(tensor: Tensor, name: str = "gradient") -> Tensor:
    """The tensor as native code reads it: detached, contiguous, its values in memory as they are.

    Views such as ``torch.view_as_real(z.conj())[..., 1]`` carry a sign that memory does not show.

    Raises:
        ValueError: It has no memory, or is within a transform of torch.func; the message says ``name``.
    """
    check_native(name, tensor)
    return tensor.detach().resolve_conj().resolve_neg().contiguous()


def check_memory(name: str, tensor: Tensor) -> None:
    """Raise ValueError unless it is a tensor of numbers each of which has its place in memory.

    Functions that are made of torch's own ask for it too: on a freed storage those end the process.
    """
    if not isinstance(tensor, Tensor):
        raise ValueError(f"{name} must be a tensor, got {type(tensor).__name__}{_remedy(name, tensor)}")
    if tensor.layout != torch.strided or tensor.is_nested:
        kind = "a nested one" if tensor.is_nested else f"layout {tensor.layout}"
        raise ValueError(f"{name} must be a dense tensor, got {kind}")
    if tensor.is_quantized or tensor.is_complex():
        raise ValueError(f"{name} must be a tensor of plain numbers, got {tensor.dtype}")
    if _address(tensor) == 0:  # few have none, and steps check dozens
        if _is_transformed(tensor):  # torch sees through
            return
        if tensor.is_meta:
            raise ValueError(f"{name} must be in memory, got a tensor on {tensor.device}")
        if tensor._is_zerotensor():
            raise ValueError(f"{name} must have memory of its own, got a ZeroTensor: pass {name}.clone()")
        if tensor.numel() == 0:
            return
    if tensor.is_contiguous():  # as most are
        spanned = tensor.numel()
    else:
        spanned = 1 + sum((n - 1) * step for n, step in zip(tensor.shape, tensor.stride(), strict=True))
    storage = tensor.untyped_storage()
    if storage.device.type == "meta":  # of FakeTensorMode; behind an offset it has an address
        raise ValueError(f"{name} must be in memory, got a {type(tensor).__name__}: torch.export cannot trace this")
    needed, held = (tensor.storage_offset() + spanned) * tensor.element_size(), storage.nbytes()
    if held < needed:
        raise ValueError(f"{name} must have memory of its own: it needs {needed} bytes, and its storage holds {held}")


def check_native(name: str, tensor: Tensor) -> None:
    """`check_memory`, and ValueError within a transform of torch.func."""
    if isinstance(tensor, Tensor) and _address(tensor) == 0 and _is_batched(tensor):
        raise ValueError(
            f"{name} must be a plain tensor, got a batch of them, which no engine supports: take one gradient at a "
            "time, without is_grads_batched or vectorize"
        )
    if isinstance(tensor, Tensor) and _address(tensor) == 0 and _is_transformed(tensor):
        raise ValueError(
            f"{name} must be a plain tensor, got one within a transform of torch.func, which no engine supports: "
            "take torch.autograd.grad for gradients, and several cameras in one call in the place of vmap"
        )
    check_memory(name, tensor)


def _address(tensor: Tensor) -> int:
    """Where its first number lies; 0 if it has no numbers, or no memory of its own."""
    try:
        return tensor.data_ptr()
    except RuntimeError:  # sparse, and within a transform
        return 0


def _is_transformed(tensor: Tensor) -> bool:
    return torch._C._functorch.is_functorch_wrapped_tensor(tensor)  # pyright: ignore[reportAttributeAccessIssue]


def _is_batched(tensor: Tensor) -> bool:
    """By the vmap that autograd has of its own."""
    return torch._C._functorch.is_legacy_batchedtensor(tensor)  # pyright: ignore[reportAttributeAccessIssue]


def _remedy(name: str, value: object) -> str:
    """How to make a tensor of it, for the end of a message."""
    if isinstance(value, np.ndarray):
        return f": pass torch.from_numpy({name})"
    return f": pass torch.tensor({name})" if isinstance(value, list | tuple | float | int | np.generic) else ""


def check_like(name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """Raise ValueError unless ``tensor`` has the dtype and device of ``other``."""
    if tensor.dtype != other.dtype:
        raise ValueError(f"{name} must be {other.dtype} like {other_name}, got {tensor.dtype}")
    check_device(name, tensor, other_name, other)


def check_device(name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """Raise ValueError unless ``tensor`` is on the device of ``other``."""
    if tensor.device != other.device:
        raise ValueError(f"{name} must be on {other.device} like {other_name}, got {tensor.device}")


def check_place(device: object) -> None:
    """Raise ValueError for a dtype in the place of a device, as tensors take it."""
    if isinstance(device, torch.dtype):
        raise ValueError(f"device must be a device, got {device}: pass dtype={device}")


def check_integers(name: str, indices: Tensor) -> None:
    """Raise ValueError unless ``indices`` are int32 or int64, whatever their values."""
    if indices.dtype not in (torch.int32, torch.int64):
        raise ValueError(f"{name} must be int32 or int64, got {indices.dtype}")


def check_indices(name: str, indices: Tensor, count: int) -> None:
    """Raise ValueError unless ``indices`` are int32 or int64, from 0 to ``count`` - 1."""
    check_integers(name, indices)
    if indices.numel() == 0 or (_is_plain(indices) and _native.indices_below(values=indices, bound=count)):
        return
    low, high = (int(value) for value in torch.aminmax(indices))
    if low < 0 or high >= count:
        raise ValueError(f"{name} must be indices from 0 to {count - 1}, got indices from {low} to {high}")


def check_finite(name: str, tensor: Tensor, largest: float = math.inf) -> None:
    """Raise ValueError if ``tensor`` holds NaN, infinity or magnitudes above ``largest``; the message says how many."""
    if not (unusable := _count_unusable(tensor, largest)):
        return
    if bad := _count_unusable(tensor, math.inf):
        raise ValueError(f"{name} must be finite, got {bad} NaN or infinite values")
    raise ValueError(f"{name} must be from {-largest:g} to {largest:g}, got {unusable} values beyond")


def first_not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """The name of the first tensor that holds NaN or infinity, or None."""
    return next((name for name, tensor in tensors.items() if _count_unusable(tensor, math.inf)), None)


def _count_unusable(tensor: Tensor, largest: float) -> int:
    """How many values are NaN, infinite, or larger in magnitude."""
    if _is_plain(tensor) and tensor.dtype == torch.float32:
        return _native.scan_floats(values=tensor, largest=largest).unusable
    return int((~(tensor.isfinite() & (tensor.abs() <= largest))).sum())


def check_positive(name: str, tensor: Tensor) -> None:
    """Raise ValueError if a value of ``tensor``, which is finite, is 0 or less."""
    if tensor.numel() == 0:
        return
    if _is_plain(tensor) and tensor.dtype == torch.float32:
        lowest = _native.scan_floats(values=tensor, largest=math.inf).minimum
    else:
        lowest = float(tensor.detach().min())
    if not lowest > 0:
        raise ValueError(f"{name} must be positive, got {lowest}")


def _is_plain(tensor: Tensor) -> bool:
    """Whether native code can read it where it lies."""
    return tensor.device.type == "cpu" and tensor.is_contiguous() and not tensor.is_neg()


def check_intrinsics(name: str, Ks: Tensor) -> None:
    """Raise ValueError unless every matrix of ``Ks`` (B, 3, 3) is a pinhole camera without skew."""
    if _is_plain(Ks) and Ks.dtype == torch.float32:
        pinholes = _native.are_intrinsics(Ks=Ks)
    else:
        pinholes = all((k[0][1], k[1][0], *k[2]) == (0, 0, 0, 0, 1) for k in Ks.tolist())
    if not pinholes:
        raise ValueError(f"{name} must have the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported")


def check_last_rows(name: str, viewmats: Tensor) -> None:
    """Raise ValueError where the last row of one of ``viewmats`` (B, 4, 4) moves anything, as of transposed ones."""
    for row in viewmats[:, 3, :3].tolist():
        if any(abs(value) > _ROUNDED for value in row):  # what is not finite is looked at elsewhere
            shown = ", ".join(f"{value:g}" for value in row)
            raise ValueError(
                f"{name} must have the last row [0, 0, 0, 1], got one that begins with {shown}: if they are transposed,"
                f" as for row vectors, pass {name}.mT"
            )


def check_flags(**values: object) -> None:
    """Raise ValueError unless every value, named by its argument, is True or False."""
    for name, value in values.items():
        if not isinstance(value, bool):
            raise ValueError(f"{name} must be True or False, got {value!r}")


def check_count(name: str, value: object, *, least: int = 1, most: float = math.inf) -> int:
    """``value`` as an int; ValueError unless it is a `whole_number` from ``least`` to ``most``."""
    if type(value) is int and least <= value <= most:  # as nearly always
        return value
    count = whole_number(value)
    if count is None or not least <= count <= most:
        bounds = f"of at least {least}" if most == math.inf else f"from {least} to {most}"
        raise ValueError(f"{name} must be an integer {bounds}, got {value!r}")
    return count


def whole_number(value: object) -> int | None:
    """An integer of Python or numpy, or a tensor or array () of one, as an int; None for booleans and all else."""
    if isinstance(value, Tensor | np.ndarray) and (value.ndim or value.dtype in (torch.bool, np.bool_)):
        return None
    try:
        return None if isinstance(value, bool | np.bool_) else operator.index(value)  # pyright: ignore[reportArgumentType]
    except TypeError:
        return None


def check_number(name: str, value: object, low: float = -math.inf, high: float = math.inf) -> None:
    """Raise ValueError unless ``value`` is a number, no bool, from ``low`` to ``high`` if these are given."""
    if type(value) is float and low <= value <= high:  # as nearly always
        return
    number = isinstance(value, Real) or (isinstance(value, Tensor | np.ndarray) and value.ndim == 0)
    if isinstance(value, bool) or not number:
        raise ValueError(f"{name} must be a number, got {shown(value)}")
    if (low > -math.inf or high < math.inf) and not low <= float(value) <= high:  # pyright: ignore[reportArgumentType]
        bounds = f"from {low:g} to {high:g}" if high < math.inf else f"at least {low:g}"
        raise ValueError(f"{name} must be {bounds}, got {value}")


def check_above(name: str, value: object, least: float = 0.0) -> None:
    """Raise ValueError unless ``value`` is a finite number above ``least``."""
    check_number(name, value)
    if not least < float(value) < math.inf:  # pyright: ignore[reportArgumentType]
        bound = "positive" if least == 0 else f"above {least:g}"
        raise ValueError(f"{name} must be {bound} and finite, got {value}")


def check_kind(name: str, value: object, kind: type, remedy: str = "") -> None:
    """Raise ValueError unless ``value`` is a ``kind``; ``remedy`` says how to make one, for the end of the message."""
    if not isinstance(value, kind):
        article = "" if kind.__name__.endswith("s") else "an " if kind.__name__[0] in "AEIOU" else "a "
        raise ValueError(f"{name} must be {article}{kind.__name__}, got {shown(value)}{remedy and ': ' + remedy}")


def shown(value: object) -> str:
    """What was given, for the end of a message: small values as Python writes them, and of others their kind."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, Tensor):
        return f"a tensor of shape {tuple(value.shape)}"
    small = value is None or isinstance(value, str | bool | int | float)
    return repr(value) if small else type(value).__name__


def check_floating(name: str, tensor: Tensor) -> None:
    """Raise ValueError unless ``tensor``, which is one, is of floating-point numbers."""
    if not tensor.is_floating_point():
        raise ValueError(f"{name} must be of floating-point numbers, got {tensor.dtype}")


def check_open_unit(name: str, value: float) -> None:
    """Raise ValueError unless ``value`` is a number between 0 and 1, as what passes through a sigmoid."""
    check_number(name, value)
    if not 0 < value < 1:
        raise ValueError(f"{name} must be above 0 and below 1, got {value:g}")


def check_written(name: str, tensor: Tensor) -> None:
    """`check_memory`, and ValueError where several elements share one place, of which only one could be kept."""
    check_memory(name, tensor)
    if any(size > 1 and step == 0 for size, step in zip(tensor.shape, tensor.stride(), strict=True)):
        raise ValueError(f"{name} must have a place for each element, got an expanded tensor: pass {name}.clone()")


def check_choice(name: str, value: object, choices: Sequence[object]) -> None:
    """Raise ValueError unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")


def check_channels_last(name: str, image: Tensor) -> None:
    """Raise ValueError where an (H, W, C) image has its channels first."""
    if image.shape[0] in (1, 3, 4) and image.shape[-1] > 4:
        got = tuple(image.shape)
        raise ValueError(f"{name}: expected shape (H, W, C), got {got}: pass {name}.permute(1, 2, 0)")
