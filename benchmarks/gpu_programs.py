"""What there is to compile for a GPU: every file of csrc/cuda, and variants of those that definitions specialise."""

from etsplat.engines.cuda.channels import CHANNELS_THREADS
from etsplat.engines.cuda.launch import BLOCK
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import constant

# Threads of a block, of kernels that do not say it themselves; BLOCK in other files.
THREADS = {
    "rasterize_opaque.cu": constant("cuda/rasterize_opaque.cu", "kThreads"),
    **dict.fromkeys(("soup_colors.cu", "spherical_harmonics.cu"), constant("cuda/staged_rows.h", "kThreads")),
    "triangle_channels.cu": CHANNELS_THREADS,
    "step.cu": 1,
    "weighted_sum.cu": 1,
}


def block_size(program: Program) -> int:
    """Threads of a block of the program's kernels that have no launch bounds."""
    return THREADS.get(program.file, BLOCK)


def reduction(cameras: int, *values: int) -> Program:
    """What adds up the tile loops' sums, for these definitions of theirs."""
    return Program("raster_reduce.cu", (*tile_loops("", *values)[1:], ("CAMERAS", cameras)))


def tile_loops(kernel: str, *values: int) -> tuple[tuple[str, int | str], ...]:
    """Definitions of csrc/cuda/raster_tile.h: FLAT, CORNER, DISTORTION, MEDIAN, WEIGHTS."""
    names = ("FLAT", "CORNER", "DISTORTION", "MEDIAN", "WEIGHTS")
    return (("KERNEL", kernel), *zip(names, values, strict=True))


PROGRAMS = [
    Program("raster_project.cu"),
    Program("radix_sort.cu"),
    Program("raster_forward.cu", tile_loops("Elastic", 3, 0, 0, 0, 0), flush=True),
    Program("raster_backward.cu", tile_loops("Elastic", 3, 0, 0, 0, 0), flush=True),
    reduction(0, 3, 0, 0, 0, 0),
    Program("fill.cu"),
    *(Program(file, contract=False) for file in ("adam.cu", "antialias.cu", "mesh_energies.cu", "photometric.cu")),
    *(Program(file, contract=False) for file in ("rasterize_opaque.cu", "soup_statistics.cu", "step.cu")),
    *(Program(file, contract=False) for file in ("normal_consistency.cu", "pick_values.cu", "triangle_channels.cu")),
    *(Program(file, contract=False) for file in ("texture.cu", "triangle_area.cu", "weighted_sum.cu")),
    Program("soup_activation.cu"),
    Program("soup_colors.cu", (("DEGREE", 3), ("BASES", 15))),
    Program("spherical_harmonics.cu", (("DEGREE", 3), ("BASES", 16), ("CHANNELS", 3))),
]
# Other definitions of what is compiled above.
VARIANTS = [
    Program("raster_forward.cu", tile_loops("SingleSided", 6, 1, 1, 1, 1), flush=True),
    Program("raster_backward.cu", tile_loops("Bilateral", 16, 0, 2, 0, 0), flush=True),
    Program("raster_backward.cu", tile_loops("Hard", 0, 16, 1, 0, 0), flush=True),
    reduction(1, 3, 0, 0, 0, 0),
    reduction(1, 6, 1, 1, 0, 0),
    *(Program("soup_colors.cu", (("DEGREE", degree), ("BASES", 15))) for degree in range(3)),
    Program("soup_colors.cu", (("DEGREE", 0), ("BASES", 0))),
    Program("spherical_harmonics.cu", (("DEGREE", 0), ("BASES", 16), ("CHANNELS", 48))),
    Program("spherical_harmonics.cu", (("DEGREE", 3), ("BASES", 16), ("CHANNELS", 20))),
    Program("raster_forward.cu", tile_loops("Tabulated", 3, 0, 0, 0, 0), flush=True),
    Program("raster_backward.cu", tile_loops("Tabulated", 3, 0, 0, 0, 0), flush=True),
]
