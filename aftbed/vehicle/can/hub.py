"""The CAN bus between processes: a hub on 127.0.0.1 that speaks the socketcand text protocol.

Every node is a TCP client; python-can's own `socketcand` interface and other tools attach unchanged.
The dialogue of a client (`<` to the hub, `>` from it):

    > < hi >
    < < open can0 >            > < ok >
    < < rawmode >              > < ok >          from here on the client receives frames
    < < send 130 8 1 2 3 4 5 6 7 8 >
    > < frame 110 12.345678 0102030405060708 >
    < < echo >                 > < echo >

An element that is malformed or out of place is answered with `< error 20000000 SECONDS.MICROS reason >`,
which clients of socketcand read as an error frame, and changes nothing; an element over its size limit also
ends the connection. Frames follow the rules of `bus_model`.

*Time.* Stamps are microseconds since the start of the run times the pace. In lockstep they are the
virtual time that one client, the first that asks for it, sets by `aftbed time`; it never runs backwards.

*Strangers.* The nodes of the run open the bus with its secret, which they have from the supervisor:

    < < open can0 0123456789abcdef0123456789abcdef >        > < ok >

A client that opens it without one is a stranger: a tool, of this user or of another one. It receives all
frames, and all receive its frames. What it does is counted for the record, by its user (`Stranger`). Users
other than the hub's own are let in only on a bus that was started open. Strangers have limits, so that the
nodes of the run get onto the bus and are served whatever strangers do; one that breaks a limit is told why by
an error element, and put out. So is a connection that has to make room for another, and at the end of the run
all strangers are told that it has ended.

*To be found.* With a name to be found by, the hub sends a beacon of socketcand each second, as a datagram to
127.0.0.1, where clients of socketcand listen for it; no other machine receives it.

*Beside the bus* the nodes of the run, and only they, send elements of their own. One that gives its name can
be cut off by a fault, and its reports count.

    < < aftbed node radar 100 >        the client's name, and the identifiers that it uses
    < < aftbed noticed 100 lost 20000 5678 >   what is wrong with these frames, or `good_again`: at 20000 us
                                       by the node's own bus time, 5678 ns by the clock
    < < aftbed unasked 130 >           the gateway makes no request of a frame of which one is expected
    < < aftbed time 20000 >            > < ok >  the virtual time; with faults, when one is due: < ok 31000 >
    < < aftbed await radar 12 >        > < ok >  when twelve frames of the radar have been carried
    < < aftbed plant >                 > < ok >  this client is the car, the only one that knows conditions
                                       > < watch 7 ttc below 1.2 >
    < < aftbed met 7 3240 5678 >       > < ok >  it holds: at 3240 us of the drive, 5678 ns by the clock

The time belongs to the first client that sets it, the conditions to the first that says it is the car;
another one is refused. No element ends a run: the car and the player do that, over their lines to the
supervisor.

In lockstep time stands still until the protected function has answered what it was asked. A fault makes
that a matter of the bus: a RADAR_TRACK that was lost is not answered, one that comes twice may be answered
twice. So the hub sends the time master, before any node receives the frame, by how many the number of
receivers that use it differs from the number without faults:

    > < change 130 -1 >        lost, or no request was made of it
    > < change 100 +1 >        one more: held back before, or a second time

Other faults can wait for a condition of the car, too (`SupervisorLink`). In lockstep it gets its `< ok >`
only after all actions at the condition are done, so it does not take its next step before.

*Order of work.* One thread that blocks only to wait for events: relay first, because latency is what
the bus is measured by, then one `write` to the log before the next frame is taken. So a `kill -9` costs the
log at most the frame under way. Nothing that a client does may stop the bus: a client that does not read
is put out when 256 KiB wait for it; one that sends more than the wire carries is not read until its
queue is short.

Limit: python-can demands that a read gives `< ok >` and nothing behind it, while the first frame may follow
at once. So the hub sends one byte of TCP urgent data between the two: a reader stops in front of the urgent
mark, whatever is queued behind it, and the receiving kernel takes the byte itself out of the stream. RFC 6093
advises against urgent data because middleboxes spoil it; the loopback has none. Through a proxy the mark is
lost, and the byte is a newline.
"""

import os
import re
import select
import socket
import struct
import sys
import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import suppress
from hmac import compare_digest
from os import read, write
from typing import Final, Protocol

import msgspec

from aftbed.core.errors import AftbedError, ConfigError, HarnessError, PeerError
from aftbed.core.units import number
from aftbed.vehicle.can.bus_model import CHANNEL, HOST, BusModel, BusNode, Notice
from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.can.frame import DATA_LENGTH_MAX, Frame
from aftbed.vehicle.condition import Condition

EVENTS_MAX: Final = 32  # in one round; the rest comes in the next
READ_BYTES_MAX: Final = 4096
ELEMENT_BYTES_MAX: Final = 128  # the longest legal one has 100
LAST_FRAMES_S_MAX: Final = 0.1
LOG_BYTES_MAX: Final = 1024 * 1024 * 1024
CLIENTS_MAX: Final = 128
STRANGERS_MAX: Final = 32  # at a time; so the nodes of the run always find room
STRANGER_ELEMENTS_PER_S: Final = 2_000  # of all connections of a user; 500 kbit/s carry 4000 frames
STRANGER_ELEMENTS_AT_ONCE: Final = 256
STRANGER_USERS_MAX: Final = 8  # that are told apart; all others count as one
LEAVE_S_MAX: Final = 1.0  # for a client that is put out to read why
BEACON: Final = (HOST, 42000)  # where clients of socketcand listen
BEACON_PERIOD_S: Final = 1.0  # python-can listens for 3.1 s
OUTPUT_BYTES_MAX: Final = 256 * 1024
FRAMES_QUEUED_MAX: Final = 256  # of one client

_SEND: Final = re.compile(
    rb"< send ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8}) ([0-9A-Fa-f]) ((?:[0-9A-Fa-f]{1,2} ){0,8}) ?"
)
_OURS: Final = {  # elements of aftbed's nodes
    word: re.compile(rb"< aftbed %b %b" % (word, arguments))
    for word, arguments in {
        b"time": rb"([0-9]{1,16}) ",
        b"node": rb"([a-z_][a-z0-9_]{0,31})((?: [0-9A-F]{3}){0,16}) ",
        b"await": rb"([a-z_][a-z0-9_]{0,31}) ([0-9]{1,12}) ",
        b"plant": rb"",
        b"met": rb"([0-9]{1,12}) ([0-9]{1,16}) ([0-9]{1,20}) ",
        b"unasked": rb"([0-9A-F]{3}) ",
        b"noticed": rb"([0-9A-F]{3}) ([a-z_]{1,32}) ([0-9]{1,16}) ([0-9]{1,20}) ",
    }.items()
}
_SOCK_DIAG: Final = 4  # linux/netlink.h, linux/sock_diag.h, linux/inet_diag.h
_SOCK_DIAG_BY_FAMILY: Final = 20
_REQUEST: Final = 1
_ANY: Final = struct.pack("=III", 0, 0xFFFF_FFFF, 0xFFFF_FFFF)  # interface and cookie
_INODE_END: Final = 16 + 72  # the header, and struct inet_diag_msg, which ends with uid and inode
_CONNECTED: Final = (1, 8)  # TCP_ESTABLISHED, TCP_CLOSE_WAIT
_OPEN: Final = re.compile(rb"< open ([^ ]+) (?:([0-9a-f]+) )?")
_READABLE: Final = select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR | select.EPOLLRDHUP


class HubOptions(msgspec.Struct, frozen=True):
    """How the bus behaves. `origin_ns` is the start of the run by the monotonic clock.

    `secret` is what the nodes of the run open the bus with, in hexadecimal; without one all clients are
    strangers. `open_to_all`: to other users, too. `beacon`: the name in the beacon; "" sends none.
    """

    channel: str = CHANNEL
    secret: str = ""
    open_to_all: bool = False
    beacon: str = ""
    lockstep: bool = False
    pace: float = 1.0  # seconds of bus time in a second
    bitrate_bps: int | None = None  # None: a frame takes no time on the wire
    origin_ns: int | None = None  # None: when `serve` is called

    def __post_init__(self) -> None:
        if not self.pace > 0:
            raise ConfigError(f"bus pace {self.pace}, allowed is more than 0")
        if self.bitrate_bps is not None and not 1_000 <= self.bitrate_bps <= 1_000_000:
            raise ConfigError(f"bus bitrate {self.bitrate_bps} bit/s, allowed is 1000 to 1000000")


class Stranger(msgspec.Struct):
    """What one user did on the bus without the secret; `uid` None: users not known, or too many.

    `connections` were let in, `turned_away` were not. `forged`: of its `frames`, those that the run's own
    nodes send or evaluate, by identifier. `refused`: elements that were malformed, out of place, or
    (`commands_refused`) only for these nodes.
    """

    uid: int | None
    connections: int = 0
    turned_away: int = 0
    frames: int = 0
    forged: dict[str, int] = {}
    refused: int = 0
    commands_refused: int = 0
    put_out_slow: int = 0
    put_out_fast: int = 0
    put_out_oversized: int = 0

    def __str__(self) -> str:
        return "a stranger of an unknown user" if self.uid is None else f"a stranger of user {self.uid}"


class HubCounts(msgspec.Struct):
    """What happened on the bus: frames carried, elements refused, clients put out by reason.

    `turned_away`: connections for which there was no room. `open_to_all`: as in `HubOptions`.
    """

    open_to_all: bool = False
    frames: int = 0
    refused: int = 0
    slow_readers: int = 0
    oversized: int = 0
    turned_away: int = 0
    strangers: list[Stranger] = []


class SupervisorLink(Protocol):
    """The hub's link to the supervisor; it reads the hub's life descriptor."""

    def attend(self, hub: "Hub") -> bool:
        """Carry out the next order; False when the link has ended."""
        ...

    def faults_acted(self) -> None:
        """What became of the faults of the bus may have changed."""
        ...

    def met(self, fault_number: int, t_us: int, since_ns: int) -> None:
        """The condition of that fault holds.

        `since_ns` is 0 in lockstep, where the car waits for `Hub.go_on`.
        """
        ...

    def stranger(self, text: str) -> None:
        """A stranger does something for the first time: a line for people."""
        ...


class _PutOutError(AftbedError):
    """The client has to leave, for this reason."""


class _Account:
    """What the strangers of one user have done, and how much they may still send now."""

    def __init__(self, uid: int | None) -> None:
        self.did = Stranger(uid)
        self.ids: Counter[int] = Counter()  # of its frames
        self.told: set[str] = set()  # what the supervisor has been told
        self._left = float(STRANGER_ELEMENTS_AT_ONCE)
        self._at_s = time.monotonic()

    def pay(self) -> None:
        """For one element. Raises _PutOutError when there were too many."""
        now_s = time.monotonic()
        gained = (now_s - self._at_s) * STRANGER_ELEMENTS_PER_S
        self._left, self._at_s = min(self._left + gained, STRANGER_ELEMENTS_AT_ONCE), now_s
        if self._left < 1:
            self.did.put_out_fast += 1
            raise _PutOutError(f"too fast: {STRANGER_ELEMENTS_PER_S} elements a second are allowed")
        self._left -= 1


class HubConnection(BusNode):
    """One connection: how far its handshake is, and what waits in either direction.

    `account` is None of a node of the run. `leaves_s`: it was put out, and when it is disconnected at last.
    """

    __slots__ = ("account", "inbox", "interest", "leaves_s", "opened", "outbox", "raw", "sock")

    def __init__(self, sock: socket.socket, account: _Account) -> None:
        super().__init__(f"client {sock.fileno()}")  # no name that a node gives has a blank in it
        self.account: _Account | None = account
        self.leaves_s: float | None = None
        self.sock = sock
        self.opened = False
        self.raw = False
        self.inbox = b""
        self.outbox = bytearray()
        self.interest = select.EPOLLIN


class Hub(BusModel[HubConnection]):
    """The bus. `serve` makes one and runs it; it owns the connections, not the descriptors given."""

    def __init__(
        self,
        listener: socket.socket,
        log_fd: int,
        options: HubOptions,
        life_fd: int,
        link: SupervisorLink | None,
    ) -> None:
        super().__init__(options.bitrate_bps)
        self._counts = HubCounts(open_to_all=options.open_to_all)
        self._accounts: dict[int | None, _Account] = {}  # by user
        self._newcomers = self._account(None)  # of those that have not opened the bus yet
        self._own_ids: set[int] = set()  # of frames that nodes of the run have sent or evaluate
        self._leaving: deque[HubConnection] = deque()  # some may have gone
        self._secret = options.secret.encode("ascii")
        self._options = options
        self._listener = listener
        self._log_fd = log_fd
        self._log_bytes = 0
        self._life_fd = life_fd
        self._link = link
        self._origin_ns = time.monotonic_ns() if options.origin_ns is None else options.origin_ns
        self._virtual_us = 0
        self._time_master: HubConnection | None = None
        self._plant: HubConnection | None = None  # the car
        self._awaiting: tuple[HubConnection, str, int] | None = None  # for so many frames of a node
        self._held: dict[int, HubConnection] = {}  # the car, by the number of the fault for which it waits
        self._clients: dict[int, HubConnection] = {}  # by descriptor
        self._epoll = select.epoll()
        listener.setblocking(False)
        self._epoll.register(listener.fileno(), select.EPOLLIN)
        self._epoll.register(life_fd, select.EPOLLIN)
        self._beacon = _Beacon(options, listener.getsockname()[1]) if options.beacon else None

    def run(self) -> HubCounts:
        """Carry frames until `life_fd` ends, and then those that had been sent by then."""
        alive = True
        while alive:
            alive = self._attend_all(self._wait())
            self._carry_sent()
            if self._awaiting is not None:
                self._answer_await(*self._awaiting)
            if self._leaving:
                self._end_leaving()
            if self._beacon is not None:
                self._beacon.send_if_due()
        self._epoll.unregister(self._life_fd)
        self._epoll.unregister(self._listener.fileno())
        end_s = time.monotonic() + LAST_FRAMES_S_MAX
        while time.monotonic() < end_s and (events := self._epoll.poll(0, EVENTS_MAX)):
            self._attend_all(events)
            self._carry_sent()
        for client in list(self._clients.values()):
            if client.account is not None and client.leaves_s is None:
                self._say_last(client, "the run has ended")
        return self.counts()

    def counts(self) -> HubCounts:
        """What happened until now."""
        for account in self._accounts.values():
            forged = {f"{i:03X}": n for i, n in sorted(account.ids.items()) if i in self._own_ids}
            account.did.frames, account.did.forged = account.ids.total(), forged
        did = [account.did for account in self._accounts.values()]
        self._counts.strangers = [one for one in did if one != Stranger(one.uid)]
        return self._counts

    def close(self) -> None:
        for client in list(self._clients.values()):
            self._drop(client)
        self._epoll.close()

    def go_on(self, fault_number: int) -> None:
        """All actions at the condition of that fault are done: answer the car that waits for it."""
        car = self._held.pop(fault_number, None)
        if car is not None:
            self._send(car, self._ok())

    # -- time and waiting -----------------------------------------------------------------------

    def _carry_sent(self) -> None:
        """Carry what was sent until now; in lockstep, faults release with the time that is set."""
        if self._options.lockstep:
            self.carry()
        else:
            self.advance(self.now_us())

    def now_us(self) -> int:
        if self._options.lockstep:
            return self._virtual_us
        return self._us_of(time.monotonic_ns())

    def _us_of(self, clock_ns: int) -> int:
        """Bus time out of lockstep."""
        elapsed_us = (clock_ns - self._origin_ns) // 1000
        return elapsed_us if self._options.pace == 1.0 else int(elapsed_us * self._options.pace)

    def _wait(self) -> list[tuple[int, int]]:
        """The next events; none, and at once, when the transmission on the wire ends or a fault is due."""
        due_us = self.wire_due_us()
        if self.disturbed and self.disturber is not None and not self._options.lockstep:
            fault_us = self.disturber.due_us()
            due_us = min((t_us for t_us in (due_us, fault_us) if t_us is not None), default=None)
        others_s = [self._leaving[0].leaves_s or 0] if self._leaving else []
        if self._beacon is not None:
            others_s.append(self._beacon.due_s)
        other_s = max(0.0, min(others_s) - time.monotonic()) if others_s else None
        if due_us is None:
            return self._epoll.poll(other_s, EVENTS_MAX)
        rest_us = due_us - self.now_us()
        if rest_us > 0:  # epoll counts milliseconds, select microseconds, and an epoll can be selected
            rest_s = rest_us / (1e6 * self._options.pace)
            select.select([self._epoll], [], [], rest_s if other_s is None else min(rest_s, other_s))
        return self._epoll.poll(0, EVENTS_MAX)

    def _attend_all(self, events: list[tuple[int, int]]) -> bool:
        """Serve these events; False when the life of the hub has ended."""
        alive = True
        for fd, mask in events:
            client = self._clients.get(fd)
            if client is not None:
                if mask & select.EPOLLOUT:
                    self._flush(client)
                if mask & _READABLE:
                    self._receive(client)
            elif fd == self._life_fd:
                alive = bool(read(fd, READ_BYTES_MAX)) if self._link is None else self._link.attend(self)
            elif fd == self._listener.fileno():
                self._accept()
        return alive

    # -- what the rules of the bus ask for ------------------------------------------------------

    def deliver(self, frame: Frame, sender: str, receivers: Sequence[HubConnection]) -> None:
        """The one place through which every frame passes: relay it, then record it."""
        self._counts.frames += 1
        seconds, micros = divmod(frame.t_us, 1_000_000)
        data = frame.data.hex().upper()
        element = f"< frame {frame.can_id:03X} {seconds}.{micros:06d} {data} >".encode("ascii")
        for client in receivers:
            self._send(client, element)
        line = log_line(frame, self._options.channel).encode("ascii")
        self._log_bytes += len(line)
        if self._log_bytes > LOG_BYTES_MAX:
            raise HarnessError(f"the bus log is over its limit of {LOG_BYTES_MAX} bytes")
        if write(self._log_fd, line) != len(line):
            raise HarnessError("the bus log took only a part of a line: is the disk full?")

    def dequeued(self, node: HubConnection) -> None:
        self._update_interest(node)

    def receipts_changed(self, can_id: int, change: int) -> None:
        if self._time_master is not None:
            self._send(self._time_master, f"< change {can_id:03X} {change:+d} >".encode("ascii"))

    def condition_added(self, number: int, condition: Condition) -> None:
        """Send it to the car; one that attaches later gets it then."""
        if self._plant is not None:
            self._send(self._plant, _watch_element(number, condition))

    def faults_acted(self) -> None:
        if self._link is not None:
            self._link.faults_acted()

    # -- elements -------------------------------------------------------------------------------

    def _take(self, client: HubConnection, element: bytes) -> None:
        """Act on one element (without its `>`), or refuse it, having changed nothing.

        Raises _PutOutError where the client has to leave.
        """
        try:
            if client.raw and element.startswith(b"< send "):
                frame = parse_send(element, self.now_us())
                if client.account is None:
                    self._own_ids.add(frame.can_id)
                else:
                    self._note_frame(client.account, frame)
                self.send(client, frame)
            elif element == b"< echo ":
                if client.account is not None:
                    client.account.pay()
                self._send(client, b"< echo >")
            elif element.startswith(b"< open ") and not client.opened:
                self._open(client, element)
                self._send(client, b"< ok >")
            elif element == b"< rawmode " and client.opened and not client.raw:
                client.raw = True
                self.add_receiver(client)
                self._send(client, b"< ok >\n", socket.MSG_OOB)
            elif element.startswith(b"< aftbed ") and client.opened:
                self._take_ours(client, element)
            else:
                raise PeerError("unknown command, or not now")
        except PeerError as error:
            self._refuse(client, str(error))

    def _open(self, client: HubConnection, element: bytes) -> None:
        """Open the bus for a node of the run or a stranger. Raises PeerError, or _PutOutError."""
        found = _OPEN.fullmatch(element)
        if found is None or found[1] != self._options.channel.encode("ascii"):
            raise PeerError(f"could not open bus: only {self._options.channel} is here")
        if found[2] is not None and compare_digest(found[2], self._secret):
            client.account = None
        else:
            self._admit(client, guessed=found[2] is not None)
        client.opened = True

    def _admit(self, client: HubConnection, *, guessed: bool) -> None:
        """Let a stranger onto the bus. Raises _PutOutError, also where it has `guessed` a secret."""
        uid, mine = user_behind(client.sock), os.geteuid()
        account = client.account = self._account(uid)
        strangers = sum(map(_is_stranger, self._clients.values()))
        reason = ""
        if guessed:
            reason = "this is not the secret of the run"
        elif uid != mine and not self._options.open_to_all:
            who = "your user is not known" if uid is None else f"you are user {uid}"
            reason = f"{who}, and user {mine} has started this run without --bus-open"
        elif strangers >= STRANGERS_MAX:
            reason = f"{STRANGERS_MAX} strangers are on it already"
        if reason:
            account.did.turned_away += 1
            self._tell(account, f"was turned away from the bus: {reason}")
            raise _PutOutError(f"could not open bus: {reason}")
        account.did.connections += 1
        self._tell(account, "is on the bus")

    def _account(self, uid: int | None) -> _Account:
        if uid not in self._accounts and len(self._accounts) > STRANGER_USERS_MAX:  # and one for the rest
            uid = None
        return self._accounts.setdefault(uid, _Account(uid))

    def _note_frame(self, account: _Account, frame: Frame) -> None:
        """A stranger's. Raises _PutOutError if it is one too many."""
        account.pay()
        account.ids[frame.can_id] += 1
        if frame.can_id in self._own_ids:
            self._tell(account, f"sends frame {frame.can_id:03X}, which is of the run's own")

    def _tell(self, account: _Account, what: str) -> None:
        """Report it to the supervisor, once."""
        if what not in account.told and self._link is not None:
            account.told.add(what)
            self._link.stranger(f"{account.did} {what}")

    def _take_ours(self, client: HubConnection, element: bytes) -> None:
        if client.account is not None:
            client.account.did.commands_refused += 1
            self._tell(client.account, "tried what only the nodes of the run may do")
            raise PeerError("only the nodes of the run may do this: open the bus with its secret")
        word = element.removeprefix(b"< aftbed ").partition(b" ")[0]
        found = _OURS[word].fullmatch(element) if word in _OURS else None
        arguments = [text.decode("ascii") for text in found.groups()] if found is not None else []
        match word, arguments:
            case b"time", [t_us]:
                self._set_time(client, int(t_us))
                self._send(client, self._ok())
            case b"node", [name, uses]:
                client.name = name
                client.uses = frozenset(int(can_id, 16) for can_id in uses.split())
                self._own_ids |= client.uses
            case b"await", [node, frames]:
                self._awaiting = (client, node, int(frames))
            case b"plant", [] if found is not None:
                if self._plant not in (None, client):
                    raise PeerError("another client is the car")
                self._plant = client
                self._send(client, b"< ok >" + b"".join(_watch_element(*one) for one in self.conditions()))
            case b"met", [number, t_us, since_ns]:
                if self._plant is not client:
                    raise PeerError("only the car knows conditions")
                self._condition_met(client, int(number), int(t_us), int(since_ns))
            case b"unasked", [can_id]:
                if self.disturber is not None:
                    self.receipts_changed(int(can_id, 16), -1)
            case b"noticed", [can_id, reason, t_us, since_ns]:
                # Out of lockstep the car has another zero of time than the hub: the clock is common to both.
                in_lockstep = self._options.lockstep
                noticed_us = int(t_us) if in_lockstep else min(self._us_of(int(since_ns)), self.now_us())
                self.noticed(client.name, Notice(int(can_id, 16), reason, noticed_us))
            case _:
                raise PeerError("unknown command, or not now")

    def _condition_met(self, car: HubConnection, fault_number: int, t_us: int, since_ns: int) -> None:
        if not self._options.lockstep:
            self.advance(self.now_us())
        met = self.met(fault_number, self.now_us())
        if met and self._link is not None and self._options.lockstep:
            self._held[fault_number] = car
            self._link.met(fault_number, t_us, 0)
            return
        self._send(car, self._ok())
        if met and self._link is not None:
            self._link.met(fault_number, t_us, since_ns)

    def _ok(self) -> bytes:
        """To the time master: once there have been faults, when something is due next."""
        if self.disturber is None:
            return b"< ok >"
        due_us = self.disturber.due_us()
        return f"< ok {'-' if due_us is None else due_us} >".encode("ascii")

    def _answer_await(self, client: HubConnection, node: str, frames: int) -> None:
        if any(c.name == node and c.carried >= frames for c in self._clients.values()):
            self._awaiting = None
            self._send(client, self._ok())

    def _set_time(self, client: HubConnection, t_us: int) -> None:
        if not self._options.lockstep:
            raise PeerError("this bus runs in real time")
        if self._time_master not in (None, client):
            raise PeerError("another client is the time master")
        if t_us < self._virtual_us:
            raise PeerError(f"time runs backwards, from {self._virtual_us} to {t_us}")
        if self.disturbed:
            self.carry()  # what was sent before belongs to the time before
        self._time_master, self._virtual_us = client, t_us
        self.release(t_us)

    def _refuse(self, client: HubConnection, reason: str) -> None:
        self._counts.refused += 1
        if client.account is not None:
            client.account.did.refused += 1
            client.account.pay()
        self._send(client, self._error(reason))

    def _error(self, reason: str) -> bytes:
        seconds, micros = divmod(self.now_us(), 1_000_000)
        return f"< error 20000000 {seconds}.{micros:06d} {reason} >".encode("ascii")

    # -- connections ----------------------------------------------------------------------------

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:  # gone before it was accepted
            return
        if len(self._clients) >= CLIENTS_MAX:
            self._make_room(min(self._clients.values(), key=_worth))
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = self._clients[sock.fileno()] = HubConnection(sock, self._newcomers)
        self._epoll.register(sock.fileno(), client.interest)
        self._send(client, b"< hi >")

    def _make_room(self, client: HubConnection) -> None:
        """Disconnect it at once, and tell it why."""
        self._counts.turned_away += 1
        reason = f"no room: there are {CLIENTS_MAX} connections, and this one is the least needed"
        if client.account is not None:
            client.account.did.turned_away += 1
            self._tell(client.account, f"was turned away from the bus: {reason}")
        self._say_last(client, reason)
        self._drop(client)

    def _say_last(self, client: HubConnection, reason: str) -> None:
        """Tell it why it is disconnected next, as far as its socket takes that at once."""
        client.outbox += self._error(reason)
        with suppress(OSError):
            client.sock.send(client.outbox, socket.MSG_NOSIGNAL)
            client.sock.shutdown(socket.SHUT_WR)

    def _put_out(self, client: HubConnection, reason: str) -> None:
        """Send the reason behind what waits for it, take nothing more from it, and disconnect it then."""
        if client.leaves_s is not None or client.sock.fileno() < 0:  # it is leaving already, or gone
            return
        self.remove_receiver(client)
        client.leaves_s = time.monotonic() + LEAVE_S_MAX
        self._leaving.append(client)
        client.outbox += self._error(reason)
        self._flush(client)

    def _end_leaving(self) -> None:
        """Disconnect those whose time to read the reason is over."""
        while self._leaving and (self._leaving[0].leaves_s or 0) <= time.monotonic():
            self._drop(self._leaving.popleft())

    def _drop(self, client: HubConnection) -> None:
        """Disconnect. Frames that the node had handed over before still get their turn on the wire."""
        self.remove_receiver(client)
        if self._clients.pop(client.sock.fileno(), None) is None:
            return
        self._epoll.unregister(client.sock.fileno())
        client.sock.close()

    def _receive(self, client: HubConnection) -> None:
        if client.leaves_s is not None:  # it has hung up
            self._drop(client)
            return
        try:
            data = client.sock.recv(READ_BYTES_MAX)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        *elements, client.inbox = (client.inbox + data).split(b">")
        try:
            for element in elements:
                self._take(client, element.lstrip())
            if len(client.inbox) > ELEMENT_BYTES_MAX:
                self._counts.oversized += 1
                if client.account is not None:
                    client.account.did.put_out_oversized += 1
                raise _PutOutError(f"element over {ELEMENT_BYTES_MAX} bytes")
        except _PutOutError as error:
            self._put_out(client, str(error))
        self._update_interest(client)

    def _send(self, client: HubConnection, data: bytes, flags: int = 0) -> None:
        """Send, or queue what the socket does not take; a client with too much queued is disconnected."""
        sent = 0
        if not client.outbox:
            try:
                sent = client.sock.send(data, flags | socket.MSG_NOSIGNAL)
            except BlockingIOError:
                pass
            except OSError:
                self._drop(client)
                return
        if sent < len(data):
            client.outbox += data[sent:]
            if len(client.outbox) > OUTPUT_BYTES_MAX and client.leaves_s is None:
                self._counts.slow_readers += 1
                if client.account is not None:
                    client.account.did.put_out_slow += 1
                self._put_out(client, f"too slow: {OUTPUT_BYTES_MAX} bytes wait to be read")
            self._update_interest(client)

    def _flush(self, client: HubConnection) -> None:
        try:
            del client.outbox[: client.sock.send(client.outbox, socket.MSG_NOSIGNAL)]
            if client.leaves_s is not None and not client.outbox:
                client.sock.shutdown(socket.SHUT_WR)
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)
            return
        self._update_interest(client)

    def _update_interest(self, client: HubConnection) -> None:
        """Wait only for events that can be served: a client with a full queue is not read."""
        interest = select.EPOLLOUT if client.outbox else 0
        if client.leaves_s is not None:
            interest = interest or select.EPOLLRDHUP
        elif len(client.frames) < FRAMES_QUEUED_MAX:
            interest |= select.EPOLLIN
        if interest != client.interest and client.sock.fileno() in self._clients:
            client.interest = interest
            self._epoll.modify(client.sock.fileno(), interest)


class _Beacon:
    """Announces on this machine where the bus is. A beacon that cannot be sent is no trouble of the run."""

    def __init__(self, options: HubOptions, port: int) -> None:
        self.due_s = 0.0
        self._text = (
            f'<CANBeacon name="{options.beacon}" type="aftbed" description="a run of aftbed">\n'
            f"<URL>can://{HOST}:{port}</URL>\n"
            f'<Bus name="{options.channel}"/>\n'
            "</CANBeacon>"
        ).encode("ascii")

    def send_if_due(self) -> None:
        now_s = time.monotonic()
        if now_s >= self.due_s:
            self.due_s = now_s + BEACON_PERIOD_S
            kind = socket.SOCK_DGRAM | socket.SOCK_NONBLOCK
            with suppress(OSError), socket.socket(socket.AF_INET, kind) as sock:
                sock.sendto(self._text, BEACON)


def _is_stranger(client: HubConnection) -> bool:
    """Whether it is one that is on the bus."""
    return client.opened and client.account is not None and client.leaves_s is None


def _worth(client: HubConnection) -> tuple[bool, bool]:
    """The least, and then the oldest, is disconnected when there are too many."""
    return client.opened and client.leaves_s is None, client.account is None


def user_behind(sock: socket.socket) -> int | None:
    """The uid of the process that made the other end of this loopback connection; None if it is not known.

    An end that was closed meanwhile has lost its user. If ours is connected afterwards, the addresses were no
    other connection's.
    """
    try:
        here, there = sock.getsockname(), sock.getpeername()
        try:
            uid = uid_by_sock_diag(there, here)
        except OSError:  # some sandboxes have no such socket
            uid = uid_by_proc(there, here)
        state = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]
    except OSError:
        return None
    return uid if state in _CONNECTED else None


def uid_by_sock_diag(end: tuple[str, int], other: tuple[str, int]) -> int | None:
    """The owner of the socket at `end` by sock_diag(7), or None. Raises OSError where the kernel has none.

    It takes 0.04 ms; /proc/net/tcp takes 4 ms, in which the bus stands still.
    """
    hosts = (socket.inet_aton(host).ljust(16, b"\0") for host, _ in (end, other))
    ends = struct.pack("!HH", end[1], other[1]) + b"".join(hosts)
    asked = struct.pack("=BBHI", socket.AF_INET, socket.IPPROTO_TCP, 0, 0xFFFF_FFFF) + ends + _ANY
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _SOCK_DIAG) as kernel:
        kernel.send(struct.pack("=IHHII", 16 + len(asked), _SOCK_DIAG_BY_FAMILY, _REQUEST, 0, 0) + asked)
        answer = kernel.recv(READ_BYTES_MAX, socket.MSG_DONTWAIT)
    if len(answer) < _INODE_END or struct.unpack_from("=H", answer, 4)[0] != _SOCK_DIAG_BY_FAMILY:
        return None  # an error: the kernel knows no such connection
    uid, inode = struct.unpack_from("=II", answer, _INODE_END - 8)
    return int(uid) if inode else None  # a closed end has no inode


def uid_by_proc(end: tuple[str, int], other: tuple[str, int]) -> int | None:
    """The same by /proc/net/tcp. Raises OSError."""
    hosts = (int.from_bytes(socket.inet_aton(host), sys.byteorder) for host, _ in (end, other))
    ends = [f"{host:08X}:{port:04X}" for host, (_, port) in zip(hosts, (end, other), strict=True)]
    with open("/proc/net/tcp", encoding="ascii") as table:
        for fields in map(str.split, table):
            if fields[1:3] == ends:
                return int(fields[7]) if fields[9] != "0" else None
    return None


def parse_send(element: bytes, t_us: int) -> Frame:
    """The frame in `< send ID LENGTH BYTES` (without its `>`). Raises PeerError."""
    match = _SEND.fullmatch(element)
    if match is None:
        raise PeerError("malformed send")
    identifier, code, text = match.groups()
    if len(identifier) != 3:
        raise PeerError("29-bit identifiers are not carried")
    data = bytes([int(byte, 16) for byte in text.split()])
    length = min(int(code, 16), DATA_LENGTH_MAX)  # codes 9 to 15 mean 8 bytes (ISO 11898-1)
    if len(data) != length:
        raise PeerError(f"length {length} but {len(data)} bytes")
    return Frame(t_us, int(identifier, 16), data)


def _watch_element(fault_number: int, condition: Condition) -> bytes:
    than = "below" if condition.below else "above"
    return f"< watch {fault_number} {condition.quantity} {than} {number(condition.value)} >".encode("ascii")


def serve(
    listener: socket.socket,
    log_fd: int,
    options: HubOptions,
    life_fd: int,
    link: SupervisorLink | None = None,
) -> HubCounts:
    """Run a bus on `listener`, bound and listening, until `life_fd` reads its end; record on `log_fd`.

    A `link` reads `life_fd` itself.

    Raises HarnessError, or OSError, when a frame cannot be recorded.
    """
    hub = Hub(listener, log_fd, options, life_fd, link)
    try:
        return hub.run()
    finally:
        hub.close()
