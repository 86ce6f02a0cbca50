"""Novel-view synthesis: the paper's numbers, tables and pictures of a grid of scenes."""
