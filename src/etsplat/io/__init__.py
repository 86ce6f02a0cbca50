"""Mesh files, images and the run directory."""
