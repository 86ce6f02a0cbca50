"""Two trees of this repository run the same command lines on one machine, and must end with the same bits.

    python -m tests.equal_bits --base COMMIT

`cases` says what is run, `names` what has another name in this tree than in the other, `trees` builds the other one,
`runner` is the script that runs in both, `compare` finds the first bit that differs.
"""
