"""Real runs of the benches have the same homes as in `tests/process`."""

from liveruns import home

__all__ = ["home"]
