"""A surface as mesh files hold it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Colors = np.ndarray | None
Content = Literal["vertex_colors", "face_colors", "alpha", "numbers"]
"""What a kind of file may have room for, beside vertices and faces."""


@dataclass(frozen=True)
class Surface:
    """Triangles, and what may be known of them. Colours are display values (sRGB) in [0, 1], with alpha where C is 4.

    Attributes:
        vertices: (V, 3) float32.
        faces: (F, 3) indices into `vertices`.
        vertex_colors: (V, C), or None.
        face_colors: (F, C), or None.
        numbers: further values (F,) of each face, by name.
        comment: a line of text.
        name: what programs call the object.
    """

    vertices: np.ndarray
    faces: np.ndarray
    vertex_colors: Colors = None
    face_colors: Colors = None
    numbers: Mapping[str, np.ndarray] = field(default_factory=dict)
    comment: str | None = None
    name: str = ""
