"""The numbers that the paper prints, to stand beside ours ("Elastic Triangle Splatting", arXiv version of 2026).

Its Chamfer distances are squared, two-sided and times 1000, as ours are (docs/conventions.md), at 30,000 iterations,
1024 x 1024 and 100,000 faces. "Ours" is the elastic kernel, "2DTS" the bilateral, "TS" the single-sided one.
"""

COLUMNS = (
    "raster-face",
    "raster-vertex",
    "single-sided 0.001",
    "bilateral 0.001",
    "elastic 0.001",
    "single-sided 0.0001",
    "bilateral 0.0001",
    "elastic 0.0001",
)
"""Variants as `bench.variants` names them, in the order of table famous_cd."""

_CHAMFER = {
    "armadillo": (0.14, 0.061, 1.649, 0.084, 0.079, 7.789, 0.079, 0.077),
    "boot": (1.515, 0.082, 0.601, 0.631, 0.192, 2.373, 0.174, 0.129),
    "brucewick": (3.463, 2.146, 11.177, 2.393, 2.613, 7.474, 2.381, 2.453),
    "bunny_hr": (0.782, 0.047, 2.362, 0.15, 0.066, 4.548, 0.072, 0.064),
    "cat-low-resolution": (0.571, 0.05, 0.713, 0.436, 0.059, 1.123, 0.121, 0.056),
    "cow-low-resolution": (0.29, 0.085, 0.916, 0.161, 0.102, 1.185, 0.104, 0.091),
    "demosthenes": (1.982, 0.459, 1.509, 0.611, 0.559, 10.867, 0.273, 0.304),
    "falconstatue": (1.194, 0.338, 1.495, 0.489, 0.878, 4.228, 0.402, 0.564),
    "goathead": (0.591, 0.307, 2.565, 0.414, 0.331, 1.166, 0.333, 0.323),
    "hand_closed": (0.226, 0.094, 1.066, 0.21, 0.16, 4.661, 0.149, 0.141),
    "house": (12.41, 4.623, 7.605, 6.576, 5.638, 10.018, 5.468, 5.488),
    "human_neutral": (0.433, 0.069, 0.307, 0.325, 0.079, 0.148, 0.086, 0.075),
    "koala": (0.167, 0.051, 1.928, 0.142, 0.058, 5.58, 0.059, 0.057),
    "mushroom": (1.803, 0.061, 0.545, 0.433, 0.072, 2.285, 0.071, 0.067),
    "nefertiti-lowres": (0.102, 0.055, 1.429, 0.091, 0.101, 5.715, 0.079, 0.099),
    "scorpion": (0.119, 0.048, 0.585, 0.132, 0.077, 6.433, 0.074, 0.076),
    "skull": (7.675, 0.145, 7.286, 2.972, 0.548, 14.062, 1.062, 0.762),
    "springer": (2.242, 0.545, 3.133, 1.764, 2.519, 6.88, 1.074, 0.871),
    "strawberry": (0.502, 0.051, 12.486, 0.118, 0.069, 0.492, 0.076, 0.069),
    "stuffedtoy": (0.546, 0.232, 2.251, 0.355, 0.303, 11.103, 0.268, 0.25),
    "tree_closed": (0.53, 0.305, 1.165, 0.957, 0.549, 4.624, 0.554, 0.545),
}

OBJECTS = tuple(_CHAMFER)
"""The 21 objects of FAMOUS that the paper uses, by the names of their files."""

SUMMARY = {
    "raster-face": (35.99, 0.983, 0.031, 1.775),
    "raster-vertex": (40.95, 0.995, 0.008, 0.469),
    "single-sided 0.001": (37.15, 0.983, 0.040, 2.989),
    "bilateral 0.001": (38.43, 0.987, 0.038, 0.926),
    "elastic 0.001": (40.67, 0.991, 0.023, 0.717),
    "single-sided 0.0001": (29.06, 0.958, 0.068, 5.369),
    "bilateral 0.0001": (40.13, 0.989, 0.034, 0.617),
    "elastic 0.0001": (40.90, 0.991, 0.023, 0.598),
}
"""Table famous: PSNR, SSIM, LPIPS and Chamfer distance, means over the 21 objects."""


def paper_chamfer(name: str, variant: str) -> float | None:
    """What table famous_cd says, times 1000; None where it says nothing."""
    row = _CHAMFER.get(name)
    return row[COLUMNS.index(variant)] if row is not None and variant in COLUMNS else None
