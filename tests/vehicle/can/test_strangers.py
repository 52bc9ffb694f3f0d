"""Clients of the hub without the secret of the run: what they may do, their limits, what is told of them."""

import ctypes
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

import can
import pytest
from busharness import DEADLINE_S, SECRET, RawClient, RunningHub, running_hub
from can.interfaces.socketcand import socketcand

from aftbed.vehicle.can import hub as hub_module
from aftbed.vehicle.can.bus import open_bus
from aftbed.vehicle.can.hub import (
    CLIENTS_MAX,
    ELEMENT_BYTES_MAX,
    OUTPUT_BYTES_MAX,
    STRANGER_ELEMENTS_AT_ONCE,
    STRANGER_ELEMENTS_PER_S,
    STRANGER_USERS_MAX,
    STRANGERS_MAX,
    HubCounts,
    HubOptions,
    Stranger,
    uid_by_sock_diag,
    user_behind,
)

ME: Final = os.geteuid()
NOBODY: Final = 65534
FRAME: Final = "< send 130 0  >"
RESET: Final = struct.pack("ii", 1, 0)  # linger for no time: close by a reset
OPEN_TO_ALL: Final = HubOptions(open_to_all=True)
OURS: Final = (
    *("time 5", "node radar 130", "await radar 1", "plant", "met 7 2000 123", "unasked 130"),
    *("noticed 130 lost 5", "sing", ""),
)


def last_words(client: RawClient) -> str:
    """What the hub tells a client before it hangs up."""
    element = last = client.read()
    while element:
        last, element = element, client.read()
    return last


def counted(hub: RunningHub) -> HubCounts:
    found: list[HubCounts] = []
    hub.order(lambda it: found.append(it.counts()))
    return found[0]


def served(hub: RunningHub) -> None:
    """A node of the run gets onto the bus, and its frames are carried in time."""
    a, b = open_bus(hub.options), open_bus(hub.options)
    with RawClient(hub.port, ours=True) as node:
        node.write("< send 7AA 1 5 >")
        for bus in (a, b):
            while (frame := bus.recv(DEADLINE_S)) is not None and frame.can_id != 0x7AA:
                pass
            assert frame is not None, "it is not served"
            bus.close()


# -- the secret


@pytest.mark.parametrize("words", OURS)
def test_a_stranger_gives_no_orders(hub: RunningHub, words: str) -> None:
    with RawClient(hub.port) as stranger:
        assert "only the nodes of the run may do this" in stranger.ask(f"< aftbed {words} >")
        stranger.fence()
    (one,) = hub.stop().strangers
    assert (one.refused, one.commands_refused) == (1, 1)
    assert hub.link.strangers[-1] == f"a stranger of user {ME} tried what only the nodes of the run may do"


@pytest.mark.parametrize(
    "secret", ["0" * 32, SECRET[:-1], SECRET + "0", SECRET[::-1], "0"], ids=lambda one: f"{len(one)} digits"
)
def test_a_wrong_secret_ends_the_connection(hub: RunningHub, secret: str) -> None:
    with RawClient(hub.port, raw=False) as client:
        client.write(f"< open can0 {secret} >")
        assert "this is not the secret of the run" in last_words(client)
    served(hub)
    assert hub.stop().strangers == [Stranger(ME, turned_away=1)]


@pytest.mark.parametrize("words", [f"can0 {SECRET.upper()}", "can0 ", SECRET])
def test_what_is_no_secret_opens_nothing(hub: RunningHub, words: str) -> None:
    with RawClient(hub.port, raw=False) as client:
        assert "only can0 is here" in client.ask(f"< open {words} >")
        assert "not now" in client.ask("< aftbed plant >")


def test_a_bus_without_a_secret_has_strangers_only(tmp_path: Path) -> None:
    with running_hub(tmp_path / "bus.log", secret="") as hub, RawClient(hub.port) as client:
        assert "only the nodes of the run may do this" in client.ask("< aftbed plant >")
        with RawClient(hub.port, raw=False) as other:
            other.write(f"< open can0 {SECRET} >")
            assert "this is not the secret" in last_words(other)


# -- other users


def of_user(uid: int, make: Callable[[], RawClient]) -> RawClient:
    """A client whose socket that user has made: the user of a socket is that of the thread that makes it."""
    setfsuid = ctypes.CDLL(None).setfsuid
    try:
        setfsuid(uid)
        return make()
    finally:
        setfsuid(ME)


@pytest.mark.skipif(ME != 0, reason="only root can make a socket of another user")
def test_another_user_is_turned_away_and_told_why(hub: RunningHub) -> None:
    with of_user(NOBODY, lambda: RawClient(hub.port, raw=False)) as other:
        other.write("< open can0 >< rawmode >" + FRAME)
        assert f"you are user {NOBODY}, and user {ME} has started this run without --bus-open" in last_words(
            other
        )
    (told,) = hub.link.strangers
    assert told.startswith(f"a stranger of user {NOBODY} was turned away from the bus: you are user")
    assert hub.stop().strangers == [Stranger(NOBODY, turned_away=1)]
    assert hub.log.read_bytes() == b""


@pytest.mark.skipif(ME != 0, reason="only root can make a socket of another user")
def test_on_an_open_bus_another_user_is_let_in(tmp_path: Path) -> None:
    with (
        running_hub(tmp_path / "bus.log", OPEN_TO_ALL) as hub,
        of_user(NOBODY, lambda: RawClient(hub.port)) as other,
        RawClient(hub.port) as mine,
    ):
        other.write(FRAME)
        assert mine.read().startswith("< frame 130 ")
        counts = hub.stop()
    assert counts.strangers == [Stranger(NOBODY, connections=1, frames=1), Stranger(ME, connections=1)]
    assert counts.open_to_all


@pytest.mark.parametrize(
    ("uid", "told"), [(ME + 1, f"you are user {ME + 1},"), (None, "your user is not known,")]
)
def test_who_is_not_this_user_is_turned_away(
    hub: RunningHub, monkeypatch: pytest.MonkeyPatch, uid: int | None, told: str
) -> None:
    monkeypatch.setattr(hub_module, "user_behind", lambda sock: uid)
    with RawClient(hub.port, raw=False) as other:
        other.write("< open can0 >")
        assert told in last_words(other)
    served(hub)
    assert hub.stop().strangers == [Stranger(uid, turned_away=1)]


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """The two ends of a loopback connection: the one that was accepted, and the other."""
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as end,
    ):
        accepted, _ = server.accept()
        with accepted:
            yield accepted, end


def test_the_kernel_knows_the_user_behind_a_connection(pair: tuple[socket.socket, socket.socket]) -> None:
    accepted, end = pair
    assert user_behind(accepted) == user_behind(end) == ME
    end.shutdown(socket.SHUT_WR)
    assert user_behind(accepted) == ME, "it can still read"


def test_an_end_that_was_closed_has_no_user(pair: tuple[socket.socket, socket.socket]) -> None:
    """What it had sent before must not be taken for a frame of root, user 0."""
    accepted, end = pair
    end.sendall(b"< open can0 >")
    end.close()
    assert user_behind(accepted) is None


def test_an_end_that_was_reset_has_no_user(pair: tuple[socket.socket, socket.socket]) -> None:
    accepted, end = pair
    end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
    end.close()
    assert user_behind(accepted) is None


def test_a_connection_by_ipv6_to_the_same_address_has_a_user(hub: RunningHub) -> None:
    with socket.socket(socket.AF_INET6) as sock:
        sock.settimeout(DEADLINE_S)
        sock.connect(("::ffff:127.0.0.1", hub.port))
        sock.sendall(b"< open can0 >")
        data = b""
        while data.count(b">") < 2:
            data += sock.recv(4096)
        assert data == b"< hi >< ok >"


def test_a_kernel_that_does_not_say_gives_no_user(
    pair: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub_module, "_SOCK_DIAG_BY_FAMILY", 99)
    assert user_behind(pair[0]) is None


def test_without_sock_diag_the_table_of_connections_is_read(
    pair: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub_module, "_SOCK_DIAG", 31)
    accepted, end = pair
    with pytest.raises(OSError):
        uid_by_sock_diag(end.getsockname(), accepted.getsockname())
    assert user_behind(accepted) == user_behind(end) == ME
    end.close()
    assert user_behind(accepted) is None


# -- limits


def test_there_is_room_for_so_many_strangers_and_always_for_nodes(hub: RunningHub) -> None:
    with ExitStack() as stack:
        for _ in range(STRANGERS_MAX):
            first = stack.enter_context(RawClient(hub.port))
        with RawClient(hub.port, raw=False) as late:
            late.write("< open can0 >")
            assert f"{STRANGERS_MAX} strangers are on it already" in last_words(late)
        served(hub)
        first.sock.close()
        first = stack.enter_context(RawClient(hub.port))
    (one,) = hub.stop().strangers
    assert (one.connections, one.turned_away) == (STRANGERS_MAX + 1, 1)


def test_connections_that_never_open_the_bus_make_room(hub: RunningHub) -> None:
    with ExitStack() as stack:
        idle = [stack.enter_context(RawClient(hub.port, raw=False)) for _ in range(CLIENTS_MAX)]
        served(hub)
        assert f"no room: there are {CLIENTS_MAX} connections" in last_words(idle[0]), "the oldest has gone"
        assert idle[-1].ask("< echo >") == "< echo >"
    counts = hub.stop()
    assert counts.turned_away >= 3
    assert counts.strangers == [Stranger(None, turned_away=counts.turned_away)]


def test_a_stranger_that_sends_too_fast_is_put_out_and_told(hub: RunningHub) -> None:
    began_s = time.monotonic()
    with RawClient(hub.port) as flood, RawClient(hub.port, ours=True) as node:
        with suppress(OSError):  # the hub takes no more
            flood.write(FRAME * 20 * STRANGER_ELEMENTS_AT_ONCE)
        assert f"too fast: {STRANGER_ELEMENTS_PER_S} elements a second are allowed" in last_words(flood)
        assert node.ask("< echo >").startswith("< frame 130 ")
    most = STRANGER_ELEMENTS_AT_ONCE + STRANGER_ELEMENTS_PER_S * (time.monotonic() - began_s)
    (one,) = hub.stop().strangers
    assert STRANGER_ELEMENTS_AT_ONCE <= one.frames <= most
    assert one.put_out_fast == 1


@pytest.mark.parametrize("element", [FRAME, "< echo >", "< nonsense >", "< aftbed plant >", ">"])
def test_each_element_of_a_stranger_counts(hub: RunningHub, element: str) -> None:
    with RawClient(hub.port) as flood:
        with suppress(OSError):
            flood.write(element * 20 * STRANGER_ELEMENTS_AT_ONCE)
        assert "too fast" in last_words(flood)


def test_who_has_not_opened_the_bus_has_a_rate_too(hub: RunningHub) -> None:
    with RawClient(hub.port, raw=False) as flood:
        with suppress(OSError):
            flood.write("< open can7 >" * 20 * STRANGER_ELEMENTS_AT_ONCE)
        assert "too fast" in last_words(flood)
    served(hub)


def test_to_come_again_makes_no_stranger_faster(hub: RunningHub) -> None:
    began_s = time.monotonic()
    for _ in range(20):
        with RawClient(hub.port) as flood, suppress(OSError):
            flood.write(FRAME * 20 * STRANGER_ELEMENTS_AT_ONCE)
            last_words(flood)
    most = STRANGER_ELEMENTS_AT_ONCE + STRANGER_ELEMENTS_PER_S * (time.monotonic() - began_s)
    (one,) = hub.stop().strangers
    assert (one.frames <= most, one.put_out_fast) == (True, 20)


def test_a_node_of_the_run_has_no_rate(hub: RunningHub) -> None:
    with RawClient(hub.port, ours=True) as node, RawClient(hub.port) as ear:
        writer = threading.Thread(target=node.write, args=(FRAME * 20 * STRANGER_ELEMENTS_AT_ONCE,))
        writer.start()
        for _ in range(20 * STRANGER_ELEMENTS_AT_ONCE):
            assert ear.read().startswith("< frame 130 ")
        writer.join(DEADLINE_S)


def test_users_share_an_account_when_they_are_too_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else whoever has many uids has as many rates."""
    uids = iter(range(1000, 1100))
    monkeypatch.setattr(hub_module, "user_behind", lambda sock: next(uids))
    with running_hub(tmp_path / "bus.log", OPEN_TO_ALL) as hub:
        for _ in range(STRANGER_USERS_MAX + 5):
            RawClient(hub.port).sock.close()
        found = {one.uid: one.connections for one in hub.stop().strangers}
    assert found == dict.fromkeys(range(1000, 1000 + STRANGER_USERS_MAX), 1) | {None: 5}


def test_a_slow_reader_is_told_when_it_reads(tmp_path: Path) -> None:
    with running_hub(tmp_path / "bus.log", send_buffer_bytes=4096) as hub:
        with RawClient(hub.port, receive_buffer_bytes=4096) as slow, RawClient(hub.port, ours=True) as node:
            while not counted(hub).slow_readers:
                node.write("< send 100 8 1 2 3 4 5 6 7 8 >" * 100)
            assert f"too slow: {OUTPUT_BYTES_MAX} bytes wait to be read" in last_words(slow)
        (one,) = hub.stop().strangers
    assert one.put_out_slow == 1


def test_who_does_not_read_why_it_is_put_out_is_disconnected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub_module, "LEAVE_S_MAX", 0.05)
    with (
        running_hub(tmp_path / "bus.log", send_buffer_bytes=4096) as hub,
        RawClient(hub.port, receive_buffer_bytes=4096) as deaf,
        RawClient(hub.port, ours=True) as node,
    ):
        while not counted(hub).slow_readers:
            node.write("< send 100 8 1 2 3 4 5 6 7 8 >" * 100)
        hung_up = select.poll()
        deaf.write("< echo >")  # it is not taken any more, so the end is a reset
        hung_up.register(deaf.sock, 0)
        assert hung_up.poll(DEADLINE_S * 1e3)


def test_a_client_that_goes_while_it_is_put_out_is_no_trouble(
    hub: RunningHub, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hub has read the element over the limit, and finds out when it answers the one before it."""
    monkeypatch.setattr(hub_module, "LEAVE_S_MAX", 0.0)
    client = RawClient(hub.port, raw=False)

    def go(_: str) -> None:
        client.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        client.sock.close()

    monkeypatch.setattr(hub.link, "stranger", go)
    client.write("< open can0 >" + "x" * 2 * ELEMENT_BYTES_MAX)
    served(hub)
    assert hub.stop().oversized == 1


# -- to be found, and told of the end


def test_python_can_finds_the_bus_by_its_beacon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        listens_at = free.getsockname()
    monkeypatch.setattr(hub_module, "BEACON", listens_at)
    monkeypatch.setattr(socketcand, "DEFAULT_SOCKETCAND_DISCOVERY_PORT", listens_at[1])
    with running_hub(tmp_path / "bus.log", HubOptions(beacon="aftbed run 3f09c1")) as hub:
        (found,) = can.detect_available_configs(interfaces=["socketcand"])
        where = {"host": "127.0.0.1", "port": hub.port, "channel": "can0"}
        assert dict(found) == {"interface": "socketcand"} | where
        with can.Bus(**found), RawClient(hub.port) as other:
            other.fence()
        assert hub.stop().strangers == [Stranger(ME, connections=2)]


def test_the_beacon_leaves_this_machine_by_no_interface() -> None:
    assert hub_module.BEACON == ("127.0.0.1", socketcand.DEFAULT_SOCKETCAND_DISCOVERY_PORT)


def test_without_a_name_there_is_no_beacon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        monkeypatch.setattr(hub_module, "BEACON", ear.getsockname())
        with running_hub(tmp_path / "bus.log") as hub:
            served(hub)
        assert not select.select([ear], [], [], 0)[0]


def test_strangers_are_told_when_the_run_ends_and_its_nodes_are_not(hub: RunningHub) -> None:
    with (
        RawClient(hub.port) as stranger,
        RawClient(hub.port, raw=False) as newcomer,
        RawClient(hub.port, ours=True) as node,
    ):
        hub.stop()
        for client in (stranger, newcomer):
            assert client.read().endswith(" the run has ended >")
            assert client.read() == ""
        assert node.read() == ""


# -- what is told of them


def test_what_strangers_do_is_counted(hub: RunningHub) -> None:
    """Forged are frames that a node of the run sends, or says that it evaluates, at any time of the run."""
    with RawClient(hub.port) as stranger, RawClient(hub.port, ours=True) as node:
        stranger.write("< send 130 0  >< send 100 0  >< send 123 0  >< aftbed time 1 >< nonsense >")
        stranger.fence()
        node.write("< aftbed node brake 100 >< send 130 0  >")
        node.fence()
        stranger.write("< send 100 0  >")
        stranger.fence()
    counts = hub.stop()
    assert counts.strangers == [
        Stranger(ME, connections=1, frames=4, forged={"100": 2, "130": 1}, refused=2, commands_refused=1)
    ]
    assert (counts.frames, counts.refused) == (5, 2)
    assert hub.link.strangers == [
        f"a stranger of user {ME} is on the bus",
        f"a stranger of user {ME} tried what only the nodes of the run may do",
        f"a stranger of user {ME} sends frame 100, which is of the run's own",
    ]


def test_a_tool_that_listens_is_counted_as_no_more(hub: RunningHub) -> None:
    tool = can.Bus(interface="socketcand", host="127.0.0.1", port=hub.port, channel="can0", tcp_tune=True)
    with tool, RawClient(hub.port, ours=True) as node:
        node.write(FRAME)
        message = tool.recv(DEADLINE_S)
        assert message is not None and message.arbitration_id == 0x130
    assert hub.stop().strangers == [Stranger(ME, connections=1)]


def test_nodes_of_the_run_are_no_strangers(hub: RunningHub) -> None:
    served(hub)
    assert hub.stop().strangers == []
    assert hub.link.strangers == []
