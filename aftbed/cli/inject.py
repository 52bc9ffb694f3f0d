"""`aftbed inject`: a fault for a live run, from a second terminal. The words are those of docs/faults.md."""

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import msgspec
import typer
from msgspec.structs import asdict, replace

from aftbed.cli.options import Json, Run, choices, print_json, takes
from aftbed.cli.parsing import PlainGroup
from aftbed.core.errors import ConfigError, unknown
from aftbed.inject.bus import read_bus_fault
from aftbed.inject.memory import refuse_unsafe
from aftbed.inject.model import SYNONYMS, Fault, on_bus, parse, read
from aftbed.inject.radar import EFFECTS, RADAR
from aftbed.inject.value import MEMORY
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.options import Work, with_names_resolved


class InjectGroup(PlainGroup):
    """Takes the words of a fault as one argument too, as `run --inject` does."""

    MEANT: ClassVar[Mapping[str, str]] = SYNONYMS
    WHOLE = "fault"  # the command that takes them

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        whole = args and " " in args[0]
        return super().parse_args(ctx, [self.WHOLE, *args] if whole else args)


inject = typer.Typer(cls=InjectGroup)

LEVELS: Final = ("value", MEMORY)
DRAWN: Final = "drawn"  # in the place of a byte's number: the seed chooses the byte
# The word of a fault for each option, in the order in which they are sent.
WORDS: Final = {
    "range": "range",
    "speed": "speed",
    "by": "by",
    "angle": "angle",
    "share": "share",
    "duration": "for",
    "bit": "bit",
    "bits": "bits",
    "burst": "burst",
    "stuck": "stuck",
    "address": "address",
    "replica": "in",
    "at": "at",
    "nth": "nth",
    "after": "after",
    "when": "when",
}
_COMPARISON: Final = re.compile(r"([<>])")

At = Annotated[str | None, typer.Option(help="Event to strike at, as checkpoint.sent.")]
Nth = Annotated[str | None, typer.Option(help="Which occurrence of the event, counted from now.")]
After = Annotated[str | None, typer.Option(help="How long from now, as 200ms.")]
When = Annotated[str | None, typer.Option(help='At a state of the car, as "ttc < 1.2": ttc, gap or speed.')]
Replica = Annotated[str | None, typer.Option(metavar="<primary|backup|a|b>", help="primary if left out.")]
Permanent = Annotated[bool, typer.Option("--permanent", help="Each time from the first strike on.")]
Every = Annotated[str | None, typer.Option(help="Each Nth time from the first strike on.")]
Chance = Annotated[str | None, typer.Option(help="Each time with this chance, as 0.1; seeded.")]


# -- crash, hang, slow ----------------------------------------------------------------------------


class CrashArguments(msgspec.Struct, frozen=True, kw_only=True):
    """The options of `aftbed inject crash`; those of hang and slow are more."""

    target: Annotated[str, typer.Argument(help="primary, backup, or a node as `aftbed ps` names it.")]
    at: At = None
    nth: Nth = None
    after: After = None
    when: When = None
    run: Run = None
    json: Json = False


class HangArguments(CrashArguments, frozen=True, kw_only=True):
    """The options of `aftbed inject hang`."""

    duration: Annotated[
        str | None, typer.Option("--for", help="How long, as 50ms; permanently if left out.")
    ] = None


class SlowArguments(HangArguments, frozen=True, kw_only=True):
    """The options of `aftbed inject slow`."""

    by: Annotated[str | None, typer.Option(help="How much longer each step takes; 2ms if left out.")] = None
    share: Annotated[str | None, typer.Option(help="Or: as if it had this share of a CPU, as 25%.")] = None


# -- faults of a channel --------------------------------------------------------------------------


class ChannelArguments(msgspec.Struct, frozen=True, kw_only=True):
    """The options of a fault of a channel."""

    channel: Annotated[str, typer.Argument(help="As `aftbed graph` names it: pxy2pro, aft2aft, ...")]
    replica: Replica = None
    nth: Annotated[str | None, typer.Option(help="Which message, counted from now.")] = None
    after: After = None
    when: When = None
    permanent: Permanent = False
    every: Every = None
    chance: Chance = None
    run: Run = None
    json: Json = False


class DelayArguments(ChannelArguments, frozen=True, kw_only=True):
    """The options of a fault that holds messages back."""

    by: Annotated[str | None, typer.Option(help="How long it is held back, as 5ms; 20ms if left out.")] = None


# -- bitflip, bus ---------------------------------------------------------------------------------


class BitflipArguments(msgspec.Struct, frozen=True, kw_only=True):
    """The options of `aftbed inject bitflip`."""

    place: Annotated[
        str,
        typer.Argument(
            help="result, state, state.FIELD, request, checkpoint or log; with --level memory, the target."
        ),
    ]
    bit: Annotated[str | None, typer.Option(help="From bit 0 of byte 0; drawn by the seed if left out.")] = (
        None
    )
    bits: Annotated[str | None, typer.Option(help="So many different bits, drawn.")] = None
    byte: Annotated[str | None, typer.Option(help="All of this byte, or of a `drawn` one.")] = None
    burst: Annotated[str | None, typer.Option(help="So many bits side by side, from --bit on.")] = None
    stuck: Annotated[str | None, typer.Option(help="A bit and its value, as 60=1.")] = None
    level: Annotated[
        str, typer.Option(metavar=choices(LEVELS), help="value, or memory: any byte of a process.")
    ] = "value"
    address: Annotated[
        str | None,
        typer.Option(help="With --level memory: address of the byte, as 0x7f00; drawn if left out."),
    ] = None
    unsafe_memory: Annotated[
        bool,
        typer.Option("--unsafe-memory", help="Allow --level memory, which may have any consequence."),
    ] = False
    replica: Replica = None
    at: Annotated[str | None, typer.Option(help="Event at which the brick holds the value.")] = None
    nth: Nth = None
    after: After = None
    when: When = None
    permanent: Permanent = False
    every: Every = None
    chance: Chance = None
    run: Run = None
    json: Json = False


def _command(kind: str, arguments: type[CrashArguments] | type[ChannelArguments], about: str) -> None:
    """A command whose only argument is what is hit."""

    @inject.command(kind, help=about)
    @takes(arguments)
    def strike(given: CrashArguments | ChannelArguments) -> None:
        subject = given.target if isinstance(given, CrashArguments) else given.channel
        _arm(given.run, read([kind, subject, *_words(given)]), as_json=given.json)


_command("crash", CrashArguments, "SIGKILL the target's processes.")
_command("hang", HangArguments, "SIGSTOP the target's processes, and SIGCONT them after a while.")
_command("slow", SlowArguments, "Make each step of the target's bricks take longer.")
_command("omission", ChannelArguments, "Lose a message.")
_command("delay", DelayArguments, "Hold a message back, and those behind it.")
_command("duplicate", ChannelArguments, "Send a message twice.")
_command("reorder", DelayArguments, "Send a message after its successor, or late if none comes.")


@inject.command()
@takes(BitflipArguments)
def bitflip(given: BitflipArguments) -> None:
    """Flip bits of a request, a result, the state, a checkpoint, a reply in the log, or memory."""
    what = given.place
    if given.level not in LEVELS:
        raise unknown("level of a bitflip", given.level, LEVELS)
    if given.level == MEMORY:  # then the place is the target
        if given.replica is not None:
            raise ConfigError(
                f"--replica {given.replica}: with --level {MEMORY} the target is {given.place!r} already"
            )
        refuse_unsafe(f"--level {MEMORY}", agreed=given.unsafe_memory)
        what, given = MEMORY, replace(given, replica=given.place)
    byte = [] if given.byte is None else ["byte"] if given.byte == DRAWN else ["byte", given.byte]
    _arm(given.run, read(["bitflip", what, *_words(given, byte)]), as_json=given.json)


@inject.command()
def fault(
    words: Annotated[str, typer.Argument(help='E.g. "crash primary at server.exit nth 3".')],
    unsafe_memory: Annotated[
        bool, typer.Option("--unsafe-memory", help='Allow "bitflip memory ...".')
    ] = False,
    run: Run = None,
    json: Json = False,
) -> None:
    """Any fault in the words of `run --inject`; the word `fault` itself may be left out."""
    found = parse(words)
    if found.action.unsafe:
        refuse_unsafe(str(found), agreed=unsafe_memory)
    _arm(run, found, as_json=json)


@inject.command()
def bus(
    words: Annotated[str, typer.Argument(help='E.g. "omission bus RADAR_TRACK for 200ms": docs/faults.md.')],
    run: Run = None,
    json: Json = False,
) -> None:
    """Disturb frames on the CAN bus, or disconnect nodes from it."""
    _arm(run, on_bus(read_bus_fault(words)), as_json=json)


class RadarArguments(msgspec.Struct, frozen=True, kw_only=True):
    """The options of a fault of the radar, which may be given as words as well: `for 200ms`."""

    words: Annotated[
        tuple[str, ...],
        typer.Argument(help=f"{', '.join(EFFECTS)}; then any of its words, as in `run --inject`."),
    ]
    range: Annotated[str | None, typer.Option(help="In m: where the ghost is; how far it sees.")] = None
    speed: Annotated[str | None, typer.Option(help="In m/s: at which the ghost closes.")] = None
    by: Annotated[str | None, typer.Option(help="bias: in m, as -5; drift: in m/s; latency: as 100ms.")] = (
        None
    )
    angle: Annotated[str | None, typer.Option(help="In degrees: the whole field of view.")] = None
    duration: Annotated[str | None, typer.Option("--for", help="How long; for good if left out.")] = None
    after: After = None
    when: When = None
    permanent: Permanent = False
    every: Every = None
    chance: Chance = None
    run: Run = None
    json: Json = False


@inject.command()
@takes(RadarArguments)
def radar(given: RadarArguments) -> None:
    """Make the car's radar report what is not so: docs/faults.md."""
    _arm(given.run, read([RADAR, *given.words, *_words(given)]), as_json=given.json)


# -- options to words, words to the run -----------------------------------------------------------


def _words(given: msgspec.Struct, others: Sequence[str] = ()) -> list[str]:
    """The words of the options that are given, and `others` before those for how it is repeated."""
    options, found = asdict(given), list[str]()
    for option, word in WORDS.items():
        value = options.get(option)
        if value is not None:  # a condition is three words, with or without spaces
            found += [word, *(_COMPARISON.sub(r" \1 ", value).split() if word == "when" else [value])]
    found += [*others, *(["permanent"] if options.get("permanent") else [])]
    for key, option in (("every", "every"), ("p", "chance")):
        if options.get(option) is not None:
            found += ["intermittent", key, options[option]]
    return found


class _RecordHead(msgspec.Struct, frozen=True):
    """The part of a record's run.json that is needed here."""

    work: Work


def _arm(run: str | None, fault: Fault, *, as_json: bool) -> None:
    """Have the run arm the fault. The messages and signals it may name are those of the run's work."""
    private = run_directory.find(run)
    record = Path(str(control_client.ask(private, control_client.StatusQuery())["record"]))
    head = msgspec.json.decode((record / "run.json").read_bytes(), type=_RecordHead)
    control_client.ask(private, control_client.InjectCommand(with_names_resolved(fault, head.work)))
    if as_json:
        print_json({"run": private.name, "fault": str(fault)})
    else:
        print(f"run {private.name}: {fault}", file=sys.stderr)
