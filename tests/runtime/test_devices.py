"""What a device counts of the requests of its Client."""

from types import SimpleNamespace
from typing import cast

import msgspec

from aftbed.core.messages import Reply
from aftbed.ftm.client import Client
from aftbed.runtime.devices import CarDevice, CarLink, Dialogue


def test_a_request_that_waits_to_be_sent_is_not_among_those_sent() -> None:
    link = SimpleNamespace(
        read=lambda: [b"1", b"2", b"3"], advance=lambda now_ns: [], deliver=lambda *_: None, counts=dict
    )
    ignored = SimpleNamespace(write=lambda *_: None, keep=lambda *_: None)
    client = Client()
    device = CarDevice(client, cast(Dialogue, ignored), cast(CarLink, link))
    device.ready(0, 0)
    for now_ns in (1, 2):
        request = device.take(now_ns)
        assert request is not None
        client.step("submit", request, now_ns)
    client.step("pxy2clt", Reply(1, 1, 1, b""), 3)
    counts = msgspec.msgpack.decode(device.stats())
    assert (counts["sent"], counts["answered"], counts["unanswered"]) == (2, 1, 2)
