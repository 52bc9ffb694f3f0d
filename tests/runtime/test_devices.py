"""What a device counts and times of the requests of its Client."""

from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from aftbed.core.messages import Reply
from aftbed.ftm.client import Client
from aftbed.runtime.devices import CarDevice, CarLink, Dialogue

MS = 1_000_000


@pytest.fixture
def device() -> CarDevice:
    """Of a car that has made three requests."""
    link = SimpleNamespace(
        read=lambda: [b"1", b"2", b"3"], advance=lambda now_ns: [], deliver=lambda *_: None, counts=dict
    )
    ignored = SimpleNamespace(write=lambda *_: None, keep=lambda *_: None)
    device = CarDevice(Client(), cast(Dialogue, ignored), cast(CarLink, link))
    device.ready(0, 0)
    return device


def sent(device: CarDevice, now_ns: int) -> None:
    request = device.take(now_ns)
    assert request is not None
    device._client.step("submit", request, now_ns)


def answered(device: CarDevice, request_id: int, now_ns: int) -> None:
    reply = Reply(1, request_id, 1, b"")
    device._client.step("pxy2clt", reply, now_ns)
    device.accept(reply, now_ns)


def counts(device: CarDevice) -> dict[str, Any]:
    return msgspec.msgpack.decode(device.stats(), type=dict[str, Any])


def test_a_request_that_waits_to_be_sent_is_not_among_those_sent(device: CarDevice) -> None:
    sent(device, 1)
    sent(device, 2)
    answered(device, 1, 3)
    found = counts(device)
    assert (found["sent"], found["answered"], found["unanswered"]) == (2, 1, 2)


def test_a_cycle_is_counted_from_its_own_request(device: CarDevice) -> None:
    """After a failover several are answered at once."""
    sent(device, 0 * MS)
    sent(device, 20 * MS)
    answered(device, 1, 50 * MS)
    answered(device, 2, 51 * MS)
    found = counts(device)
    assert (found["cycle_us"], found["slowest_us"]) == (31_000.0, 50_000.0)


def test_the_slowest_is_of_those_since_it_was_asked_for(device: CarDevice) -> None:
    sent(device, 0 * MS)
    answered(device, 1, 50 * MS)
    counts(device)
    sent(device, 60 * MS)
    answered(device, 2, 61 * MS)
    assert counts(device)["slowest_us"] == 1000.0
    assert counts(device)["slowest_us"] == 0.0
