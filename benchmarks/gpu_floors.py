"""The least time that each kernel of the GPU rasterizer can take, from what it must read, write and compute.

Bytes are those that have to cross device memory once; what is read again from the caches is not counted. Instructions
are warp instructions of the loops, counted in the machine code (benchmarks.gpu_code), times how often they run.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Peaks:
    """What a device can do at most."""

    bytes_per_second: float
    warp_instructions_per_second: float


PEAKS = {
    # 132 multiprocessors of four schedulers at 1.755 GHz; HBM3
    "H100": Peaks(3.35e12, 132 * 4 * 1.755e9),
    "H200": Peaks(4.8e12, 132 * 4 * 1.755e9),
    # 128 multiprocessors at the boost clock; GDDR6X
    "RTX 4090": Peaks(1.008e12, 128 * 4 * 2.52e9),
}


@dataclass(frozen=True)
class Work:
    """Counts of one step. A pair is a slot in one of its eight sub-tiles."""

    triangles: int
    visible: int
    vertices: int
    slots: int
    hit_slots: int
    hit_pairs: int
    pixels: int
    tiles: int
    channels: int


@dataclass(frozen=True)
class Floor:
    """A kernel's least time: its bytes at the memory's peak, or its instructions at the schedulers'."""

    kernel: str
    launches: int
    bytes: float
    memory_ms: float
    instruction_ms: float

    @property
    def ms(self) -> float:
        """The larger of both."""
        return max(self.memory_ms, self.instruction_ms)

    @property
    def bound(self) -> str:
        """What the floor says; the rest is latency and launches."""
        return "bytes" if self.memory_ms >= self.instruction_ms else "instructions"


# Warp instructions in the machine code of FLAT=3, elastic, sm_90 (NVRTC 13.5, nvdisasm); sm_89 differs by 2 at most. Of
# pairs by `python -m benchmarks.gpu_code`; those of slots are the rest of a batch, spread over them. Of triangles by
# the hardware's counters (`benchmarks/gpu_run.sh profile`, H100): the least of two scenes.
PROJECT_INSTRUCTIONS = 890  # per 32 triangles
FORWARD_PAIR_INSTRUCTIONS = 66  # per (slot, sub-tile) pair
FORWARD_SLOT_INSTRUCTIONS = 22  # staging, the test of eight sub-tiles, eight warps looking for theirs
BACKWARD_PAIR_INSTRUCTIONS = 211  # per pair, 16 shuffles among them
BACKWARD_SLOT_INSTRUCTIONS = 45  # staging, adding the warps' sums, compaction
REDUCE_INSTRUCTIONS = 750  # per 32 triangles


def floors(work: Work, peaks: Peaks) -> list[Floor]:
    """One entry per kernel, in the order of a step."""
    w, record, stride = work, 64, 64
    color = 4 * w.channels
    depth_passes, tile_bits = 4, max(w.tiles - 1, 1).bit_length()
    tile_passes = -(-tile_bits // 8)
    warps = w.triangles / 32
    corners = 36 if w.vertices == 0 else 12
    rows = [
        ("raster_project", 1, w.triangles * (corners + color + 8 + 12) + w.visible * record + 12 * w.vertices,
         warps * PROJECT_INSTRUCTIONS),
        ("radix_histogram", 2, 4 * (w.triangles + w.slots), 0),
        ("radix_pass", depth_passes + tile_passes, 16 * (depth_passes * w.triangles + tile_passes * w.slots), 0),
        ("raster_emit", 1, 16 * w.triangles + 9 * w.slots, 0),
        ("raster_ranges", 1, 4 * w.slots + 8 * w.tiles, 0),
        ("raster_order", 1, 12 * w.tiles, 0),
        ("raster_forward", 1, 9 * w.slots + w.visible * (record + color) + w.pixels * (color + 4),
         w.hit_pairs * FORWARD_PAIR_INSTRUCTIONS + w.slots * FORWARD_SLOT_INSTRUCTIONS),
        ("raster_backward", 1, 9 * w.slots + w.visible * (record + color) + w.hit_slots * stride
         + w.pixels * (2 * color + 4),
         w.hit_pairs * BACKWARD_PAIR_INSTRUCTIONS + w.hit_slots * BACKWARD_SLOT_INSTRUCTIONS),
        ("raster_reduce", 1, w.hit_slots * stride + w.slots + w.triangles * (corners + 12 + 36 + color + 8),
         warps * REDUCE_INSTRUCTIONS),
        ("raster_gather", 1 if w.vertices else 0, w.triangles * 48 + w.vertices * 16 if w.vertices else 0, 0),
    ]  # fmt: skip
    return [
        Floor(name, launches, size, 1e3 * size / peaks.bytes_per_second,
              1e3 * instructions / peaks.warp_instructions_per_second)
        for name, launches, size, instructions in rows
    ]  # fmt: skip
