"""The paper's studies as grids of runs, with tables and figures at the end."""
