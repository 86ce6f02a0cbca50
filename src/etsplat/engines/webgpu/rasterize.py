"""The rasterizer in WGSL: one view after the other, forward only.

Two submissions for each view. The first projects the triangles, sorts them by depth and counts the pairs of a triangle
and a tile; the host reads their number, four bytes, and makes room. The second lists the pairs, sorts them by tile and
composites.
"""

import math
import struct
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.errors import InputError
from etsplat.core.rasterization import TriangleStatistics
from etsplat.engines.native.plan import (
    Geometry,
    Images,
    Inputs,
    Outputs,
    PerInput,
    Plan,
    alpha_limits,
    indexed_corners,
)
from etsplat.engines.webgpu.device import Program, Step, WebGpu, gpu, spread
from etsplat.engines.webgpu.sort import scan_step, sort_steps

_KERNELS = ("single_sided", "bilateral", "elastic", "hard")  # in the order of KERNEL of the shaders
_BIN = Program(("common", "block_scan", "tiles", "bin"))
_BLOCK, _RANKS = 256, 1024
_RECORD = 96  # bytes
_MOST_SLOTS = 2**30


class WebGpuRender:
    """One forward pass. There is no backward pass: `backward` says so."""

    most_channels: int | None = _native.MOST_GPU_CHANNELS
    per_corner = staticmethod(indexed_corners)

    def __init__(self, plan: Plan, inputs: Inputs, outputs: Outputs, keep: bool) -> None:
        _check(plan)
        inputs = Inputs(*(None if tensor is None else tensor.detach() for tensor in inputs))  # numpy wants them so
        device = gpu()
        with device.lock:
            for view in range(plan.views):
                _View(device, plan, inputs, view).draw(outputs)

    def backward(
        self,
        inputs: Inputs,
        images: Images,
        cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
        needed: PerInput,
    ) -> NoReturn:
        """See ``Render``.

        Raises:
            InputError: always.
        """
        raise InputError("engine webgpu draws and has no gradients; use engine cpu or cuda for what is differentiated")


def _check(plan: Plan) -> None:
    if plan.settings.kernel not in _KERNELS:
        raise InputError(
            f"engine webgpu draws the kernels {', '.join(_KERNELS)}, not {plan.settings.kernel}; use engine cpu or cuda"
        )
    if plan.settings.wants("distortion"):
        raise InputError("engine webgpu draws no distortion, which is a loss; use engine cpu or cuda")


class _View:
    """One view: its buffers, and the work on them."""

    def __init__(self, device: WebGpu, plan: Plan, inputs: Inputs, view: int) -> None:
        self.gpu, self.plan, self.inputs, self.view = device, plan, inputs, view
        self.settings = plan.settings
        camera = inputs.viewmats[view].isfinite().all() and inputs.Ks[view].isfinite().all()
        self.count = plan.geometry.count if camera else 0  # one that is not finite sees nothing
        self.flat, self.corner = inputs.channels
        self.tiles = math.ceil(self.settings.width / _native.TILE), math.ceil(self.settings.height / _native.TILE)
        self.blocks = math.ceil(self.count / _RANKS)
        names = {"keys": 4, "keys 2": 4, "order": 4, "order 2": 4, "counts": 4, "records": _RECORD}
        self.buffers = {name: device.room(name, size * self.count) for name, size in names.items()}
        self.buffers["totals"] = device.room("totals", 4 * (self.blocks + 1))
        self.buffers["ranges"] = device.room("ranges", 8 * self.tiles[0] * self.tiles[1])
        self.buffers["max weight"] = device.room(
            "max weight", 4 * self.count if self.settings.wants("statistics") else 4
        )
        channels = self.flat + self.corner + 2
        self.buffers["image"] = device.room("image", 4 * channels * self.settings.width * self.settings.height)

    def draw(self, outputs: Outputs) -> None:
        """Write the images of this view."""
        order, slots = self._project()
        told = self._tell(slots)
        steps, pairs = self._list_pairs(told, order, slots) if slots else ([], order)
        zeroed = {"ranges": self.buffers["ranges"].size, "max weight": self.buffers["max weight"].size}
        self.gpu.run([*steps, self._composite(told, pairs, outputs)], zeroed)
        self._read(outputs)

    def _project(self) -> tuple[Any, int]:
        """The buffer with the triangles in the order of their depths, and how many pairs there are."""
        if self.count == 0:
            return self.buffers["order"], 0
        gpu, buffers = self.gpu, self.buffers
        corners, softness = _triangles(self.plan.geometry, self.inputs, self.view)
        given = {"corners": gpu.filled("corners", corners), "softness": gpu.filled("softness", softness)}
        made = {name: buffers[name] for name in ("records", "keys", "order", "counts")}
        told, totals = self._tell(0), buffers["totals"]
        program = Program(("common", "tiles", "project"), self._constants(SDF=self.settings.distance == "sdf"))
        project = Step(program, "project", spread(math.ceil(self.count / _BLOCK)), {"view": told, **given, **made})
        pairs = (buffers["keys"], buffers["keys 2"]), (buffers["order"], buffers["order 2"])
        by_depth, _, order = sort_steps(gpu, "depth", *pairs, self.count, 31)
        read = {"view": told, "order": order, "counts": buffers["counts"], "totals": totals}
        count = Step(_BIN, "slot_totals", spread(self.blocks), read)
        gpu.run([project, *by_depth, count, scan_step(gpu, "totals step", totals, self.blocks)])
        slots = int(gpu.read(totals, np.uint32, 1, 4 * self.blocks)[0])
        if slots > _MOST_SLOTS:
            raise InputError(
                f"engine webgpu: the triangles of this picture touch more than {_MOST_SLOTS:,} tiles; draw fewer "
                "triangles or a smaller picture, or use engine cpu"
            )
        return order, slots

    def _list_pairs(self, told: Any, order: Any, slots: int) -> tuple[list[Step], Any]:
        """Steps, and the buffer with the triangle of each pair after them, by tile and from front to back."""
        gpu, tiles = self.gpu, self.tiles[0] * self.tiles[1]
        keys = (gpu.room("slot tile", 4 * slots), gpu.room("slot tile 2", 4 * slots))
        triangles = (gpu.room("slot triangle", 4 * slots), gpu.room("slot triangle 2", 4 * slots))
        read = {name: self.buffers[name] for name in ("counts", "totals", "records")}
        written = {"slot_tile": keys[0], "slot_triangle": triangles[0]}
        emit = Step(_BIN, "emit", spread(self.blocks), {"view": told, "order": order, **read, **written})
        by_tile, sorted_tiles, chosen = sort_steps(gpu, "tile", keys, triangles, slots, tiles.bit_length())
        limits = {"view": told, "slot_tile": sorted_tiles, "tile_ranges": self.buffers["ranges"]}
        return [emit, *by_tile, Step(_BIN, "ranges", spread(math.ceil(slots / _BLOCK)), limits)], chosen

    def _composite(self, told: Any, triangles: Any, outputs: Outputs) -> Step:
        gpu, inputs, buffers = self.gpu, self.inputs, self.buffers
        channels = self.flat + self.corner
        background = torch.zeros(channels) if inputs.backgrounds is None else inputs.backgrounds[self.view]
        bound = {
            "view": told,
            "records": buffers["records"],
            "slot_triangle": triangles,
            "tile_ranges": buffers["ranges"],
            "flat_colors": gpu.filled("flat colors", _of_view(inputs.flat, 2, self.view)),
            "corner_colors": gpu.filled("corner colors", _of_view(inputs.corner, 3, self.view)),
            "background": gpu.filled("background", background.numpy()),
            "image": buffers["image"],
            "max_weight": buffers["max weight"],
        }
        constants = self._constants(FLAT=self.flat, CORNER=self.corner, STATISTICS=outputs.statistics is not None)
        return Step(Program(("common", "composite"), constants), "composite", self.tiles, bound)

    def _read(self, outputs: Outputs) -> None:
        """Bring the images back, and what is known of the triangles if that is asked for."""
        shape = (self.settings.height, self.settings.width, self.flat + self.corner + 2)
        words = self.gpu.read(self.buffers["image"], np.uint32, math.prod(shape)).reshape(shape)
        numbers = torch.from_numpy(words[..., :-1].copy().view(np.float32))
        outputs.images.color[self.view] = numbers[..., :-1]
        outputs.images.alpha[self.view] = numbers[..., -1:]
        if outputs.median_triangle is not None:
            outputs.median_triangle[self.view] = torch.from_numpy(words[..., -1].astype(np.int32))
        if outputs.statistics is not None:
            self._read_statistics(outputs.statistics)

    def _read_statistics(self, found: TriangleStatistics) -> None:
        if self.count == 0:
            for values in vars(found).values():
                values[self.view] = 0
            return
        records = self.gpu.read(self.buffers["records"], np.float32, _RECORD // 4 * self.count)
        inradius, size = torch.from_numpy(records.reshape(self.count, -1)[:, [-5, -1]]).unbind(dim=1)
        visible = size >= 0
        found.visible[self.view] = visible
        found.screen_size[self.view] = torch.where(visible, size, 0.0)
        found.inradius[self.view] = torch.where(visible, inradius, 0.0)
        weights = self.gpu.read(self.buffers["max weight"], np.float32, self.count)
        found.max_weight[self.view] = torch.from_numpy(weights.copy())

    def _constants(self, **more: bool | int) -> tuple[tuple[str, str], ...]:
        """Definitions that specialise a shader."""
        given = {"KERNEL": _KERNELS.index(self.settings.kernel), **more}
        return tuple(
            (name, str(value).lower() if isinstance(value, bool) else f"{value}u") for name, value in given.items()
        )

    def _tell(self, slots: int) -> Any:
        """What the shaders have as `Pass`."""
        settings = self.settings
        viewmat, K = self.inputs.viewmats[self.view], self.inputs.Ks[self.view]
        support_alpha, _, x_max, transmittance_min = settings.cutoffs
        floats = [*viewmat[:3].flatten().tolist(), *(K.flatten()[i].item() for i in (0, 1, 2, 4, 5))]
        cutoffs = [support_alpha, *alpha_limits(settings.cutoffs), min(x_max, 3e38), transmittance_min]
        sizes = (self.count, settings.width, settings.height, *self.tiles, slots, 0, 0, 0)
        return self.gpu.filled("view", struct.pack("<23f9I", *floats, settings.near_plane, *cutoffs, *sizes))


def _triangles(geometry: Geometry, inputs: Inputs, view: int) -> tuple["np.ndarray[Any, Any]", "np.ndarray[Any, Any]"]:
    """Corners (N, 9), and opacity with sigma (N, 2); what has a wrong index or a colour that is not finite has none."""
    corners, opacities = inputs.vertices, inputs.opacities
    if geometry.faces is not None:
        faces = geometry.faces
        known = ((faces >= 0) & (faces < geometry.vertex_count)).all(dim=1)
        corners = corners[torch.where(known[:, None], faces, 0).long()]
        opacities = torch.where(known, opacities, 0.0)
    for channels, dims in ((inputs.flat, (-1,)), (inputs.corner, (-2, -1))):
        if channels is not None and not channels.isfinite().all():
            seen = channels if channels.dim() == len(dims) + 1 else channels[view]
            opacities = torch.where(seen.isfinite().all(dim=dims), opacities, 0.0)
    softness = torch.stack([opacities, inputs.sigma.expand(len(opacities))], dim=1)
    return corners.contiguous().numpy(), softness.numpy()


def _of_view(channels: Tensor | None, dims: int, view: int) -> "np.ndarray[Any, Any]":
    """Those of one view, where views have their own."""
    if channels is None:
        return np.zeros(1, np.float32)
    return (channels if channels.dim() == dims else channels[view]).contiguous().numpy()
