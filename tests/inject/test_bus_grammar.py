"""The words of a fault of the bus: every fault reads back; what is typed is a fault or a clear refusal."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.inject.bus import (
    Babble,
    BusFault,
    BusOff,
    Delay,
    Duplicate,
    FlipBit,
    Frames,
    Masquerade,
    Omission,
    Opening,
    Partition,
    Reorder,
    SetSignal,
    StuckCounter,
    read_bus_fault,
)
from aftbed.inject.grammar import Chance, Every, Lasting, Permanent, Transient
from aftbed.inject.model import Fault, on_bus, parse
from aftbed.vehicle.condition import Condition

NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,20}", fullmatch=True).filter(lambda name: name != "from")
NODES = st.from_regex(r"[a-z_][a-z0-9_]{0,10}", fullmatch=True)
TIMES_US = st.integers(1, 3_600_000_000)
VALUES = st.integers(-(10**12), 10**12).map(lambda millionths: millionths / 1_000_000)
FRAMES = NAMES.map(lambda name: Frames(message=name)) | NODES.map(lambda node: Frames(sender=node))
OPENINGS = st.builds(Opening, after_us=st.just(0) | TIMES_US, nth=st.integers(1, 10**6)) | st.builds(
    Opening,
    when=st.builds(Condition, st.sampled_from(["ttc", "gap", "speed"]), st.booleans(), VALUES),
    nth=st.integers(1, 10**6),
)
LASTING = st.builds(Lasting, TIMES_US) | st.just(Permanent())
CHANCES = st.integers(1, 10**6).map(lambda millionths: Chance(millionths / 1_000_000)) | st.builds(
    Every, st.integers(1, 10**6)
)
FRAME_ACTS = st.one_of(
    st.sampled_from([Omission(), Duplicate(), Reorder(), StuckCounter()]),
    st.builds(Delay, TIMES_US),
    st.builds(FlipBit, st.integers(0, 63), st.booleans()),
    st.builds(SetSignal, NAMES, VALUES, st.booleans()),
    st.builds(Masquerade, NAMES),
)
SIDES = st.lists(NODES, min_size=2, max_size=5, unique=True).flatmap(
    lambda nodes: st.integers(1, len(nodes) - 1).map(
        lambda cut: Partition(tuple(nodes[:cut]), tuple(nodes[cut:]))
    )
)
FAULTS = st.builds(
    BusFault, FRAME_ACTS, FRAMES, OPENINGS, st.just(Transient()) | LASTING | CHANCES
) | st.builds(
    BusFault,
    st.builds(Babble, NODES) | st.builds(BusOff, NODES) | SIDES,
    st.none(),
    OPENINGS.map(lambda opening: Opening(opening.after_us, opening.when)),
    LASTING,
)


@given(FAULTS)
def test_a_fault_reads_back_as_it_was(fault: BusFault) -> None:
    assert read_bus_fault(str(fault)) == fault
    assert parse(str(fault)) == on_bus(fault)
    assert str(on_bus(fault)) == str(fault)


@given(
    st.lists(
        st.sampled_from(
            [*"bus", "from", "radar", "A|b", "bit", "12", "crc", "good", "signal", "X=1", "as", "by"]
            + ["40ms", "after", "when", "ttc", "<", "1.2", "nth", "for", "permanent", "intermittent", "p"]
        )
        | st.text(max_size=8),
        max_size=12,
    )
)
def test_whatever_is_typed_is_a_fault_or_refused(typed: list[str]) -> None:
    try:
        fault = read_bus_fault(" ".join(typed))
    except ConfigError:
        return
    assert read_bus_fault(str(fault)) == fault


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("omission bus RADAR_TRACK nth 5", BusFault(Omission(), Frames("RADAR_TRACK"), Opening(nth=5))),
        (
            "corrupt bus RADAR_TRACK bit 13 crc good permanent",
            BusFault(FlipBit(13, True), Frames("RADAR_TRACK"), persistence=Permanent()),
        ),
        (
            "delay bus AEB_REQ by 40ms for 500ms when ttc < 1.2",
            BusFault(
                Delay(40_000),
                Frames("AEB_REQ"),
                Opening(when=Condition("ttc", True, 1.2)),
                Lasting(500_000),
            ),
        ),
        ("bus-off RADAR after 2s", BusFault(BusOff("radar"), None, Opening(2_000_000), Permanent())),
        (
            "partition radar|brake,gateway for 1s",
            BusFault(Partition(("radar",), ("brake", "gateway")), None, persistence=Lasting(1_000_000)),
        ),
        (
            "reorder bus from brake intermittent p 0.25",
            BusFault(Reorder(), Frames(sender="brake"), persistence=Chance(0.25)),
        ),
    ],
)
def test_the_grammar(text: str, fault: BusFault) -> None:
    assert read_bus_fault(text) == fault
    assert parse(text) == on_bus(fault)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("omision bus A", "unknown fault of the bus 'omision'; did you mean 'omission'?"),
        ("omission RADAR_TRACK", "found 'RADAR_TRACK' where 'bus' is expected"),
        ("omission bus", "the name of a message is missing"),
        ("omission bus from", "the name of a node is missing"),
        ("omission bus 3x", "'3x' is no name of a message"),
        ("delay bus A", "'by' is missing"),
        ("delay bus A by 40", "duration '40': a positive number with its unit"),
        ("corrupt bus A", "'bit K' or 'signal NAME=VALUE' is missing"),
        ("corrupt bus A byte 3", "found 'byte' where 'bit' or 'signal' is expected"),
        ("corrupt bus A bit 64", "bit '64': a whole number from 0 to 63"),
        ("corrupt bus A bit 3 crc bad", "found 'bad' where 'good' is expected"),
        ("corrupt bus A signal RANGE", "signal 'RANGE': NAME=VALUE is allowed"),
        ("corrupt bus A signal RANGE=1e3", "signal 'RANGE=1e3': NAME=VALUE is allowed"),
        ("masquerade bus A", "'as' is missing"),
        ("omission bus A nth 0", "nth '0': a whole number from 1"),
        ("omission bus A intermittent p 1.5", "p '1.5': a chance above 0 and up to 1 is allowed"),
        ("omission bus A for 1s permanent", "'permanent' says again what has been said"),
        ("omission bus A after 1s when gap < 3", "'when' says again what has been said"),
        ("omission bus A when tcc < 3", "unknown quantity of the car 'tcc'; did you mean 'ttc'?"),
        ("omission bus A when ttc = 3", "found '=' where '<' or '>' is expected"),
        ("omission bus A when ttc < 3s", "ttc < '3s': a number is allowed"),
        ("omission bus A at server.exit", "unknown word 'at'"),
        ("bus-off radar nth 3", "'nth' is about frames; this fault takes hold of nodes"),
        ("babbling radar intermittent p 0.5", "'intermittent' is about frames"),
        ("partition radar|radar", "two sides, and each node once"),
        ("partition radar", "two sides, and each node once"),
    ],
)
def test_what_is_wrong_is_named(text: str, says: str) -> None:
    with pytest.raises(ConfigError) as refused:
        read_bus_fault(text)
    assert says in str(refused.value)


def test_faults_of_channels_keep_their_words() -> None:
    assert not isinstance(parse("omission pxy2pro nth 3").action, BusFault)


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda: BusFault(Omission()), "Omission without frames"),
        (lambda: BusFault(BusOff("radar"), Frames("A")), "BusOff with frames"),
        (lambda: BusFault(BusOff("radar")), "BusOff lasts"),
        (Frames, "frames of message ''"),
        (lambda: Opening(1, Condition("gap", True, 1.0)), "after a time and on a condition"),
        (
            lambda: Fault(read_bus_fault("bus-off radar"), "a", parse("crash a").trigger),
            "its own words",
        ),
    ],
)
def test_what_means_nothing_cannot_be_made(made: object, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        made()  # type: ignore[operator]
