"""Runs that are killed, run out of disk, see their clock move, or meet a second process: `make soak`.

Whatever happened, in the end the folder holds what an undisturbed run leaves, byte by byte. Left out is what holds
times: `report.html` and `convergence.png` whole, of the others the numbers that are times (`TIMES` in `digests.py`).
"""
