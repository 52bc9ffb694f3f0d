"""How work that takes long reports how far it is, without knowing what shows it (`report.progress` does)."""

from collections.abc import Callable

Show = Callable[[float, float], None]  # so much is done, of so much; of 0 if that is not known


def unshown(done: float, total: float) -> None:
    """Shows nothing."""
