"""The rasterizer's launches on a GPU, and the memory that they share.

A forward is a sequence of launches that nothing waits for: project, sort by depth, list (triangle, tile) pairs, sort by
tile, composite. All views go through together. Sums over pixels are kept per pair and added in a fixed order, so
results are the same bits every time.
"""

import ctypes
from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.kernels import DISTANCES, KERNELS
from etsplat.core.rasterization import DISTORTION_FAR, DISTORTION_NEAR
from etsplat.engines.cuda.capacity import capacity_for, note_capture, overflow_flag, record_need
from etsplat.engines.cuda.launch import backend, blocks, launch, on_device_of
from etsplat.engines.cuda.memory import Arena, PendingNumber
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.sort import RadixSort
from etsplat.engines.cuda.structs import struct_class
from etsplat.engines.native.plan import Geometry, Images, Inputs, Outputs, PerInput, Plan

_TINY = 1.17549435e-38
_PROJECT = Program("raster_project.cu")
_Depth = _native.DistortionDepth


class CudaRender:
    """One forward pass of all views together, and what its backward pass needs of it."""

    most_channels: int | None = _native.MOST_GPU_CHANNELS

    def __init__(self, plan: Plan, inputs: Inputs, outputs: Outputs, keep: bool) -> None:
        settings = plan.settings
        self.plan = plan
        self.keep = keep
        self.device = inputs.vertices.device
        self.flat, self.corner = inputs.channels
        self.shape = (plan.views, settings.width, settings.height)
        self.tiles = blocks(settings.width, _native.TILE), blocks(settings.height, _native.TILE)
        self.tile_count = plan.views * self.tiles[0] * self.tiles[1]
        self.projected = plan.views * plan.geometry.count
        self.distortion = _Depth.NONE
        if settings.wants("distortion"):
            self.distortion = _Depth.CENTROID if settings.depth_of == "centroid" else _Depth.PLANE
        self.arguments = struct_class("cuda/raster_pass.h", "RasterPass")()
        self._fill_inputs(inputs)
        self._fill_images(outputs.images)
        self._fill_outputs(outputs)
        with on_device_of(inputs.vertices):
            self._render()

    def _render(self) -> None:
        """Again with more room if the pairs did not fit."""
        count, capturing = self.plan.geometry.count, backend().capturing
        flag = overflow_flag(self.device)
        if capturing:
            note_capture(self.device, self.shape, count)
        while True:
            capacity = capacity_for(self.device, self.shape, count)
            wanted = self._list_pairs(capacity, flag if capturing else None)
            pending = None if capturing else PendingNumber(wanted)
            self._composite(capacity)
            if pending is None:
                return
            pairs = pending.wait()
            record_need(self.device, self.shape, count, pairs)
            if pairs <= capacity:
                return

    def _list_pairs(self, capacity: int, overflow: Tensor | None) -> Tensor:
        """Project, sort by depth, list the pairs; returns the number of pairs wanted, on the device.

        If they did not fit, ``overflow`` holds that number, too.
        """
        a, m, tiles = self.arguments, self.projected, self.tile_count
        by_depth = RadixSort(max(m, 1), 31)
        self.by_tile = RadixSort(capacity, max(tiles - 1, 1).bit_length())
        emit_grid = blocks(m, 1024)
        # What has to be zero at first, in one piece; the 64-bit words first.
        sizes = [2, 2 * emit_grid, 2, 2 * tiles, by_depth.zeros, self.by_tile.zeros]
        self.zeros = torch.zeros(sum(sizes), dtype=torch.int32, device=self.device)
        wanted, scan_state, counters, ranges, depth_zeros, self.tile_zeros = self.zeros.split(sizes)
        self.state, self.temporary = self._allocate(capacity)
        state, temporary = self.state, self.temporary
        a.capacity = capacity
        a.records, a.spans, a.slot_begin = state["records"], state["spans"], state["slot_begin"]
        a.attributes = state["attributes"] if self._attributes else 0
        a.slot_triangle, a.hits = state["slot_triangle"], state["hits"] if self.keep else 0
        a.tile_done, a.tile_ranges = state["tile_done"], ranges.data_ptr()
        a.depth_keys, a.slot_tile = temporary["depth_keys"], temporary["tile_keys"]
        a.wanted, a.slots, a.scan_ticket = wanted.data_ptr(), counters.data_ptr(), counters[1:].data_ptr()
        a.scan_state, a.overflow = scan_state.data_ptr(), _pointer(overflow)
        launch(_PROJECT, "raster_project", blocks(m, 128), 128, [a])
        keys = (temporary["depth_keys"], temporary["depth_keys_2"])
        _, order = by_depth.run(keys, (temporary["order"], temporary["order_2"]), m, depth_zeros)
        a.order = order
        launch(_PROJECT, "raster_emit", emit_grid, 256, [a])
        return wanted.view(torch.int64)

    def _composite(self, capacity: int) -> None:
        """Sort the pairs by tile and go through the tiles."""
        a, temporary = self.arguments, self.temporary
        slots = (self.state["sorted_slots"], temporary["sorted_slots_2"])
        if self.by_tile.passes % 2 == 1:  # the result ends up in what is kept
            slots = (slots[1], slots[0])
        keys = (temporary["tile_keys"], temporary["tile_keys_2"])
        a.sorted_tiles, a.sorted_slots = self.by_tile.run(keys, slots, ctypes.c_void_p(a.slots), self.tile_zeros)
        launch(_PROJECT, "raster_ranges", blocks(capacity, 256), 256, [a])
        settings = self.plan.settings
        defines = self._defines(self.distortion, settings.wants("median_depth"), settings.wants("statistics"))
        launch(Program("raster_forward.cu", defines), "raster_forward", self.tile_count, 256, [a])
        del self.temporary, self.tile_zeros

    def _allocate(self, capacity: int) -> tuple[Arena, Arena]:
        """What the backward pass reads, and what only the forward pass needs."""
        m, state, temporary = self.projected, Arena(), Arena()
        state.add("records", _native.TRIANGLE_RECORD * m)
        state.add("attributes", _native.ATTRIBUTE_RECORD * m if self._attributes else 0)
        state.add("spans", 2 * m)
        state.add("slot_begin", m)
        state.add("slot_triangle", capacity)
        state.add("sorted_slots", capacity)
        state.add("hits", capacity if self.keep else 0, size=1)
        state.add("tile_done", self.tile_count)
        for name in ("depth_keys", "depth_keys_2", "order", "order_2"):
            temporary.add(name, m)
        for name in ("tile_keys", "tile_keys_2", "sorted_slots_2"):
            temporary.add(name, capacity)
        state.allocate(self.device)
        temporary.allocate(self.device)
        return state, temporary

    def backward(
        self,
        inputs: Inputs,
        images: Images,
        cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
        needed: PerInput,
    ) -> PerInput:
        """See ``Render``."""
        with on_device_of(inputs.vertices):
            self._fill_inputs(inputs)
            self._fill_images(images)
            return self._gradients(inputs, cotangents, needed)

    def _gradients(
        self, inputs: Inputs, cotangents: tuple[Tensor | None, Tensor | None, Tensor | None], needed: PerInput
    ) -> PerInput:
        a = self.arguments
        grad_color, grad_alpha, grad_distortion = cotangents
        distortion = self.distortion if grad_distortion is not None else _Depth.NONE
        defines = self._defines(distortion, median=False, weights=False)
        stride = _native.slot_stride(flat_channels=self.flat, corner_channels=self.corner, distortion=distortion)
        reduce_grid = blocks(self.plan.geometry.count, 128)
        grads = _Gradients(self, inputs, needed, reduce_grid)
        sums = torch.empty(a.capacity * stride, device=self.device)
        a.grad_color, a.grad_alpha = _pointer(grad_color), _pointer(grad_alpha)
        a.grad_distortion, a.slot_sums = _pointer(grad_distortion), sums.data_ptr()
        grads.fill(a)
        launch(Program("raster_backward.cu", defines), "raster_backward", self.tile_count, 256, [a])
        launch(Program("raster_reduce.cu", defines[1:]), "raster_reduce", reduce_grid, 128, [a])
        return grads.finish(defines[1:])

    @property
    def _attributes(self) -> bool:
        return self.corner > 0 or self.distortion != _Depth.NONE

    def _defines(
        self, distortion: _native.DistortionDepth, median: bool, weights: bool
    ) -> tuple[tuple[str, int | str], ...]:
        """Definitions that specialise the tile loops."""
        return (
            ("KERNEL", KERNELS[self.plan.settings.kernel].native_name),
            ("FLAT", self.flat),
            ("CORNER", self.corner),
            ("DISTORTION", int(distortion)),
            ("MEDIAN", int(median)),
            ("WEIGHTS", int(weights)),
        )

    def _fill_inputs(self, inputs: Inputs) -> None:
        a, plan, settings = self.arguments, self.plan, self.plan.settings
        a.vertices, a.faces = _pointer(inputs.vertices), _pointer(plan.geometry.faces)
        a.flat_colors, a.corner_colors = _pointer(inputs.flat), _pointer(inputs.corner)
        a.opacities, a.sigmas = _pointer(inputs.opacities), _pointer(inputs.sigma)
        a.viewmats, a.Ks, a.backgrounds = map(_pointer, (inputs.viewmats, inputs.Ks, inputs.backgrounds))
        a.triangles, a.vertex_count, a.views = plan.geometry.count, plan.geometry.vertex_count, plan.views
        a.width, a.height = settings.width, settings.height
        a.tiles_x, a.tiles_y = self.tiles
        kernel = KERNELS[settings.kernel]
        self.table = None if kernel.table is None else kernel.table.native(self.device)  # kept: `a` has its address
        a.kernel, a.kernel_table = kernel.native_id, _pointer(self.table)
        a.distance = DISTANCES.index(settings.distance)
        a.freeze_inradius = settings.freeze_inradius
        a.shared_sigma = inputs.sigma.dim() == 0
        a.flat_per_view = inputs.flat_per_view
        a.corner_per_view = inputs.corner_per_view
        a.flat_channels, a.corner_channels = self.flat, self.corner
        alpha_min, alpha_max, x_max, a.transmittance_min = settings.cutoffs
        # With the cut-offs off, too: where alpha is 0 x^(2/sigma) may have overflowed, and the backward divides by
        # 1 - alpha.
        a.near_plane, a.support_alpha, a.x_max = settings.near_plane, alpha_min, x_max
        a.alpha_min, a.alpha_max = max(alpha_min, _TINY), min(alpha_max, 1.0 - 1e-6)
        a.distortion_near, a.distortion_far = DISTORTION_NEAR, DISTORTION_FAR

    def _fill_images(self, images: Images) -> None:
        a = self.arguments
        a.color, a.alpha = images.color.data_ptr(), images.alpha.data_ptr()
        if self.plan.settings.wants("distortion"):
            a.distortion, a.distortion_totals = images.distortion.data_ptr(), _pointer(images.distortion_totals)

    def _fill_outputs(self, outputs: Outputs) -> None:
        a, settings = self.arguments, self.plan.settings
        if settings.wants("median_depth"):
            a.median_triangle = outputs.median_triangle.data_ptr()
        if outputs.statistics is not None:
            statistics = outputs.statistics
            a.max_weight, a.screen_size = statistics.max_weight.data_ptr(), statistics.screen_size.data_ptr()
            a.inradius, a.visible = statistics.inradius.data_ptr(), statistics.visible.data_ptr()


def per_corner(values: Tensor, faces: Tensor, _geometry: Geometry) -> Tensor:
    """See `NativeCalls.per_corner`."""
    return values[faces.long()]


class _Gradients:
    """Gradients of the inputs, as the kernels write them, and what is left to add up in torch."""

    def __init__(self, render: CudaRender, inputs: Inputs, needed: PerInput, reduce_grid: int) -> None:
        self.geometry = render.plan.geometry
        device, views, count = render.device, render.plan.views, self.geometry.count
        flat, corner, sigma, backgrounds = inputs.flat, inputs.corner, inputs.sigma, inputs.backgrounds
        empty = torch.empty if count > 0 else torch.zeros
        self.corners = empty(count, 3, 3, device=device) if needed.vertices else None
        self.flat = empty(flat.shape, device=device) if needed.flat and flat is not None else None
        self.corner = empty(corner.shape, device=device) if needed.corner and corner is not None else None
        self.opacities = empty(count, device=device) if needed.opacities else None
        own = sigma.dim() == 1
        self.sigmas = empty(count, device=device) if needed.sigma and own else None
        sums = torch.float64
        self.sigma_sums = torch.empty(reduce_grid, dtype=sums, device=device) if needed.sigma and not own else None
        self.needed, cameras = needed, needed.viewmats or needed.Ks
        camera_shape = (views, reduce_grid, _native.CAMERA_GRADIENTS)
        self.camera_sums = torch.empty(camera_shape, dtype=sums, device=device) if cameras else None
        self.background = None
        if needed.backgrounds and backgrounds is not None:
            self.background = torch.empty(views, render.tile_count // views, backgrounds.shape[1], device=device)

    def fill(self, a: Any) -> None:
        """Hand the addresses to the kernels."""
        a.grad_corners, a.grad_flat, a.grad_corner_colors = map(_pointer, (self.corners, self.flat, self.corner))
        a.grad_opacities, a.grad_sigmas = _pointer(self.opacities), _pointer(self.sigmas)
        a.sigma_sums, a.camera_sums = _pointer(self.sigma_sums), _pointer(self.camera_sums)
        a.tile_background = _pointer(self.background)

    def finish(self, defines: tuple[tuple[str, int | str], ...]) -> PerInput:
        """What is left to add up."""
        vertices, sigma = self.corners, self.sigmas
        geometry = self.geometry
        if vertices is not None and geometry.faces is not None:
            count = geometry.vertex_count
            vertices = torch.empty(count, 3, device=vertices.device)
            arguments = [self.corners, *geometry.corners, count, vertices]
            launch(Program("raster_reduce.cu", defines), "raster_gather", blocks(count, 256), 256, arguments)
        if self.sigma_sums is not None:
            sigma = self.sigma_sums.sum().float()
        viewmats, Ks = self._cameras()
        background = None if self.background is None else self.background.sum(1)
        return PerInput(vertices, self.flat, self.corner, self.opacities, sigma, viewmats, Ks, background)

    def _cameras(self) -> tuple[Tensor | None, Tensor | None]:
        """By viewmats and Ks, from sums by [rotation | translation], fx, cx, fy, cy (``camera_gradient``)."""
        if self.camera_sums is None:
            return None, None
        rows, fx, cx, fy, cy = self.camera_sums.sum(1).float().split((12, 1, 1, 1, 1), dim=1)
        viewmats = torch.nn.functional.pad(rows.view(-1, 3, 4), (0, 0, 0, 1))
        zero = torch.zeros_like(fx)
        Ks = torch.cat([fx, zero, cx, zero, fy, cy, zero, zero, zero], dim=1).view(-1, 3, 3)
        return viewmats if self.needed.viewmats else None, Ks if self.needed.Ks else None


def _pointer(tensor: Tensor | None) -> int:
    return 0 if tensor is None else tensor.data_ptr()
