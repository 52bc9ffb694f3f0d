"""aftbed: a testbed for Adaptive Fault Tolerance on real processes and a real CAN bus.

After M. Amy, *Adaptive Fault Tolerance: Is ROS a Relevant Executive Support?* (DSN 2016).
"""

if not __debug__:  # fail-silence rests on asserts: without them a broken node goes on talking
    import sys

    print("aftbed: error: refusing to run under python -O: its fault model needs assert", file=sys.stderr)
    raise SystemExit(2)

__version__ = "0.1.0"
