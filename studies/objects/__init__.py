"""Shape reconstruction: the paper's numbers, tables and pictures of a grid of meshes."""
