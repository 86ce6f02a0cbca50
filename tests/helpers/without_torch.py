"""Draws pictures and their gradients by each path of the native module, without torch, which is slow under emulators.

    python3 tests/helpers/without_torch.py [FOLDER]      the module of an unpacked wheel, not the installed one

It prints SHA-256 of what the plain path gives, and by how much other paths differ from it. Where tensors are asked for,
it gives what the module looks at, over memory of its own.
"""

import ctypes
import hashlib
import math
import platform
import random
import sys
import types
from typing import Any

N, B, H, W = 300, 2, 72, 96
CENTRES, SIZES, SOFTNESS = (-1.0, 1.0), (-0.3, 0.3), (0.05, 1.2)


class Tensor:
    """(shape) float32, of zeros where there are no values."""

    is_cpu, device = True, "cpu"

    def __init__(self, *shape: int, values: "list[float] | None" = None) -> None:
        self.shape, self.dtype = shape, sys.modules["torch"].float32
        self.memory = (ctypes.c_float * math.prod(shape))(*(values or []))

    def is_contiguous(self) -> bool:
        return True

    def data_ptr(self) -> int:
        return ctypes.addressof(self.memory)


def stand_in() -> types.ModuleType:
    """What the module wants of torch when it is loaded."""
    torch: Any = types.ModuleType("torch")
    for name in ("float32", "float64", "int32", "int64", "uint8", "bool"):
        setattr(torch, name, object())
    torch.Tensor, torch.from_dlpack = Tensor, None  # memory of the module is not asked for
    return torch


def scene() -> dict[str, Tensor]:
    """N triangles before two cameras."""
    draw = random.Random(3)

    def some(count: int, low: float, high: float) -> list[float]:
        return [draw.uniform(low, high) for _ in range(count)]

    centres = [some(3, *CENTRES) for _ in range(N)]
    corners = [x + draw.uniform(*SIZES) for centre in centres for _ in range(3) for x in centre]
    front = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1]
    side = [0.6, 0, 0.8, 0, 0, 1, 0, 0, -0.8, 0, 0.6, 4, 0, 0, 0, 1]
    return {
        "vertices": Tensor(N, 3, 3, values=corners),
        "flat_colors": Tensor(N, 3, values=some(3 * N, 0, 1)),
        "opacities": Tensor(N, values=some(N, 0.2, 0.99)),
        "sigmas": Tensor(N, values=some(N, *SOFTNESS)),
        "viewmats": Tensor(B, 4, 4, values=front + side),
        "Ks": Tensor(B, 3, 3, values=[W, 0, W / 2, 0, W, H / 2, 0, 0, 1] * B),
    }


def results(native: Any, path: str) -> dict[str, Tensor]:
    """Pictures by the elastic kernel, and the gradients of a sum of them."""
    native.set_instruction_set(path)
    given, color, alpha = scene(), Tensor(B, H, W, 3), Tensor(B, H, W, 1)
    nothing = dict.fromkeys(
        ("faces", "corner_colors", "backgrounds", "kernel_table", "distortion", "distortion_totals")
    )
    cutoffs = {"alpha_min": 1 / 255, "alpha_max": 0.99, "x_max": 2.0, "transmittance_min": 1e-4, "near_plane": 0.01}
    ways = {"distance": 0, "freeze_inradius": False, "centroid_depth": False}
    ways |= {"distortion_near": 0.2, "distortion_far": 100.0, "kernel": native.kernel_names().index("Elastic")}
    batch = native.RasterBatch(**given, **nothing, **cutoffs, **ways, color=color, alpha=alpha)
    unused = dict.fromkeys(("median_triangle", "max_weight", "screen_size", "inradius", "visible"))
    states = native.raster_forward(batch=batch, keep_for_backward=True, **unused)
    gradients = {name: Tensor(*tensor.shape) for name, tensor in given.items()}
    weights = Tensor(B, H, W, 3, values=[(i % 7) / 3 - 1 for i in range(B * H * W * 3)])
    left = dict.fromkeys(("grad_alpha", "grad_distortion", "corner_colors", "backgrounds"))
    wanted = native.RasterGradients(grad_color=weights, **left, **gradients)
    native.raster_backward(states=states, batch=batch, gradients=wanted)
    return {"color": color, "alpha": alpha, **gradients}


def main() -> None:
    """Prints a line for each path."""
    sys.modules["torch"] = stand_in()
    sys.path[:0] = sys.argv[1:]
    from etsplat import _native

    plain = results(_native, "plain")
    digest = hashlib.sha256(b"".join(bytes(tensor.memory) for tensor in plain.values())).hexdigest()
    print(f"{platform.machine()}, Python {platform.python_version()}, plain: {digest[:12]}")
    for path in _native.available_instruction_sets():
        other = results(_native, path)
        apart = [
            max(abs(a - b) for a, b in zip(other[name].memory, tensor.memory, strict=True))
            / max(map(abs, tensor.memory))
            for name, tensor in plain.items()
        ]
        print(f"{path}: differs by {max(apart):.1e} of the largest value")


if __name__ == "__main__":
    main()
