"""Sizes of spherical harmonics."""

from etsplat import _native

MAX_DEGREE = _native.MAX_SH_DEGREE
MAX_REST = (MAX_DEGREE + 1) ** 2 - 1
"""Coefficients beside the constant one."""
