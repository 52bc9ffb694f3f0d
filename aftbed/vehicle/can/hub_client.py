"""The car's line to the hub: a connection that receives no frames, only what is sent beside the bus.

In lockstep it sets the hub's virtual time. In real time, too, the car looks for the conditions at which
faults open (`when ttc < 1.2`), since only the car knows its true state: the hub sends the conditions, the car
reports when one holds.

    > < aftbed plant >            < < ok >              this is the car
                                  < < watch 7 ttc below 1.2 >
    > < aftbed time 20000 >       < < ok >              after a fault with the time of the next: < ok 31000 >
    > < aftbed await radar 12 >   < < ok >              when twelve frames of the radar have been carried
    > < aftbed met 7 3240 5678 >  < < ok - >            at 3240 us of the drive, 5678 ns by the clock
                                  < < change 130 -1 >   see `hub`

What the hub sends of its own accord comes before the answer that it concerns: after the answer to `await`,
all changes for those frames are known.
"""

import re
import select
import socket
import time
from collections import deque
from typing import Final, cast

from aftbed.core.errors import ConfigError, HarnessError
from aftbed.vehicle.can.bus import HOST, HUB_ANSWER_S_MAX, BusOptions
from aftbed.vehicle.condition import Condition, Quantity

READ_BYTES_MAX: Final = 4096
_OK: Final = re.compile(r"< ok (?:(-|[0-9]+) )?>")
_WATCH: Final = re.compile(r"< watch ([0-9]+) (ttc|gap|speed) (below|above) (-?[0-9.]+) >")
_CHANGE: Final = re.compile(r"< change ([0-9A-F]{3}) ([+-][0-9]+) >")


class HubLine:
    """One connection. `conditions` are still to be met, by the number of their faults."""

    def __init__(self, options: BusOptions) -> None:
        if options.interface != "socketcand":
            raise ConfigError(f"lockstep needs the hub, interface socketcand, not {options.interface}")
        try:
            self._socket = socket.create_connection((HOST, options.port), HUB_ANSWER_S_MAX)
        except OSError as error:
            raise HarnessError(f"no CAN hub at {HOST}:{options.port}: {error}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        self.conditions: dict[int, Condition] = {}
        self.disturbed = False  # by the latest from the hub
        self.due_us: int | None = None  # when something comes of a fault by itself
        self._changes: deque[tuple[int, int]] = deque()
        self._buffer = b""
        self._elements: deque[str] = deque()
        try:
            self._expect("< hi >")
            self._ask(f"< open {options.channel} >")
        except HarnessError:
            self.close()
            raise

    def fileno(self) -> int:
        """What to wait on for changes."""
        return self._socket.fileno()

    def drives_the_car(self) -> None:
        """Ask the hub for conditions to look for."""
        self._ask("< aftbed plant >")

    def set_time(self, t_us: int) -> None:
        """Return when the hub has taken `t_us` as its time. HarnessError if it does not."""
        self._ask(f"< aftbed time {t_us} >")

    def carried(self, node: str, frames: int) -> None:
        """Return when that many frames of `node` have been over the wire since it came."""
        self._ask(f"< aftbed await {node} {frames} >")

    def met(self, number: int, t_us: int) -> None:
        """The condition of that fault holds at `t_us` of the drive: return when the hub knows.

        In lockstep, when what begins with it has begun.
        """
        self.conditions.pop(number, None)
        self._ask(f"< aftbed met {number} {t_us} {time.monotonic_ns()} >")

    def settle(self) -> None:
        """Return when all that the hub has sent by now is here."""
        self._send("< echo >")
        self._expect("< echo >")

    def changes(self) -> list[tuple[int, int]]:
        """By how many more or fewer a frame was got, by its identifier, as far as it is known."""
        self._read_asides()
        found = list(self._changes)
        self._changes.clear()
        return found

    def close(self) -> None:
        """Hang up; the time of the hub stays as it is, for good."""
        self._socket.close()

    # -- reading and writing

    def _ask(self, line: str) -> None:
        self._send(line)
        self._expect("< ok >")

    def _send(self, line: str) -> None:
        try:
            self._socket.sendall(line.encode("ascii"))
        except OSError as error:
            raise HarnessError(f"the CAN hub did not take {line}: {error}") from error

    def _expect(self, line: str) -> None:
        while True:
            while self._elements:
                element = self._elements.popleft()
                if self._take_aside(element):
                    continue
                answer = _OK.fullmatch(element) if line == "< ok >" else None
                if answer is None and element != line:
                    raise HarnessError(f"the CAN hub answered {element!r}, expected {line!r}")
                if answer is not None:
                    self.disturbed = answer[1] is not None
                    self.due_us = int(answer[1]) if answer[1] not in (None, "-") else None
                return
            self._read()

    def _read_asides(self) -> None:
        """Take what the hub has sent of its own accord."""
        while self._poll.poll(0):
            self._read()
        while self._elements:
            element = self._elements.popleft()
            if not self._take_aside(element):
                raise HarnessError(f"the CAN hub sent {element!r}, unasked")

    def _read(self) -> None:
        try:
            data = self._socket.recv(READ_BYTES_MAX)
        except OSError as error:
            raise HarnessError(f"the CAN hub gave no answer: {error}") from error
        if not data:
            raise HarnessError("the CAN hub hung up")
        *elements, self._buffer = (self._buffer + data).split(b">")
        self._elements += [element.decode("ascii", "replace").lstrip() + ">" for element in elements]

    def _take_aside(self, element: str) -> bool:
        if (found := _WATCH.fullmatch(element)) is not None:
            quantity = cast("Quantity", found[2])
            self.conditions[int(found[1])] = Condition(quantity, found[3] == "below", float(found[4]))
        elif (found := _CHANGE.fullmatch(element)) is not None:
            self._changes.append((int(found[1], 16), int(found[2])))
        else:
            return False
        self.disturbed = True
        return True
