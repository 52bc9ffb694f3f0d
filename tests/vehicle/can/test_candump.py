"""candump lines: one form written, exactly that form read, everything else counted."""

import can
import pytest
from buslog import read_log
from hypothesis import given
from hypothesis import strategies as st
from puredrive import TOYOTA_LOG

from aftbed.vehicle.can.candump import (
    LogCounts,
    LogFrame,
    Refusal,
    log_line,
    parse_line,
    parse_lines,
)
from aftbed.vehicle.can.frame import Frame

GOOD = b"(0000000012.345678) can0 130#0102030405060708"
REAL_LOG = TOYOTA_LOG

frames = st.builds(
    Frame,
    t_us=st.integers(0, 10**16 - 1),
    can_id=st.integers(0, 0x7FF),
    data=st.binary(max_size=8),
)


def test_the_form_written() -> None:
    frame = Frame(12_345_678, 0x130, bytes(range(1, 9)))
    assert log_line(frame, "can0").encode() == GOOD + b"\n"


@given(frames, st.sampled_from(["can0", "vcan1", "slcan12"]))
def test_what_is_written_is_read(frame: Frame, interface: str) -> None:
    line = log_line(frame, interface).encode()
    assert parse_line(line[:-1]) == LogFrame(interface, frame)


@given(frames)
def test_python_can_reads_what_is_written(tmp_path_factory: pytest.TempPathFactory, frame: Frame) -> None:
    path = tmp_path_factory.mktemp("log") / "one.log"
    path.write_text(log_line(frame, "can0"))
    with can.LogReader(path) as reader:
        (message,) = list(reader)
    assert (message.arbitration_id, bytes(message.data)) == (frame.can_id, frame.data)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"", Refusal.SYNTAX),
        (GOOD[1:], Refusal.SYNTAX),
        (GOOD + b" ", Refusal.SYNTAX),
        (GOOD + b"\r", Refusal.SYNTAX),
        (b" " + GOOD, Refusal.SYNTAX),
        (GOOD.replace(b"#", b" "), Refusal.SYNTAX),
        (GOOD.replace(b".345678", b".34567"), Refusal.SYNTAX),
        (GOOD.replace(b"0000000012", b"-000000012"), Refusal.SYNTAX),
        (GOOD.replace(b"130#", b"00000130#"), Refusal.IDENTIFIER),
        (GOOD.replace(b"130#", b"800#"), Refusal.IDENTIFIER),
        (GOOD.replace(b"130#", b"1g0#"), Refusal.IDENTIFIER),
        (GOOD.replace(b"#", b"##1"), Refusal.IDENTIFIER),
        (GOOD.replace(b"#0102030405060708", b"#R8"), Refusal.IDENTIFIER),
        (GOOD[:-1], Refusal.DATA),
        (GOOD + b"09", Refusal.DATA),
        (GOOD[:-1] + b"x", Refusal.DATA),
        (GOOD.replace(b"0102", b"01.02"), Refusal.DATA),
    ],
)
def test_what_is_refused(line: bytes, reason: Refusal) -> None:
    assert parse_line(line) is reason


@pytest.mark.parametrize("line", [GOOD, GOOD + b" R", GOOD + b" T", GOOD.replace(b"0102030405060708", b"")])
def test_what_is_read(line: bytes) -> None:
    assert isinstance(parse_line(line), LogFrame)


def test_a_last_line_without_newline_is_torn_even_if_it_parses() -> None:
    counts = LogCounts()
    assert len(list(parse_lines([GOOD + b"\n", GOOD[:-2]], counts))) == 1
    assert counts == LogCounts(2, 1, {Refusal.TORN: 1}, {Refusal.TORN: 2})


def test_time_running_backwards_is_refused_and_the_first_line_named() -> None:
    lines = [GOOD.replace(b"12.", b"%02d." % second) + b"\n" for second in (12, 13, 12, 11, 13)]
    counts = LogCounts()
    stamps = [entry.frame.t_us // 1_000_000 for entry in parse_lines(lines, counts)]
    assert stamps == [12, 13, 13]
    assert counts.refused == {Refusal.TIME: 2}
    assert counts.first_line == {Refusal.TIME: 3}


@given(
    st.lists(
        st.one_of(st.binary(max_size=80), st.just(GOOD), st.builds(lambda n: GOOD[:n], st.integers(0, 45)))
    )
)
def test_any_lines_are_counted_whole(lines: list[bytes]) -> None:
    counts = LogCounts()
    found = list(parse_lines([line + b"\n" for line in lines], counts))
    assert counts.lines == len(lines) == counts.frames + sum(counts.refused.values())
    assert counts.frames == len(found)
    assert set(counts.refused) == set(counts.first_line)


@pytest.mark.skipif(not REAL_LOG.exists(), reason="the recorded drive is not here")
def test_a_real_log_is_read_whole() -> None:
    found, counts = read_log(REAL_LOG)
    assert counts == LogCounts(lines=6920, frames=6920)
    assert {entry.interface for entry in found} == {"can0", "can1"}
