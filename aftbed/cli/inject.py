"""`aftbed inject`: a fault for a live run, from a second terminal. The words are those of docs/faults.md."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer

from aftbed.cli.options import Run
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.fault import MEMORY, Fault, on_bus
from aftbed.inject import buswords
from aftbed.inject.parts import refuse_unsafe
from aftbed.inject.words import read
from aftbed.runtime.unix import ask, rundir
from aftbed.runtime.unix.busaim import aim
from aftbed.runtime.unix.options import Work

inject = typer.Typer(help="Inject a fault into a live run.", no_args_is_help=True, rich_markup_mode=None)

At = Annotated[str | None, typer.Option("--at", help="Event to strike at, as checkpoint.sent.")]
Nth = Annotated[str | None, typer.Option("--nth", help="Which occurrence of the event, counted from now.")]
NthMessage = Annotated[str | None, typer.Option("--nth", help="Which message, counted from now.")]
After = Annotated[str | None, typer.Option("--after", help="How long from now, as 200ms.")]
When = Annotated[
    str | None,
    typer.Option("--when", help='At a state of the car, as "ttc < 1.2": ttc, gap or speed.'),
]
Target = Annotated[str, typer.Argument(help="primary, backup, or a node as `aftbed ps` names it.")]
Replica = Annotated[str | None, typer.Option("--replica", help="primary (default), backup, a or b.")]
For = Annotated[str | None, typer.Option("--for", help="How long, as 50ms; permanently if left out.")]
Channel = Annotated[str, typer.Argument(help="As `aftbed graph` names it: pxy2pro, aft2aft, ...")]
By = Annotated[str | None, typer.Option("--by", help="How long it is held back, as 5ms; 20ms if left out.")]
Permanent = Annotated[bool, typer.Option("--permanent", help="Each time from the first strike on.")]
Every = Annotated[str | None, typer.Option("--every", help="Each Nth time from the first strike on.")]
Chance = Annotated[str | None, typer.Option("--chance", help="Each time with this chance, as 0.1; seeded.")]

Words = list[tuple[str, str | None]]
LEVELS: Final = ("value", MEMORY)
DRAWN: Final = "drawn"  # in the place of a byte's number: the seed chooses the byte
_COMPARISON: Final = re.compile(r"([<>])")


# -- crash, hang, slow ----------------------------------------------------------------------------


@inject.command()
def crash(
    target: Target, at: At = None, nth: Nth = None, after: After = None, when: When = None, run: Run = None
) -> None:
    """SIGKILL the target's processes."""
    _send(run, "crash", target, _trigger(at, nth, after, when))


@inject.command()
def hang(
    target: Target,
    duration: For = None,
    at: At = None,
    nth: Nth = None,
    after: After = None,
    when: When = None,
    run: Run = None,
) -> None:
    """SIGSTOP the target's processes, and SIGCONT them after a while."""
    _send(run, "hang", target, [("for", duration), *_trigger(at, nth, after, when)])


@inject.command()
def slow(
    target: Target,
    by: Annotated[
        str | None, typer.Option("--by", help="How much longer each step takes; 2ms if left out.")
    ] = None,
    share: Annotated[
        str | None, typer.Option("--share", help="Or: as if it had this share of a CPU, as 25%.")
    ] = None,
    duration: For = None,
    at: At = None,
    nth: Nth = None,
    after: After = None,
    when: When = None,
    run: Run = None,
) -> None:
    """Make each step of the target's bricks take longer."""
    words: Words = [("by", by), ("share", share), ("for", duration)]
    _send(run, "slow", target, [*words, *_trigger(at, nth, after, when)])


# -- faults of a channel --------------------------------------------------------------------------


def _without_delay(kind: str, about: str) -> None:
    """Define the command of a fault of a channel that has no delay."""

    @inject.command(kind, help=about)
    def strike(
        channel: Channel,
        replica: Replica = None,
        nth: NthMessage = None,
        after: After = None,
        when: When = None,
        permanent: Permanent = False,
        every: Every = None,
        chance: Chance = None,
        run: Run = None,
    ) -> None:
        words = [("in", replica), *_trigger(None, nth, after, when)]
        _send(run, kind, channel, words, _persistence(permanent, every, chance))


def _with_delay(kind: str, about: str) -> None:
    """Define the command of a fault of a channel that holds messages back."""

    @inject.command(kind, help=about)
    def strike(
        channel: Channel,
        by: By = None,
        replica: Replica = None,
        nth: NthMessage = None,
        after: After = None,
        when: When = None,
        permanent: Permanent = False,
        every: Every = None,
        chance: Chance = None,
        run: Run = None,
    ) -> None:
        words = [("by", by), ("in", replica), *_trigger(None, nth, after, when)]
        _send(run, kind, channel, words, _persistence(permanent, every, chance))


_without_delay("omission", "Lose a message.")
_with_delay("delay", "Hold a message back, and those behind it.")
_without_delay("duplicate", "Send a message twice.")
_with_delay("reorder", "Send a message after its successor, or late if none comes.")


# -- bitflip, bus ---------------------------------------------------------------------------------


@inject.command()
def bitflip(
    place: Annotated[
        str,
        typer.Argument(
            help="result, state, state.FIELD, request, checkpoint or log; with --level memory, the target."
        ),
    ],
    bit: Annotated[
        str | None, typer.Option("--bit", help="From bit 0 of byte 0; drawn by the seed if left out.")
    ] = None,
    bits: Annotated[str | None, typer.Option("--bits", help="So many different bits, drawn.")] = None,
    byte: Annotated[str | None, typer.Option("--byte", help="All of this byte, or of a `drawn` one.")] = None,
    burst: Annotated[
        str | None, typer.Option("--burst", help="So many bits side by side, from --bit on.")
    ] = None,
    stuck: Annotated[str | None, typer.Option("--stuck", help="A bit and its value, as 60=1.")] = None,
    level: Annotated[str, typer.Option("--level", help="value, or memory: any byte of a process.")] = "value",
    address: Annotated[
        str | None,
        typer.Option(
            "--address", help="With --level memory: address of the byte, as 0x7f00; drawn if left out."
        ),
    ] = None,
    unsafe_memory: Annotated[
        bool,
        typer.Option("--unsafe-memory", help="Allow --level memory, which may have any consequence."),
    ] = False,
    replica: Replica = None,
    at: Annotated[str | None, typer.Option("--at", help="Event at which the brick holds the value.")] = None,
    nth: Nth = None,
    after: After = None,
    when: When = None,
    permanent: Permanent = False,
    every: Every = None,
    chance: Chance = None,
    run: Run = None,
) -> None:
    """Flip bits of a request, a result, the state, a checkpoint, a reply in the log, or memory."""
    what, target = _at_level(level, place, replica, unsafe=unsafe_memory)
    words: Words = [("bit", bit), ("bits", bits), ("burst", burst), ("stuck", stuck), ("address", address)]
    which = [] if byte is None else ["byte"] if byte == DRAWN else ["byte", byte]
    words += [("in", target), *_trigger(at, nth, after, when)]
    _send(run, "bitflip", what, words, [*which, *_persistence(permanent, every, chance)])


def _at_level(level: str, place: str, replica: str | None, *, unsafe: bool) -> tuple[str, str | None]:
    """What is flipped, and in which target; at the level of memory, `place` is the target."""
    if level not in LEVELS:
        raise unknown("level of a bitflip", level, LEVELS)
    if level != MEMORY:
        return place, replica
    if replica is not None:
        raise ConfigError(f"--replica {replica}: with --level {MEMORY} the target is {place!r} already")
    refuse_unsafe(f"--level {MEMORY}", unsafe=unsafe)
    return MEMORY, place


@inject.command()
def bus(
    words: Annotated[str, typer.Argument(help='E.g. "omission bus RADAR_TRACK for 200ms": docs/faults.md.')],
    run: Run = None,
) -> None:
    """Disturb frames on the CAN bus, or disconnect nodes from it."""
    _arm(run, on_bus(buswords.parse(words)))


# -- options to words, words to the run -----------------------------------------------------------


def _trigger(at: str | None, nth: str | None, after: str | None, when: str | None) -> Words:
    return [("at", at), ("nth", nth), ("after", after), ("when", when)]


def _persistence(permanent: bool, every: str | None, chance: str | None) -> list[str]:
    found = ["permanent"] if permanent else []
    for key, value in (("every", every), ("p", chance)):
        found += ["intermittent", key, value] if value is not None else []
    return found


def _send(run: str | None, kind: str, what: str, options: Words, others: Sequence[str] = ()) -> None:
    words = [word for key, value in options if value is not None for word in (key, *_values(key, value))]
    _arm(run, read([kind, what, *words, *others]))


def _values(key: str, value: str) -> list[str]:
    """The words of an option's value; a condition is three words, with or without spaces."""
    return _COMPARISON.sub(r" \1 ", value).split() if key == "when" else [value]


class _RecordHead(msgspec.Struct, frozen=True):
    """The part of a record's run.json that is needed here."""

    work: Work


def _arm(run: str | None, fault: Fault) -> None:
    """Have the run arm the fault. The messages and signals it may name are those of the run's work."""
    private = rundir.find(run)
    record = Path(str(ask.ask(private, ask.Status())["record"]))
    head = msgspec.json.decode((record / "run.json").read_bytes(), type=_RecordHead)
    ask.ask(private, ask.Inject(aim(fault, head.work)))
    print(f"run {private.name}: {fault}", file=sys.stderr)
