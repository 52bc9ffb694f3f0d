"""`aftbed inject`: a fault for a live run, from a second terminal."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.fault import MEMORY, Fault, on_bus
from aftbed.inject import buswords
from aftbed.inject.parts import refuse_unsafe
from aftbed.inject.words import read
from aftbed.runtime.unix import ask, rundir
from aftbed.runtime.unix.busaim import aim
from aftbed.runtime.unix.options import Work

LEVELS: Final = ("value", MEMORY)


def send(run: str | None, words: Sequence[str]) -> None:
    """Arm the fault that `words` mean in the run, or strike at once."""
    _arm(run, read(words))


def send_to_bus(run: str | None, text: str) -> None:
    """The same for a fault of the bus."""
    _arm(run, on_bus(buswords.parse(text)))


class _About(msgspec.Struct, frozen=True):
    """What the record of a run says about it, as far as it is of interest here."""

    work: Work


def _arm(run: str | None, fault: Fault) -> None:
    """Messages and conditions are those of the run's own work: it is asked what that is."""
    private = rundir.find(run)
    record = Path(str(ask.ask(private, ask.Status())["record"]))
    about = msgspec.json.decode((record / "run.json").read_bytes(), type=_About)
    ask.ask(private, ask.Inject(aim(fault, about.work)))
    print(f"run {private.name}: {fault}", file=sys.stderr)


def at_level(level: str, place: str, replica: str | None, *, unsafe: bool) -> tuple[str, str | None]:
    """What a bitflip is of, and where: of memory, the place is the target. Raises ConfigError."""
    if level not in LEVELS:
        raise unknown("level of a bitflip", level, LEVELS)
    if level != MEMORY:
        return place, replica
    if replica is not None:
        raise ConfigError(f"--replica {replica}: with --level {MEMORY} the target is {place!r} already")
    refuse_unsafe(f"--level {MEMORY}", unsafe=unsafe)
    return MEMORY, place
