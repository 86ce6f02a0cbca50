"""Posed photos and the points seen in them: loaders, captures, pictures of a mesh, what is built in code."""
