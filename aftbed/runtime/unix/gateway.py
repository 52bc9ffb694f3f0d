"""The client's device on the bus: frames in, requests to the Client, replies out as AEB_REQ."""

from collections import deque
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.busfault import NODES
from aftbed.core.journal import EntryKind
from aftbed.core.messages import Reply, Submit
from aftbed.ftm.client import BACKLOG_MAX, Client
from aftbed.runtime.source import resume_client
from aftbed.runtime.unix.devices import told
from aftbed.runtime.unix.journal import Dialogue
from aftbed.runtime.unix.options import GatewayOptions
from aftbed.vehicle.can.bus import BusOptions, open_bus
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.gateway import ClientGateway, Gateway
from aftbed.vehicle.replay.map_file import find_map
from aftbed.vehicle.replay.mapped_gateway import MappedGateway

PAYLOADS_MAX: Final = BACKLOG_MAX
*_, GATEWAY = NODES


class GatewayDevice:
    """See `devices.Device`."""

    port = "submit"

    def __init__(self, client: Client, options: GatewayOptions) -> None:
        self._client = client
        resume_client(client, told(options.earlier))
        self._dialogue = Dialogue(Path(options.dialogue), "client")
        self._gateway = _gateway(options)
        self._bus = open_bus(BusOptions(port=options.port, node=GATEWAY, uses=self._gateway.uses()))
        self._payloads: deque[bytes] = deque()
        self._overrun = 0
        self._quiet = False
        self._sent_ns = 0
        self._cycle_us = 0.0  # of the last request

    def fds(self) -> tuple[int, ...]:
        """The bus."""
        return (self._bus.fileno(),)

    def ready(self, fd: int, now_ns: int) -> None:
        """Take all frames that are there."""
        for frame in self._bus.drain():
            payload = self._gateway.on_frame(frame)
            if payload is None:
                if self._gateway.makes_requests(frame.can_id):
                    self._bus.unasked(frame.can_id)
                continue
            if len(self._payloads) >= PAYLOADS_MAX:
                self._payloads.popleft()  # the oldest track is worth least
                self._overrun += 1
            self._payloads.append(payload)
        for can_id, word in self._gateway.noticed():
            self._bus.notice(can_id, word)

    def take(self, now_ns: int) -> Submit | None:
        """The next request. Written ahead: a successor knows it even if we die now."""
        if not self._payloads or self._quiet:
            return None
        payload = self._payloads.popleft()
        self._dialogue.write(now_ns, self._client.next_id, 0, EntryKind.SENT, payload)
        self._sent_ns = now_ns
        return Submit(payload)

    def accept(self, reply: Reply, now_ns: int) -> None:
        """Out it goes as frames; written behind, so that a reply that nobody got is asked again."""
        self._cycle_us = round((now_ns - self._sent_ns) / 1e3, 1)
        for frame in self._gateway.on_reply(reply.payload, reply.replica, reply.epoch):
            self._bus.send(frame)
        self._dialogue.write(now_ns, reply.request_id, reply.epoch, EntryKind.ANSWERED, reply.payload)

    def quiet(self) -> None:
        """No more requests."""
        self._quiet = True
        self._payloads.clear()

    def deadline_ns(self) -> int | None:
        """Frames come by themselves."""
        return None

    def stats(self) -> bytes:
        """What the gateway believed and refused, and how far the requests are."""
        counts = self._gateway.counts
        return msgspec.msgpack.encode(
            {
                "sent": self._client.next_id - 1,
                "unanswered": len(self._client.unanswered) + len(self._payloads),
                "overrun": self._overrun,
                "replies_refused": self._gateway.replies_refused,
                "cycle_us": self._cycle_us,
                "accepted": counts.accepted,
                "ignored": counts.ignored,
                "refused": counts.refused,
            }
        )


def _gateway(options: GatewayOptions) -> ClientGateway:
    if options.map:
        return ClientGateway(MappedGateway(load_dbc(), Path(options.dbc), find_map(options.map)))
    return ClientGateway(Gateway(load_dbc()))
