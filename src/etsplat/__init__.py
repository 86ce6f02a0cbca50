"""Differentiable triangle splatting: posed images in, triangles out."""
