"""aftbed: a testbed for Adaptive Fault Tolerance on real processes and a real CAN bus.

After M. Amy, *Adaptive Fault Tolerance: Is ROS a Relevant Executive Support?* (DSN 2016).

For other programs: `run`, `explore_crashes` (`aftbed.api`), and what the author of a function needs. They
are imported when they are used: every process of a run imports this package.
"""

if not __debug__:  # fail-silence rests on asserts: without them a broken node goes on talking
    import sys

    print("aftbed: error: refusing to run under python -O: its fault model needs assert", file=sys.stderr)
    raise SystemExit(2)

TYPE_CHECKING = False  # that of typing, which is not imported for it
if TYPE_CHECKING:
    from aftbed.api import RunReport, explore_crashes, run
    from aftbed.core.application import EXACT, NONE, Application, Characteristics, Field, approximate
    from aftbed.core.errors import ConfigError, HarnessError, PeerError
    from aftbed.search.explore import Explored

__version__ = "0.1.0"
__all__ = [
    "EXACT",
    "NONE",
    "Application",
    "Characteristics",
    "ConfigError",
    "Explored",
    "Field",
    "HarnessError",
    "PeerError",
    "RunReport",
    "approximate",
    "explore_crashes",
    "run",
]
_HOMES = {
    "aftbed.api": ("RunReport", "explore_crashes", "run"),
    "aftbed.core.application": (
        *("EXACT", "NONE", "Application", "Characteristics", "Field", "approximate"),
    ),
    "aftbed.core.errors": ("ConfigError", "HarnessError", "PeerError"),
    "aftbed.search.explore": ("Explored",),
}

if not TYPE_CHECKING:  # a type checker would take any name for one of ours

    def __getattr__(name: str) -> object:
        from importlib import import_module  # noqa: PLC0415 - not in a node

        for home, names in _HOMES.items():
            if name in names:
                return getattr(import_module(home), name)
        raise AttributeError(f"module 'aftbed' has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
