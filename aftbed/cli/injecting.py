"""`aftbed inject`: a fault for a live run, from a second terminal."""

import sys

from aftbed.core.fault import Act, Fault
from aftbed.inject.words import build, build_flip
from aftbed.runtime.unix import ask, rundir


def strike(
    run: str | None,
    act: str,
    target: str,
    duration: str | None,
    event: str | None,
    nth: str | None,
    after: str | None,
) -> None:
    """Arm a crash or a hang in the run, or strike at once."""
    _send(run, build(Act(act), target, duration, event, nth, after))


def flip(
    run: str | None,
    place: str,
    bit: str | None,
    replica: str | None,
    event: str | None,
    nth: str | None,
    after: str | None,
) -> None:
    """Arm a bitflip in the run."""
    _send(run, build_flip(place, bit, replica, event, nth, after))


def _send(run: str | None, fault: Fault) -> None:
    private = rundir.find(run)
    ask.ask(private, ask.Inject(fault))
    print(f"run {private.name}: {fault}", file=sys.stderr)
