"""The command line: parses, prints, and turns a verdict into an exit code. Imports lazily."""

import sys


def main() -> None:
    """The console script `aftbed`."""
    from aftbed.cli.app import app  # noqa: PLC0415 - typer costs 40 ms
    from aftbed.core.errors import ConfigError, HarnessError, PeerError  # noqa: PLC0415

    try:
        app()
    except ConfigError as error:
        print(f"aftbed: error: {error}", file=sys.stderr)
        sys.exit(2)
    except (HarnessError, PeerError) as error:
        print(f"aftbed: trouble: {error}", file=sys.stderr)
        sys.exit(3)
