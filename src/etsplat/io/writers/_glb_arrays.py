"""The arrays of a binary glTF file: in 32 bits, quantised (KHR_mesh_quantization), or compressed beside that."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from etsplat.io import meshopt
from etsplat.io.writers import Compression

QUANTIZATION = "KHR_mesh_quantization"

_STEPS = (1 << 16) - 1
_ARRAYS, _INDICES = 34962, 34963
_COMPONENTS = {"i1": 5120, "u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_BITS = {"POSITION": "<u2", "TEXCOORD_0": "<u2", "COLOR_0": "<u2", "NORMAL": "i1", "TANGENT": "i1"}
"""How attributes are quantised. Colours are linear light, of which 8 bits would show steps of 12/255 in dark ones."""


@dataclass(frozen=True)
class Grid:
    """Where quantised positions lie: `origin` + `step` times whole numbers from 0 to 65535.

    Attributes:
        origin: (3,) float64.
        step: its length, the same along all axes.
    """

    origin: np.ndarray
    step: float

    @classmethod
    def around(cls, vertices: np.ndarray) -> "Grid":
        """The finest one that holds (V, 3) positions, each within half a step along each axis."""
        low, high = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
        side = float((high - low).max())
        return cls(low, side / _STEPS if side > 0 else 1.0)

    def numbers(self, vertices: np.ndarray) -> np.ndarray:
        """(V, 3) the nearest places."""
        return np.rint((vertices - self.origin) / self.step).clip(0, _STEPS)


class Arrays:
    """Accessors, the views that they are of, and the bytes of these."""

    def __init__(self, compress: Compression) -> None:
        self.compress: Compression = compress
        self.quantized = compress != "none"
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.data: list[bytes] = []
        self._size = self._unpacked = 0

    def attribute(self, name: str, values: np.ndarray) -> int:
        """Append (V, C) values of vertices; the number of their accessor. Quantised positions are whole numbers."""
        kind = f"VEC{values.shape[1]}"
        beyond = name == "TEXCOORD_0" and (values.min() < 0 or values.max() > 1)  # where a texture repeats
        if not self.quantized or beyond:
            number = self._accessor(kind, values.astype("<f4"))
        elif name == "POSITION":
            number = self._accessor(kind, values.astype(_BITS[name]))
        else:
            whole = np.dtype(_BITS[name])
            number = self._accessor(kind, np.rint(values * np.iinfo(whole).max).astype(whole))
            self.accessors[number]["normalized"] = True
        if name == "POSITION":
            stored = values.astype("<f4")
            self.accessors[number] |= {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist()}
        return number

    def indices(self, faces: np.ndarray, vertices: int) -> int:
        """Append the corners of triangles; the number of their accessor."""
        short = vertices <= _STEPS
        corners = faces.astype("<u2" if short else "<u4").reshape(-1)
        if self.compress == "meshopt":
            view = self._packed(*meshopt.encoded_indices(corners, vertices), target=_INDICES)
        else:
            view = self.view(corners.tobytes(), target=_INDICES)
        return self._described(view, corners, "SCALAR")

    def view(self, data: bytes, **more: Any) -> int:
        """Append bytes, from a multiple of 4 on; the number of their view."""
        self.views.append({"buffer": 0, **self._append(data), **more})
        return len(self.views) - 1

    def document(self) -> dict[str, Any]:
        """What of the document is of arrays."""
        buffers: list[dict[str, Any]] = [{"byteLength": self._size}]
        if self.compress == "meshopt":  # what is decoded has a place that the file does not
            buffers.append({"byteLength": self._unpacked, "extensions": {meshopt.EXTENSION: {"fallback": True}}})
        return {"buffers": buffers, "bufferViews": self.views, "accessors": self.accessors}

    def extensions(self) -> list[str]:
        """Without which the arrays cannot be read."""
        needed = [QUANTIZATION] if self.quantized else []
        return needed + ([meshopt.EXTENSION] if self.compress == "meshopt" else [])

    def _accessor(self, kind: str, rows: np.ndarray) -> int:
        wide = rows.itemsize * rows.shape[1]
        room = np.zeros((len(rows), (wide + -wide % 4) // rows.itemsize), dtype=rows.dtype)  # rows begin at multiples
        room[:, : rows.shape[1]] = rows
        stride = {} if wide % 4 == 0 else {"byteStride": wide + -wide % 4}
        if self.compress == "meshopt":
            view = self._packed(*meshopt.encoded_rows(room), target=_ARRAYS)
            self.views[view] |= {"byteStride": room.itemsize * room.shape[1]}
        else:
            view = self.view(room.tobytes(), target=_ARRAYS, **stride)
        return self._described(view, rows, kind)

    def _described(self, view: int, rows: np.ndarray, kind: str) -> int:
        component = _COMPONENTS[rows.dtype.str[1:]]
        self.accessors.append({"bufferView": view, "count": len(rows), "componentType": component, "type": kind})
        return len(self.accessors) - 1

    def _packed(self, data: bytes, said: dict[str, Any], *, target: int) -> int:
        """Append what meshoptimizer made of an array; the number of its view."""
        size = said["byteStride"] * said["count"]
        place = {"buffer": 1, "byteOffset": self._unpacked, "byteLength": size, "target": target}
        stored = {"buffer": 0, **self._append(data), **said}
        self.views.append({**place, "extensions": {meshopt.EXTENSION: stored}})
        self._unpacked += size + -size % 4
        return len(self.views) - 1

    def _append(self, data: bytes) -> dict[str, int]:
        place = {"byteOffset": self._size, "byteLength": len(data)}
        self.data.append(data + bytes(-len(data) % 4))
        self._size += len(self.data[-1])
        return place
