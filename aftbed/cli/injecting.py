"""`aftbed inject`: a fault for a live run, from a second terminal."""

import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from aftbed.core.fault import on_bus
from aftbed.inject import buswords
from aftbed.inject.words import read
from aftbed.runtime.unix import ask, rundir
from aftbed.runtime.unix.busaim import aim
from aftbed.runtime.unix.options import Work


def send(run: str | None, words: Sequence[str]) -> None:
    """Arm the fault that `words` mean in the run, or strike at once."""
    fault = read(words)
    private = rundir.find(run)
    ask.ask(private, ask.Inject(fault))
    print(f"run {private.name}: {fault}", file=sys.stderr)


class _About(msgspec.Struct, frozen=True):
    """What the record of a run says about it, as far as it is of interest here."""

    work: Work


def send_to_bus(run: str | None, text: str) -> None:
    """The same for a fault of the bus, whose names are those of the run's own messages."""
    fault = on_bus(buswords.parse(text))
    private = rundir.find(run)
    record = Path(str(ask.ask(private, ask.Status())["record"]))
    about = msgspec.json.decode((record / "run.json").read_bytes(), type=_About)
    ask.ask(private, ask.Inject(aim(fault, about.work)))
    print(f"run {private.name}: {fault}", file=sys.stderr)
