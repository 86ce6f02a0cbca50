"""The controls beside the picture. What they say is everybody's who looks; a button acts for who presses it."""

import math
from collections.abc import Callable
from typing import Any, Literal

from etsplat.data.camera_coverage import focus_point
from etsplat.data.dataset import Dataset
from etsplat.data.looked_at import middle_photo
from etsplat.geometry.regions import Box, Region, Sphere
from etsplat.io.json_text import is_number
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.viewer.pictures import MODES
from etsplat.viewer.standing import fov_of

USUAL_FOV = 50
"""Degrees, without a capture."""

_WHOLE: Literal["everything"] = "everything"


class Panel:
    """What is shown, and from where.

    Attributes:
        status: a line of text.
    """

    def __init__(self, gui: Any, capture: Dataset | None, soup: TriangleSoup, changed: Callable[[], None]) -> None:
        """Adds the controls.

        Args:
            gui: viser's.
            capture: what can be gone to; None where it is not known.
            soup: around whose middle is cropped where there is no capture.
            changed: called when pictures must be drawn anew.
        """
        self._gui, self._capture, self._changed = gui, capture, changed
        unknown = capture is None
        self._mode = gui.add_dropdown("Mode", MODES, initial_value="soft")
        fov = USUAL_FOV if capture is None else round(math.degrees(fov_of(capture, middle_photo(capture))))
        self._fov = gui.add_slider("Field of view", 5, 150, 1, min(max(fov, 5), 150), hint="Vertical, in degrees")
        self._near = gui.add_checkbox(
            "Keep near the photos", not unknown, disabled=unknown, hint="Elsewhere there is little to see"
        )
        self.status = gui.add_markdown("")
        with gui.add_folder("Photos", visible=not unknown):
            self.show_cameras = gui.add_checkbox("Training cameras", False, disabled=unknown)
            self._beside = gui.add_checkbox("Photo beside the picture", False, disabled=unknown)
            names = [""] if capture is None else ["-", *capture.names]
            self._photo = gui.add_dropdown("Go to", names, initial_value=names[0])
            self._step = gui.add_button_group("Next to it", ["before", "after"])
        with gui.add_folder("Crop", expand_by_default=False):
            self._add_crop(soup)
        with gui.add_folder("Film", expand_by_default=False):
            self.snapshot = gui.add_button("Snapshot", hint="The picture as a PNG file")
            self.add_key = gui.add_button("Add this pose", hint="A film goes from pose to pose")
            self.drop_key = gui.add_button("Remove the last pose")
            self.save_keys = gui.add_button("Save the path", hint="For etsplat render --path FILE.json")
            self.keys = gui.add_markdown("")
        for control in (self._mode, self._near, self._beside):
            control.on_update(lambda _: changed())
        self._fov.on_update(self._zoom)

    @property
    def mode(self) -> Any:
        """The chosen mode."""
        return self._mode.value

    @property
    def near(self) -> bool:
        """Whether cameras are kept near photos."""
        return self._capture is not None and bool(self._near.value)

    @property
    def beside(self) -> bool:
        """Whether the photo is shown beside the picture."""
        return self._capture is not None and bool(self._beside.value)

    @property
    def crop(self) -> Region | None:
        """What part is shown; None for everything, and where a browser says what is no part."""
        kind, numbers = self._kind.value, [slider.value for slider in (*self._center, *self._reach)]
        if kind not in ("sphere", "box") or not all(map(is_number, numbers)):
            return None
        x, y, z, *(a, b, c) = map(float, numbers)
        if min(a, b, c) <= 0:
            return None
        return Sphere((x, y, z), a) if kind == "sphere" else Box((x - a, y - b, z - c), (x + a, y + b, z + c))

    def on_go(self, go: Callable[[Any, int], None]) -> None:
        """`go` is called with the browser and the photo's index when one is chosen."""
        if (capture := self._capture) is None:
            return
        places = {name: index for index, name in enumerate(capture.names)}

        def chosen(event: Any) -> None:
            if event.client is not None and (index := places.get(self._photo.value)) is not None:
                go(event.client, index)

        def stepped(event: Any) -> None:
            if event.client is None:
                return
            before = places.get(self._photo.value, middle_photo(capture))
            index = (before + (1 if self._step.value == "after" else -1)) % len(capture)
            self._photo.value = capture.names[index]
            go(event.client, index)

        self._photo.on_update(chosen)
        self._step.on_click(stepped)

    def _zoom(self, event: Any) -> None:
        degrees = self._fov.value
        if event.client is not None and is_number(degrees) and 1 <= degrees <= 170:
            event.client.camera.fov = math.radians(degrees)
            self._changed()

    def _add_crop(self, soup: TriangleSoup) -> None:
        """A sphere or box around what is looked at."""
        if self._capture is None:
            centers = soup.vertices.detach().mean(dim=1).double().cpu()
            middle = centers.median(dim=0).values if len(soup) else centers.new_zeros(3)
            size = 3 * float((centers - middle).norm(dim=1).median()) if len(soup) > 1 else 1.0
        else:
            middle = focus_point(self._capture.viewmats)
            size = float((self._capture.centers - middle).norm(dim=1).median())
        size = max(size, 1e-6)
        step, gui = size / 200, self._gui
        self._kind = gui.add_dropdown("Show", (_WHOLE, "sphere", "box"), initial_value=_WHOLE)
        self._center = [
            gui.add_slider(f"Middle {axis}", value - 2 * size, value + 2 * size, step, value)
            for axis, value in zip("xyz", middle.tolist(), strict=True)
        ]
        self._reach = [
            gui.add_slider(name, step, 4 * size, step, 0.5 * size)
            for name in ("Radius, half of x", "Half of y", "Half of z")
        ]
        self._crop_text = gui.add_markdown("")
        for control in (self._kind, *self._center, *self._reach):
            control.on_update(self._cropped)

    def _cropped(self, _: Any) -> None:
        crop = self.crop
        self._crop_text.content = "" if crop is None else f"`{crop}`"
        self._changed()
