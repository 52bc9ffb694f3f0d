"""The car of a Client that is a process: frames of the bus in, requests to the Client, replies out as
AEB_REQ.
"""

from collections.abc import Iterator
from pathlib import Path

from aftbed.core.messages import Reply
from aftbed.ftm.client import Client
from aftbed.runtime.devices import CarDevice, resume_client
from aftbed.runtime.unix.devices import entries_of
from aftbed.runtime.unix.journal_files import DialogueFile
from aftbed.runtime.unix.options import GatewayOptions
from aftbed.vehicle.can.bus import BusOptions, open_bus
from aftbed.vehicle.can.bus_model import NODES
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.gateway import BusGateway, Gateway
from aftbed.vehicle.replay.map_file import find_map
from aftbed.vehicle.replay.mapped_gateway import MappedGateway

*_, GATEWAY = NODES


class BusLink:
    """The `CarLink` over a bus."""

    def __init__(self, gateway: BusGateway, port: int) -> None:
        self._gateway = gateway
        self._bus = open_bus(BusOptions(port=port, node=GATEWAY, uses=gateway.uses))

    def fds(self) -> tuple[int, ...]:
        """The bus."""
        return (self._bus.fileno(),)

    def read(self) -> Iterator[bytes]:
        """The requests that all frames that are there make."""
        for frame in self._bus.drain():
            payload = self._gateway.on_frame(frame)
            if payload is not None:
                yield payload
            elif frame.can_id == self._gateway.request_id:
                self._bus.unasked(frame.can_id)
        for can_id, word in self._gateway.noticed():
            self._bus.notice(can_id, word)

    def advance(self, now_ns: int) -> tuple[bytes, ...]:
        """Frames come by themselves."""
        return ()

    def deliver(self, reply: Reply, now_ns: int) -> None:
        """Send the reply as frames."""
        for frame in self._gateway.on_reply(reply.payload, reply.replica, reply.epoch):
            self._bus.send(frame)

    def deadline_ns(self) -> int | None:
        """Frames come by themselves."""
        return None

    def counts(self) -> dict[str, object]:
        """What the gateway believed and refused."""
        counts = self._gateway.counts
        return {
            "replies_refused": self._gateway.replies_refused,
            "accepted": counts.accepted,
            "ignored": counts.ignored,
            "refused": counts.refused,
        }


def make_car(client: Client, options: GatewayOptions) -> CarDevice:
    """A car for a Client that may have had predecessors."""
    resume_client(client, entries_of(options.earlier))
    dialogue = DialogueFile(Path(options.dialogue), "client")
    return CarDevice(client, dialogue, BusLink(_gateway(options), options.port))


def _gateway(options: GatewayOptions) -> BusGateway:
    if options.map:
        return MappedGateway(load_dbc(), Path(options.dbc), find_map(options.map))
    return Gateway(load_dbc())
