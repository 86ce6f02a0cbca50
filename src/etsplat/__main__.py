"""`python -m etsplat`, as torchrun starts it."""

from etsplat.cli import main

main()
