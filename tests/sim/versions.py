"""Versions of the protected function, for updates in simulated runs: their replies tell them from the first.

Their state has the first version's form, so that either takes it from the other.
"""

import msgspec

from aftbed.core.application import NONE, Application, Characteristics
from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.aeb.messages import decode_reply, encode_reply

FIRM_MS2 = 0.125


class Firm:
    """Asks for a little more than the first version does, whatever that asks for."""

    characteristics = Characteristics()

    def __init__(self) -> None:
        self._function: Application = default_application()

    def execute(self, request: bytes) -> bytes:
        output = decode_reply(self._function.execute(request))
        return encode_reply(
            msgspec.structs.replace(output, deceleration_ms2=output.deceleration_ms2 + FIRM_MS2)
        )

    def capture(self) -> bytes:
        return self._function.capture()

    def restore(self, state: bytes) -> None:
        self._function.restore(state)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        output = decode_reply(reply)
        first = msgspec.structs.replace(output, deceleration_ms2=output.deceleration_ms2 - FIRM_MS2)
        return self._function.acceptable(request, encode_reply(first))


class Closed(Firm):
    """The same, with its state locked in."""

    characteristics = Characteristics(state_access=NONE)

    def capture(self) -> bytes:
        return b""

    def restore(self, state: bytes) -> None:
        assert not state

    def migrate(self, old_state: bytes) -> None:
        super().restore(old_state)
