"""Private directories of runs, for tests that make them without a run."""

from pathlib import Path

from aftbed.runtime.unix import run_directory


def new_run() -> Path:
    """A new private directory; its name is the id of the run."""
    path = run_directory.free()
    run_directory.make(path)
    return path
