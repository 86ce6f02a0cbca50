"""Numbers of spherical harmonics."""

from etsplat import _native

MAX_DEGREE = _native.MAX_SH_DEGREE
MAX_REST = (MAX_DEGREE + 1) ** 2 - 1
"""Coefficients beside the constant one."""
SH_CONSTANT = 0.28209479177387814
"""The constant basis function Y_0: a colour c is the coefficient (c - 1/2) / Y_0."""
