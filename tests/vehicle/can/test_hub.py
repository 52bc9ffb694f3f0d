"""The hub over real sockets: what it relays, in which order, at which time; which clients it disconnects."""

import select
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import can
import pytest
from busharness import DEADLINE_S, SECRET, RawClient, RunningHub, hub_process, running_hub
from buslog import read_log
from hypothesis import given, settings
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError, PeerError
from aftbed.vehicle.can.bus_model import frame_bits
from aftbed.vehicle.can.candump import LogCounts, Refusal, parse_lines
from aftbed.vehicle.can.hub import ELEMENT_BYTES_MAX, HubOptions, parse_send

LOCKSTEP = HubOptions(lockstep=True)


def attach(port: int) -> can.BusABC:
    return can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="can0", tcp_tune=True)


def id_of(element: str) -> int:
    return int(element.split()[2], 16)


# -- relaying


def test_a_frame_goes_to_all_but_its_sender(hub: RunningHub) -> None:
    with RawClient(hub.port) as a, RawClient(hub.port) as b, RawClient(hub.port) as c:
        a.write("< send 130 3 1 a0 ff >")
        for client in (b, c):
            words = client.read().split()
            assert (words[:3], words[4:]) == (["<", "frame", "130"], ["01A0FF", ">"])
        assert a.ask("< echo >") == "< echo >"  # nothing came before it
    assert hub.stop().frames == 1


@pytest.mark.parametrize("code", [8, 9, 15])
def test_a_tool_may_send_a_length_code_above_8_which_means_8_bytes(hub: RunningHub, code: int) -> None:
    """As python-can does with a frame of such a log (ISO 11898-1)."""
    with RawClient(hub.port) as b, attach(hub.port) as tool:
        tool.send(can.Message(arbitration_id=0x130, is_extended_id=False, data=bytes(range(8)), dlc=code))
        assert b.read().split()[4] == "0001020304050607"
    assert hub.stop().refused == 0


def test_the_log_has_what_was_relayed(hub: RunningHub) -> None:
    with RawClient(hub.port) as a, RawClient(hub.port) as b:
        a.write("< send 130 0  >< send 7FF 1 5 >")
        stamps = [b.read().split()[3] for _ in range(2)]
    hub.stop()
    lines = [f"({float(stamp):017.6f}) can0 " for stamp in stamps]
    assert hub.log.read_text() == f"{lines[0]}130#\n{lines[1]}7FF#05\n"


@pytest.mark.parametrize("data", [b"", b"\x01\x02\xfa", bytes(8)])
def test_python_can_attaches_unchanged(hub: RunningHub, data: bytes) -> None:
    with attach(hub.port) as a, attach(hub.port) as b:
        a.send(can.Message(arbitration_id=0x131, data=data, is_extended_id=False))
        message = b.recv(DEADLINE_S)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x131, data)
        assert not message.is_extended_id


def test_clients_attach_in_full_traffic(hub: RunningHub) -> None:
    """python-can wants `< ok >` and not a byte more out of one read, however busy the bus is."""
    over = threading.Event()

    def flood() -> None:
        with RawClient(hub.port, ours=True) as source:
            while not over.is_set():
                source.write("< send 123 8 0 1 2 3 4 5 6 7 >" * 20)
                # A recv() on a socket with a timeout waits for it, even with MSG_DONTWAIT; and nothing
                # comes any more when the other source has ended.
                if select.select([source.sock], [], [], 0)[0]:
                    source.sock.recv(65536)

    sources = [threading.Thread(target=flood) for _ in range(2)]
    for source in sources:
        source.start()
    try:
        for _ in range(20):
            with attach(hub.port) as bus:
                message = bus.recv(DEADLINE_S)
                assert message is not None
                assert message.arbitration_id == 0x123
    finally:
        over.set()
        for source in sources:
            source.join(DEADLINE_S)
    assert hub.stop().refused == 0


def test_what_a_client_sent_before_it_left_is_carried(hub: RunningHub) -> None:
    with RawClient(hub.port) as b:
        with RawClient(hub.port) as a:
            a.write("< send 001 1 1 >< send 002 1 2 >")
        assert [id_of(b.read()) for _ in range(2)] == [1, 2]


# -- order and time


def test_the_lowest_identifier_wins_the_wire(tmp_path: Path) -> None:
    """At 1 kbit/s a frame without data takes 55 ms, so all others are waiting when it ends."""
    with (
        running_hub(tmp_path / "bus.log", HubOptions(bitrate_bps=1000)) as hub,
        RawClient(hub.port) as ear,
        RawClient(hub.port) as a,
        RawClient(hub.port) as b,
        RawClient(hub.port) as c,
    ):
        a.write("< send 300 0  >< send 301 0  >")
        a.fence()
        b.write("< send 200 0  >")
        c.write("< send 100 0  >")
        assert [id_of(ear.read()) for _ in range(4)] == [0x300, 0x100, 0x200, 0x301]


def test_a_node_keeps_the_order_of_its_own_frames(hub: RunningHub) -> None:
    with RawClient(hub.port) as a, RawClient(hub.port) as b:
        a.write("< send 701 0  >< send 100 0  >")
        assert [id_of(b.read()) for _ in range(2)] == [0x701, 0x100]


def test_a_frame_is_delivered_when_its_transmission_ends(tmp_path: Path) -> None:
    with (
        running_hub(tmp_path / "bus.log", HubOptions(bitrate_bps=5000)) as hub,
        RawClient(hub.port) as a,
        RawClient(hub.port) as b,
    ):
        before_s = time.monotonic()
        a.write("< send 100 8 0 0 0 0 0 0 0 0 >< send 100 8 0 0 0 0 0 0 0 0 >")
        stamps = [float(b.read().split()[3]) for _ in range(2)]
        assert time.monotonic() - before_s >= 2 * 135 / 5000
        assert stamps[1] - stamps[0] == pytest.approx(135 / 5000)


def test_wire_time_in_lockstep_is_only_stamped(tmp_path: Path) -> None:
    with (
        running_hub(tmp_path / "bus.log", HubOptions(lockstep=True, bitrate_bps=500_000)) as hub,
        RawClient(hub.port, ours=True) as a,
        RawClient(hub.port) as b,
    ):
        assert a.ask("< aftbed time 1000000 >") == "< ok >"
        a.write("< send 100 8 0 0 0 0 0 0 0 0 >< send 100 0  >")
        assert [b.read().split()[3] for _ in range(2)] == ["1.000270", "1.000380"]


def test_worst_case_length_on_the_wire() -> None:
    assert frame_bits(8) == 135  # the figure of Davis, Burns, Bril, Lukkien 2007
    assert frame_bits(0) == 55


def test_more_than_the_wire_carries_waits_and_is_not_lost(tmp_path: Path) -> None:
    options = HubOptions(bitrate_bps=1_000_000, pace=0.5)
    with (
        running_hub(tmp_path / "bus.log", options) as hub,
        RawClient(hub.port, ours=True) as a,
        RawClient(hub.port) as b,
    ):
        writer = threading.Thread(
            target=a.write, args=("".join(f"< send {i % 0x800:03x} 0  >" for i in range(3000)),)
        )
        writer.start()
        assert [id_of(b.read()) for _ in range(3000)] == [i % 0x800 for i in range(3000)]
        writer.join(DEADLINE_S)


def test_pace_makes_the_clock_of_the_bus(tmp_path: Path) -> None:
    options = HubOptions(pace=100.0, origin_ns=time.monotonic_ns() - 1_000_000_000)
    with (
        running_hub(tmp_path / "bus.log", options) as hub,
        RawClient(hub.port) as a,
        RawClient(hub.port) as b,
    ):
        a.write("< send 100 0  >")
        assert 100.0 <= float(b.read().split()[3]) < 100.0 * (1 + DEADLINE_S)


def test_lockstep_time_is_set_in_band(tmp_path: Path) -> None:
    with (
        running_hub(tmp_path / "bus.log", LOCKSTEP) as hub,
        RawClient(hub.port, ours=True) as a,
        RawClient(hub.port) as b,
    ):
        a.write("< send 100 0  >< aftbed time 20000 >< send 100 0  >< aftbed time 20000 >< send 100 0  >")
        assert [b.read().split()[3] for _ in range(3)] == ["0.000000", "0.020000", "0.020000"]
        assert [a.read(), a.read()] == ["< ok >", "< ok >"]


def test_lockstep_time_has_one_master_and_one_direction(tmp_path: Path) -> None:
    with (
        running_hub(tmp_path / "bus.log", LOCKSTEP) as hub,
        RawClient(hub.port, ours=True) as a,
        RawClient(hub.port, ours=True) as b,
        RawClient(hub.port, raw=False) as c,
    ):
        assert "unknown command" in c.ask("< aftbed time 1 >")  # not before `open`
        assert a.ask("< aftbed time 5 >") == "< ok >"
        assert "runs backwards, from 5 to 4" in a.ask("< aftbed time 4 >")
        assert "another client" in b.ask("< aftbed time 6 >")
        a.write("< send 100 0  >")
        assert b.read().split()[3] == "0.000005"
        a.sock.close()
        assert "another client" in b.ask("< aftbed time 7 >")  # not even then


def test_a_bus_in_real_time_is_not_set(hub: RunningHub) -> None:
    with RawClient(hub.port, ours=True) as a:
        assert "real time" in a.ask("< aftbed time 1 >")


@pytest.mark.parametrize(
    "options", [{"pace": 0.0}, {"pace": -1.0}, {"pace": float("nan")}, {"bitrate_bps": 0}]
)
def test_options_on_which_no_time_would_pass(options: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="allowed is"):
        HubOptions(**options)  # type: ignore[arg-type]


# -- bad input


@pytest.mark.parametrize(
    "element",
    [
        "< send 130 2 1 >",
        "< send 130 1 1 2 >",
        "< send 130 9 1 2 3 4 5 6 7 8 9 >",
        "< send 130 F 1 2 3 4 5 6 7 >",
        "< send 130 10 1 2 3 4 5 6 7 8 >",
        "< send 130 1 123 >",
        "< send 130 1 -1 >",
        "< send 130 1 0x1 >",
        "< send 800 1 1 >",
        "< send 13 1 1 >",
        "< send 00000130 1 1 >",
        "< send 130 1 1>",
        "<send 130 1 1 >",
        "< send >",
        "< >",
        ">",
        "< rawmode >",
        "< open can0 >",
        "< bcmmode >",
        "< aftbed time -1 >",
        "< aftbed time 1.5 >",
        "\0\xff< send 130 1 1 >",
    ],
)
def test_malformed_is_answered_and_changes_nothing(hub: RunningHub, element: str) -> None:
    with RawClient(hub.port, ours=True) as a, RawClient(hub.port) as b:
        a.write(element.encode("latin-1"))
        assert a.read().startswith("< error 20000000 ")
        a.write("< send 131 1 1 >")
        assert id_of(b.read()) == 0x131
    assert hub.stop().refused == 1
    assert len(hub.log.read_bytes().splitlines()) == 1


def test_nothing_is_sent_or_received_before_the_handshake(hub: RunningHub) -> None:
    with RawClient(hub.port, raw=False) as a, RawClient(hub.port) as b:
        assert "unknown command" in a.ask("< send 130 0  >")
        assert "unknown command" in a.ask("< rawmode >")
        assert "only can0 is here" in a.ask("< open can1 >")
        assert a.ask("< open can0 >") == "< ok >"
        assert "unknown command" in a.ask("< send 130 0  >")
        b.write("< send 131 0  >")
        b.fence()
        assert a.ask("< rawmode >") == "< ok >"
        b.write("< send 132 0  >")
        assert id_of(a.read()) == 0x132


def test_an_element_over_its_limit_ends_the_connection(hub: RunningHub) -> None:
    with RawClient(hub.port) as a, RawClient(hub.port) as b:
        a.write("< send " + "1" * ELEMENT_BYTES_MAX)
        assert "element over" in a.read()
        assert a.read() == ""
        assert b.ask("< echo >") == "< echo >"
    assert hub.stop().oversized == 1


ORDERS = (
    "time 9",
    "node x 100",
    "node x",
    "await x 1",
    "plant",
    "met 1 2 3",
    "unasked 100",
    "noticed 100 x 5",
)
ELEMENTS = (
    *("< send 100 1 1 >", "< send 100 ", " >", "<", ">", "< echo >", "< rawmode >", "< open can0 >"),
    *(f"< open can0 {secret} >" for secret in (SECRET, SECRET[1:], SECRET.upper())),
    *(f"< aftbed {words} >" for words in ORDERS),
)
fragments = st.one_of(st.binary(max_size=40), st.sampled_from([one.encode("ascii") for one in ELEMENTS]))


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[RunningHub, RawClient, RawClient]]:
    with (
        running_hub(tmp_path_factory.mktemp("fuzz") / "bus.log") as hub,
        RawClient(hub.port, ours=True) as a,
        RawClient(hub.port, ours=True) as b,
    ):
        yield hub, a, b
        lines = hub.log.read_bytes().splitlines(keepends=True)
        counts = LogCounts()
        assert len(list(parse_lines(lines, counts))) == len(lines), counts


@settings(deadline=None)
@given(st.lists(fragments, max_size=20), st.sampled_from(["new", "stranger", "ours"]))
def test_any_bytes_leave_the_bus_working(
    fuzzed: tuple[RunningHub, RawClient, RawClient], parts: list[bytes], who: str
) -> None:
    hub, a, b = fuzzed
    peer = RawClient(hub.port, raw=who != "new", ours=who == "ours")
    with peer, suppress(OSError):  # put out on the way
        for part in parts:
            peer.write(part)
    a.write("< send 7AA 2 be ef >")
    while id_of(element := b.read()) != 0x7AA:
        pass
    assert element.split()[4] == "BEEF"


@given(st.binary(max_size=60))
def test_any_send_is_a_frame_or_a_peer_error(text: bytes) -> None:
    for element in (text, b"< send " + text, b"< send 100 2 " + text + b" "):
        try:
            frame = parse_send(element, 0)
        except PeerError:
            continue
        assert element.startswith(b"< send ")
        assert len(frame.data) <= 8


def test_a_slow_reader_is_put_out_and_the_others_do_not_notice(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    with running_hub(log, send_buffer_bytes=4096) as hub:
        deaf = RawClient(hub.port, receive_buffer_bytes=4096)
        with deaf, RawClient(hub.port, ours=True) as a, RawClient(hub.port) as b:
            sent = 0
            while sent < 10_000:
                a.write("< send 100 8 1 2 3 4 5 6 7 8 >" * 100)
                sent += 100
                for _ in range(100):
                    assert id_of(b.read()) == 0x100
        assert hub.stop().slow_readers == 1
    assert len(log.read_bytes().splitlines()) == sent


# -- end of life


def test_the_end_of_the_life_descriptor_ends_the_hub(hub: RunningHub) -> None:
    with RawClient(hub.port) as a:
        hub.stop()
        assert a.read().endswith("the run has ended >") and a.read() == ""


def test_what_was_sent_before_the_end_is_recorded(hub: RunningHub) -> None:
    with RawClient(hub.port, ours=True) as a:
        a.write("< send 100 0  >" * 1000)
        hub.stop()
    assert len(hub.log.read_bytes().splitlines()) == 1000


@pytest.mark.process
def test_the_log_is_complete_after_a_kill(tmp_path: Path) -> None:
    """At most the frame that was on its way is missing, and at most one line is torn."""
    log = tmp_path / "bus.log"
    with hub_process(log) as (process, port), RawClient(port, ours=True) as a, RawClient(port) as b:
        killer = threading.Timer(0.3, process.send_signal, [signal.SIGKILL])
        killer.start()
        heard = 0
        with suppress(OSError):
            while True:
                a.write(f"< send 100 2 {heard & 0xFF:x} {heard >> 8 & 0xFF:x} >")
                if not b.read():
                    break
                heard += 1
        killer.join(DEADLINE_S)
    frames, counts = read_log(log)
    assert heard > 0
    assert heard - 1 <= len(frames) <= heard + 1
    assert set(counts.refused) <= {Refusal.TORN}
    assert [int.from_bytes(entry.frame.data, "little") for entry in frames] == [
        n & 0xFFFF for n in range(len(frames))
    ]
