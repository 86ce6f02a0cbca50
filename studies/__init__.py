"""The paper's studies, as users of etsplat: grids of runs with tables and figures at the end, and drawings.

`python -m studies` lists them. They are not part of the package: they run in a checkout.
"""
