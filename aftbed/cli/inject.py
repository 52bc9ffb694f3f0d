"""`aftbed inject`: the faults, each with its options. What they mean is said in `docs/faults.md`."""

import re
from typing import Annotated, Final

import typer

inject = typer.Typer(help="Inject a fault into a live run.", no_args_is_help=True, rich_markup_mode=None)

Run = Annotated[str | None, typer.Option("--run", help="Id of the run, where several are alive.")]
At = Annotated[str | None, typer.Option("--at", help="Event to strike at, as checkpoint.sent.")]
Nth = Annotated[str | None, typer.Option("--nth", help="Which occurrence of the event, counted from now.")]
NthMessage = Annotated[str | None, typer.Option("--nth", help="Which message, counted from now.")]
After = Annotated[str | None, typer.Option("--after", help="How long from now, as 200ms.")]
When = Annotated[
    str | None, typer.Option("--when", help='When the car is so, as "ttc < 1.2": ttc, gap or speed.')
]
Target = Annotated[str, typer.Argument(help="primary, backup, or a node as `aftbed ps` names it.")]
Replica = Annotated[str | None, typer.Option("--replica", help="primary (default), backup, a or b.")]
For = Annotated[str | None, typer.Option("--for", help="How long, as 50ms; else for good.")]
Channel = Annotated[str, typer.Argument(help="As `aftbed graph` names it: pxy2pro, aft2aft, ...")]
By = Annotated[str | None, typer.Option("--by", help="How long it is held back, as 5ms; 20ms if left out.")]
Permanent = Annotated[bool, typer.Option("--permanent", help="Each time from the first strike on.")]
Every = Annotated[str | None, typer.Option("--every", help="Each Nth time from the first strike on.")]
Chance = Annotated[str | None, typer.Option("--chance", help="Each time with this chance, as 0.1; seeded.")]

Words = list[tuple[str, str | None]]
DRAWN: Final = "drawn"  # the word for a byte that is left to the seed
_COMPARED: Final = re.compile(r"([<>])")


def _send(run: str | None, kind: str, what: str, words: Words, again: list[str] | None = None) -> None:
    from aftbed.cli import injecting  # noqa: PLC0415

    told = [word for key, value in words if value is not None for word in (key, *_values(key, value))]
    injecting.send(run, [kind, what, *told, *(again or [])])


def _values(key: str, value: str) -> list[str]:
    """A condition is three words, however it is written."""
    return _COMPARED.sub(r" \1 ", value).split() if key == "when" else [value]


def _when(at: str | None, nth: str | None, after: str | None, when: str | None) -> Words:
    return [("at", at), ("nth", nth), ("after", after), ("when", when)]


def _again(permanent: bool, every: str | None, chance: str | None) -> list[str]:
    found = ["permanent"] if permanent else []
    for key, value in (("every", every), ("p", chance)):
        found += ["intermittent", key, value] if value is not None else []
    return found


@inject.command()
def crash(
    target: Target, at: At = None, nth: Nth = None, after: After = None, when: When = None, run: Run = None
) -> None:
    """SIGKILL the target's processes."""
    _send(run, "crash", target, _when(at, nth, after, when))


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
    _send(run, "hang", target, [("for", duration), *_when(at, nth, after, when)])


@inject.command()
def slow(
    target: Target,
    by: Annotated[str | None, typer.Option("--by", help="How much longer each takes; else 2ms.")] = None,
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
    """Have each step of the target's bricks take longer."""
    words: Words = [("by", by), ("share", share), ("for", duration)]
    _send(run, "slow", target, [*words, *_when(at, nth, after, when)])


def _at_once(kind: str, about: str) -> None:
    """The command of a fault of a channel that holds nothing back."""

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
        words = [("in", replica), *_when(None, nth, after, when)]
        _send(run, kind, channel, words, _again(permanent, every, chance))


def _held_back(kind: str, about: str) -> None:
    """The command of one that holds messages back."""

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
        words = [("by", by), ("in", replica), *_when(None, nth, after, when)]
        _send(run, kind, channel, words, _again(permanent, every, chance))


_at_once("omission", "Lose a message.")
_held_back("delay", "Hold a message back, and what comes behind it.")
_at_once("duplicate", "Send a message twice.")
_held_back("reorder", "Send a message behind its successor, or late, if none comes.")


@inject.command()
def bitflip(
    place: Annotated[
        str,
        typer.Argument(
            help="result, state, state.FIELD, request, checkpoint or log; of --level memory, the target."
        ),
    ],
    bit: Annotated[
        str | None, typer.Option("--bit", help="From bit 0 of byte 0; else drawn by the seed.")
    ] = None,
    bits: Annotated[str | None, typer.Option("--bits", help="So many different bits, drawn.")] = None,
    byte: Annotated[str | None, typer.Option("--byte", help="All of this byte, or of a `drawn` one.")] = None,
    burst: Annotated[
        str | None, typer.Option("--burst", help="So many bits side by side, from --bit on.")
    ] = None,
    stuck: Annotated[str | None, typer.Option("--stuck", help="A bit and its value, as 60=1.")] = None,
    level: Annotated[
        str, typer.Option("--level", help="value, or memory: any byte of a process, whatever it holds.")
    ] = "value",
    address: Annotated[
        str | None, typer.Option("--address", help="With --level memory: of the byte, as 0x7f00; else drawn.")
    ] = None,
    unsafe_memory: Annotated[
        bool, typer.Option("--unsafe-memory", help="What --level memory does may have any consequence.")
    ] = False,
    replica: Replica = None,
    at: Annotated[str | None, typer.Option("--at", help="Event at which the value is in hand.")] = None,
    nth: Nth = None,
    after: After = None,
    when: When = None,
    permanent: Permanent = False,
    every: Every = None,
    chance: Chance = None,
    run: Run = None,
) -> None:
    """Flip bits of what the function gets, answers or remembers, of a checkpoint, a kept reply, or memory."""
    from aftbed.cli.injecting import at_level  # noqa: PLC0415

    what, target = at_level(level, place, replica, unsafe=unsafe_memory)
    words: Words = [("bit", bit), ("bits", bits), ("burst", burst), ("stuck", stuck), ("address", address)]
    again = _again(permanent, every, chance)
    which = [] if byte is None else ["byte"] if byte == DRAWN else ["byte", byte]
    words += [("in", target), *_when(at, nth, after, when)]
    _send(run, "bitflip", what, words, [*which, *again])


@inject.command()
def bus(
    words: Annotated[str, typer.Argument(help='E.g. "omission bus RADAR_TRACK for 200ms": docs/faults.md.')],
    run: Run = None,
) -> None:
    """Disturb frames on the CAN bus, or cut nodes off it."""
    from aftbed.cli import injecting  # noqa: PLC0415

    injecting.send_to_bus(run, words)
