"""Exported GLB files as other programs show them."""
