"""The command line: parses, prints, and maps a verdict to an exit code."""

import sys

from aftbed.cli.app import app
from aftbed.core.errors import ConfigError, HarnessError, PeerError


def main() -> None:
    """The console script `aftbed`."""
    try:
        app()
    except ConfigError as error:
        print(f"aftbed: error: {error}", file=sys.stderr)
        sys.exit(2)
    except (HarnessError, PeerError) as error:
        print(f"aftbed: trouble: {error}", file=sys.stderr)
        sys.exit(3)
