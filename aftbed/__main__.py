"""`python -m aftbed`."""

from aftbed.cli import main

main()
