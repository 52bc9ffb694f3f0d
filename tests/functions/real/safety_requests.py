"""A drive for `safety.c`: what a Toyota's bus carries, and what a driver assistance system wants to send."""

import struct
from collections.abc import Iterator
from random import Random

FROM_CAR, TO_CAR, FORWARDED, TICK = range(4)
CYCLE_US = 100_000


def drive(seed: int) -> Iterator[bytes]:
    """Eleven requests each 0.1 s. Some of what is sent breaks a limit, and the driver brakes at times."""
    draw = Random(seed)
    torque, t_us, speed_kph = 0, 5_000_000, 50.0

    def frame(direction: int, address: int, data: bytes, bus: int = 0) -> bytes:
        return struct.pack("<IBBIB", t_us, direction, bus, address, len(data)) + data

    while True:
        t_us += CYCLE_US
        speed_kph = max(0.0, speed_kph + draw.uniform(-1.0, 1.0))
        engaged, braking = draw.random() < 0.95, draw.random() < 0.05
        steering = draw.randrange(-300, 300)
        wheels = struct.pack(">4H", *[6767 + round(speed_kph * 100)] * 4)
        yield frame(FROM_CAR, 0xAA, wheels)
        yield frame(FROM_CAR, 0x260, checked(0x260, struct.pack(">xhhh", steering, 0, torque)))
        yield frame(FROM_CAR, 0x1D2, checked(0x1D2, bytes([engaged << 5 | 1 << 4]) + bytes(6)))
        yield frame(FROM_CAR, 0x226, bytes([0, 0, 0, 0, braking << 5, 0, 0, 0]))
        for _ in range(4):
            torque = max(-1500, min(1500, torque + draw.randrange(-20, 18)))
            yield frame(TO_CAR, 0x2E4, struct.pack(">Bhxx", draw.random() < 0.97, torque))
        yield frame(TO_CAR, 0x343, struct.pack(">h6x", draw.randrange(-4000, 2500)))
        yield frame(FORWARDED, draw.choice((0x2E4, 0x343, 0x123)), b"", bus=2)
        yield frame(TICK, 0, b"")


def checked(address: int, data: bytes) -> bytes:
    """`data` with Toyota's checksum behind it."""
    total = (address & 0xFF) + (address >> 8) + len(data) + 1 + sum(data)
    return data + bytes([total & 0xFF])
