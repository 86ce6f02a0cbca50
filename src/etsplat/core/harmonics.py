"""Sizes of spherical harmonics."""

MAX_DEGREE = 3
MAX_REST = (MAX_DEGREE + 1) ** 2 - 1
"""Coefficients beside the constant one."""
