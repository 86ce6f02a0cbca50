"""The rasterizer's launches on a GPU, and the memory that they share.

A forward is a sequence of launches that nothing waits for: project, sort by depth, list (triangle, tile) pairs, sort by
tile, composite. All views go through together. Sums over pixels are kept per pair and added in a fixed order, so
results are the same bits every time.
"""

import ctypes

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.kernels import DISTANCES, KERNELS
from etsplat.core.rasterization import DISTORTION_FAR, DISTORTION_NEAR
from etsplat.engines.cuda.capacity import capacity_for, check_numbers, note_capture, overflow_flag, record_need
from etsplat.engines.cuda.launch import backend, blocks, launch, launch_each, on_device_of
from etsplat.engines.cuda.memory import Arena, PendingNumber
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.sort import RadixSort
from etsplat.engines.cuda.structs import constant, struct_class
from etsplat.engines.native.plan import (
    Images,
    Inputs,
    Outputs,
    PerInput,
    Plan,
    alpha_limits,
    indexed_corners,
)

_TILE_THREADS = _native.TILE**2
_PROJECT_BLOCK = constant("cuda/raster_project.cu", "kProjectBlock")
_EMIT_BLOCK, _EMIT_ITEMS = (constant("cuda/raster_project.cu", name) for name in ("kEmitBlock", "kEmitItems"))
_ORDER_BLOCK = constant("cuda/raster_project.cu", "kOrderBlock")
_AT_ONCE = 512  # tiles that the largest GPUs draw side by side: in which order does not matter then
_REDUCE_BLOCK = constant("cuda/raster_reduce.cu", "kReduceBlock")
_PROJECT = Program("raster_project.cu")
_Depth = _native.DistortionDepth


class CudaRender:
    """One forward pass of all views together, and what its backward pass needs of it."""

    most_channels: int | None = _native.MOST_GPU_CHANNELS
    per_corner = staticmethod(indexed_corners)

    def __init__(self, plan: Plan, inputs: Inputs, outputs: Outputs, keep: bool) -> None:
        settings = plan.settings
        self.plan = plan
        self.keep = keep
        self.device = inputs.vertices.device
        self.flat, self.corner = inputs.channels
        self.shape = (plan.views, settings.width, settings.height)
        self.tiles = blocks(settings.width, _native.TILE), blocks(settings.height, _native.TILE)
        check_numbers(plan.views, plan.geometry.count, self.tiles[0] * self.tiles[1])
        self.tile_count = plan.views * self.tiles[0] * self.tiles[1]
        self.projected = plan.views * plan.geometry.count
        self.distortion = _Depth.NONE
        if settings.wants("distortion"):
            self.distortion = _Depth.CENTROID if settings.depth_of == "centroid" else _Depth.PLANE
        self.arguments = struct_class("cuda/raster_pass.h", "RasterPass")()
        self._fill(inputs, outputs.images)
        self.arguments.median_triangle = outputs.median_triangle
        if outputs.statistics is not None:
            self.arguments.set(**vars(outputs.statistics))
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
        emit_grid = blocks(m, _EMIT_BLOCK * _EMIT_ITEMS)
        # What has to be zero at first, in one piece; the 64-bit words first.
        sizes = [2, 2 * emit_grid, 2, 2 * tiles, by_depth.zeros, self.by_tile.zeros]
        self.zeros = torch.zeros(sum(sizes), dtype=torch.int32, device=self.device)
        wanted, scan_state, counters, ranges, depth_zeros, self.tile_zeros = self.zeros.split(sizes)
        attributes = self.corner > 0 or self.distortion != _Depth.NONE
        # What the backward pass reads, and what only the forward pass needs.
        self.state = Arena(
            self.device,
            records=4 * _native.TRIANGLE_RECORD * m,
            attributes=4 * _native.ATTRIBUTE_RECORD * m if attributes else 0,
            spans=8 * m,
            slot_begin=4 * m,
            slot_triangle=4 * capacity,
            sorted_slots=4 * capacity,
            hits=capacity if self.keep else 0,
            tile_done=4 * tiles,
            tile_order=4 * tiles if tiles > _AT_ONCE else 0,
        )
        per_triangle = dict.fromkeys(("depth_keys", "depth_keys_2", "order", "order_2"), 4 * m)
        per_pair = dict.fromkeys(("slot_tile", "slot_tile_2", "sorted_slots_2"), 4 * capacity)
        self.temporary = temporary = Arena(self.device, **per_triangle, **per_pair)
        a.set(capacity=capacity, wanted=wanted, overflow=overflow, scan_state=scan_state, tile_ranges=ranges)
        a.set(slots=counters, scan_ticket=counters[1:], **self.state.addresses)
        a.depth_keys, a.slot_tile = temporary["depth_keys"], temporary["slot_tile"]
        launch_each(_PROJECT, "raster_project", m, [a], _PROJECT_BLOCK)
        keys = (temporary["depth_keys"], temporary["depth_keys_2"])
        _, a.order = by_depth.run(keys, (temporary["order"], temporary["order_2"]), m, depth_zeros)
        launch(_PROJECT, "raster_emit", emit_grid, _EMIT_BLOCK, [a])
        return wanted.view(torch.int64)

    def _composite(self, capacity: int) -> None:
        """Sort the pairs by tile and go through the tiles."""
        a, temporary = self.arguments, self.temporary
        slots = (self.state["sorted_slots"], temporary["sorted_slots_2"])
        if self.by_tile.passes % 2 == 1:  # the result ends up in what is kept
            slots = (slots[1], slots[0])
        keys = (temporary["slot_tile"], temporary["slot_tile_2"])
        a.sorted_tiles, a.sorted_slots = self.by_tile.run(keys, slots, ctypes.c_void_p(a.slots), self.tile_zeros)
        launch_each(_PROJECT, "raster_ranges", capacity, [a])
        if self.tile_count > _AT_ONCE:
            launch(_PROJECT, "raster_order", self.plan.views, _ORDER_BLOCK, [a])
        settings = self.plan.settings
        defines = self._defines(self.distortion, settings.wants("median_depth"), settings.wants("statistics"))
        program = Program("raster_forward.cu", defines, flush=True)
        launch(program, "raster_forward", self.tile_count, _TILE_THREADS, [a])
        del self.temporary, self.tile_zeros

    def backward(
        self,
        inputs: Inputs,
        images: Images,
        cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
        needed: PerInput,
    ) -> PerInput:
        """See ``Render``."""
        with on_device_of(inputs.vertices):
            self._fill(inputs, images)
            return self._gradients(inputs, cotangents, needed)

    def _gradients(
        self, inputs: Inputs, cotangents: tuple[Tensor | None, Tensor | None, Tensor | None], needed: PerInput
    ) -> PerInput:
        """Written by the kernels; of a shared sigma, cameras and backgrounds they leave sums to add up."""
        a, geometry, views = self.arguments, self.plan.geometry, self.plan.views
        grad_color, grad_alpha, grad_distortion = cotangents
        distortion = self.distortion if grad_distortion is not None else _Depth.NONE
        defines = self._defines(distortion, median=False, weights=False)
        grid = blocks(geometry.count, _REDUCE_BLOCK)

        def room(wanted: bool, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor | None:
            return torch.empty(shape, dtype=dtype, device=self.device) if wanted else None

        wanted = (t if want else None for t, want in zip(inputs, needed, strict=True))
        grads = PerInput(*(None if t is None else torch.empty_like(t) for t in wanted))
        gathered, shared_sigma = needed.vertices and geometry.faces is not None, inputs.sigma.dim() == 0
        corners = room(True, geometry.count, 3, 3) if gathered else grads.vertices
        sigma_sums = room(needed.sigma and shared_sigma, views, grid, dtype=torch.float64)
        cameras = needed.viewmats or needed.Ks
        camera_sums = room(cameras, views, grid, _native.CAMERA_GRADIENTS, dtype=torch.float64)
        background = room(needed.backgrounds, views, self.tile_count // views, self.flat + self.corner)
        stride = _native.slot_stride(flat_channels=self.flat, corner_channels=self.corner, distortion=distortion)
        sums = room(True, a.capacity * stride)
        a.set(grad_color=grad_color, grad_alpha=grad_alpha, grad_distortion=grad_distortion, slot_sums=sums)
        a.set(grad_corners=corners, grad_flat=grads.flat, grad_corner_colors=grads.corner)
        a.set(grad_opacities=grads.opacities, grad_sigmas=None if shared_sigma else grads.sigma)
        a.set(sigma_sums=sigma_sums, camera_sums=camera_sums, tile_background=background)
        reduction = Program("raster_reduce.cu", (*defines[1:], ("CAMERAS", int(cameras))))
        program = Program("raster_backward.cu", defines, flush=True)
        launch(program, "raster_backward", self.tile_count, _TILE_THREADS, [a])
        for view in range(views):
            launch(reduction, "raster_reduce", grid, _REDUCE_BLOCK, [a, view])
        if gathered:
            count = geometry.vertex_count
            launch_each(reduction, "raster_gather", count, [corners, *geometry.corners, count, grads.vertices])
        if sigma_sums is not None:
            grads = grads._replace(sigma=sigma_sums.sum().float())
        if camera_sums is not None:
            viewmats, Ks = _camera_gradients(camera_sums)
            grads = grads._replace(viewmats=viewmats if needed.viewmats else None, Ks=Ks if needed.Ks else None)
        return grads if background is None else grads._replace(backgrounds=background.sum(1))

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

    def _fill(self, inputs: Inputs, images: Images) -> None:
        a, geometry, settings = self.arguments, self.plan.geometry, self.plan.settings
        a.set(*inputs, faces=geometry.faces, **images._asdict())
        a.triangles, a.vertex_count = geometry.count, geometry.vertex_count
        a.views, a.width, a.height = self.shape
        a.tiles_x, a.tiles_y = self.tiles
        kernel = KERNELS[settings.kernel]
        self.table = None if kernel.table is None else kernel.table.native(self.device)  # kept: `a` has its address
        a.kernel, a.kernel_table = kernel.native_id, self.table
        a.distance, a.freeze_inradius = DISTANCES.index(settings.distance), settings.freeze_inradius
        a.shared_sigma = inputs.sigma.dim() == 0
        a.flat_per_view, a.corner_per_view = inputs.flat_per_view, inputs.corner_per_view
        a.flat_channels, a.corner_channels = self.flat, self.corner
        a.support_alpha, _, a.x_max, a.transmittance_min = settings.cutoffs
        a.near_plane = settings.near_plane
        a.alpha_min, a.alpha_max = alpha_limits(settings.cutoffs)
        a.distortion_near, a.distortion_far = DISTORTION_NEAR, DISTORTION_FAR


def _camera_gradients(sums: Tensor) -> tuple[Tensor, Tensor]:
    """By viewmats and Ks, from sums by [rotation | translation], fx, cx, fy, cy (``camera_gradient``)."""
    rows, fx, cx, fy, cy = sums.sum(1).float().split((12, 1, 1, 1, 1), dim=1)
    viewmats = torch.nn.functional.pad(rows.view(-1, 3, 4), (0, 0, 0, 1))
    zero = torch.zeros_like(fx)
    return viewmats, torch.cat([fx, zero, cx, zero, fy, cy, zero, zero, zero], dim=1).view(-1, 3, 3)
