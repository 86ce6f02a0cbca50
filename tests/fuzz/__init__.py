"""Odd input for every reader and every public operation: `python -m tests.fuzz --help`, `make fuzz`, `make fuzz-short`.

    mutate.py      files with some bytes, words or numbers changed
    corpus.py      the files that are changed, made in code
    readers.py     one target for each reader
    arguments.py   odd tensors and numbers
    operations.py  one target for each public operation
    planted.py     targets with defects, which every session must find
    session.py     workers with bounds on time and memory, and what is told of them

Input k of a target depends on the seed, the target's name and k alone.
"""
