"""Learnable triangles, and posed views with their loaders."""
