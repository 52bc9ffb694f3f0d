"""`python -m aftbed`."""

import sys

if __name__ == "__main__":
    if not sys.flags.safe_path:
        del sys.path[0]  # `-m` puts the working directory there: nothing is imported from it
    from aftbed.cli import main

    main()
