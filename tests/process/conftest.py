"""Every test here has a home of its own, in which nothing may be left."""

from liveruns import home

__all__ = ["home"]
