"""Learnable triangles: a mesh, a soup, how they are drawn, where they start, and their files."""
