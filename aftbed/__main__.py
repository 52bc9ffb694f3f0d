"""`python -m aftbed`."""

import sys
from pathlib import Path

if __name__ == "__main__":
    if not sys.flags.safe_path and sys.path[:1] == [str(Path.cwd())]:
        del sys.path[0]  # `-m` puts the working directory there: nothing is imported from it
    from aftbed.cli import main

    main()
