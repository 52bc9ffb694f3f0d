"""The bus is on the loopback and nowhere else, whatever other addresses the machine has."""

import socket

import pytest

from aftbed.core.errors import ConfigError
from aftbed.runtime.unix.launch import listen_on_loopback
from aftbed.vehicle.can.bus import HOST

TEST_NET: str = "192.0.2.1"  # RFC 5737: it is not assigned; nothing is sent there


def own_addresses() -> list[str]:
    """Another one of the loopback's, and that by which this machine would speak to others, if it has one."""
    found = ["127.0.0.2"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.connect((TEST_NET, 9))
        except OSError:
            return found
        return [*found, sock.getsockname()[0]]


@pytest.mark.parametrize("address", own_addresses())
def test_the_bus_is_not_reached_by_another_address(address: str) -> None:
    with listen_on_loopback(0, "--bus-port") as listener:
        host, port = listener.getsockname()
        assert host == HOST == "127.0.0.1"
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((address, port), 5.0)
        socket.create_connection((HOST, port), 5.0).close()


def test_a_port_that_is_taken_is_said_to_be() -> None:
    with listen_on_loopback(0, "--bus-port") as listener:
        port = listener.getsockname()[1]
        with pytest.raises(ConfigError, match=f"--bus-port {port}: Address already in use; choose another"):
            listen_on_loopback(port, "--bus-port")
