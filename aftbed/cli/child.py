"""`python -m aftbed.cli.child PID ARGUMENTS`: `aftbed ARGUMENTS` for the program PID, with which it dies."""

import sys

from aftbed.cli import main
from aftbed.runtime.unix import linux

if __name__ == "__main__":
    linux.die_with(int(sys.argv.pop(1)))
    main()
